from .candidates import draw_models as draw_models
from .goals import (
    MultiplierGoal as MultiplierGoal,
    ParameterGoal as ParameterGoal,
    ResponseGoal as ResponseGoal,
)
from .limits import Distortion as Distortion, Limits as Limits
from .optimize import OptimalDesign as OptimalDesign
from .study import SequentialDesign as SequentialDesign
