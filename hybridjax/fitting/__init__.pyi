from .fit import identifiability as identifiability
from .model_fit import ModelFit as ModelFit, ParameterGuesses as ParameterGuesses
from .observations import AbstractObservation as AbstractObservation
from .sensitivity import Identifiability as Identifiability
from .stability import spectral_radius as spectral_radius
