from .goals import Multipliers as Multipliers, Parameters as Parameters
from .optimal_design import OptimalDesign as OptimalDesign
from .study import Study as Study
