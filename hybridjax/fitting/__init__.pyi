from .fit import identifiability as identifiability
from .observations import AbstractObservation as AbstractObservation
from .stability import spectral_radius as spectral_radius
