from .fit import identifiability as identifiability
from .model_fit import (
    Identifiability as Identifiability,
    ModelFit as ModelFit,
    ParameterComparison as ParameterComparison,
    ParameterEstimate as ParameterEstimate,
    ParameterGuess as ParameterGuess,
)
from .observations import (
    AbstractObservation as AbstractObservation,
    ObservedCycle as ObservedCycle,
    ObservedHTF as ObservedHTF,
    ObservedSeries as ObservedSeries,
)
from .stability import spectral_radius as spectral_radius
from .transients import ObservedTrajectory as ObservedTrajectory
