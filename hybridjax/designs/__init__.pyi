from .goals import (
    FrequencyResponse as FrequencyResponse,
    ImpulseResponse as ImpulseResponse,
    Multipliers as Multipliers,
    Order as Order,
    Parameters as Parameters,
)
from .information import InformationMap as InformationMap, information_map as information_map
from .limits.distortion import Distortion as Distortion
from .limits.limits import Limits as Limits
from .model_draws import draws as draws
from .optimal_design import OptimalDesign as OptimalDesign
from .sequences import RandomInput as RandomInput
from .studies.study import Study as Study
from .window import Window as Window
from .windows import WindowChoice as WindowChoice, choose_window as choose_window
