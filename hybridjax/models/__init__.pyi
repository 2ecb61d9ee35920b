from .ball import BouncingBall as BouncingBall
from .bar import TwoLeggedBar as TwoLeggedBar
from .hopper import VerticalHopper as VerticalHopper
from .vanderpol import VanDerPol as VanDerPol
