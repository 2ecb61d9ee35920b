from .hopper import VerticalHopper as VerticalHopper
