from .candidates import draws as draws
from .goals import (
    FrequencyResponse as FrequencyResponse,
    Multipliers as Multipliers,
    Parameters as Parameters,
)
from .limits import Distortion as Distortion, Limits as Limits
from .optimize import OptimalDesign as OptimalDesign
from .study import Study as Study
