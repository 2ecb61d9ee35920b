from .goals import (
    FrequencyResponse as FrequencyResponse,
    ImpulseResponse as ImpulseResponse,
    Multipliers as Multipliers,
    Order as Order,
    Parameters as Parameters,
)
from .limits import Limits as Limits
from .optimal_design import OptimalDesign as OptimalDesign
