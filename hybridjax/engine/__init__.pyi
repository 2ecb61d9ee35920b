from .lanes import Lanes as Lanes
from .trajectory import Event as Event
