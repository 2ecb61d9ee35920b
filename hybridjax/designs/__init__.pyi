from .goals import Goal as Goal, Multipliers as Multipliers, Parameters as Parameters
from .optimal_design import OptimalDesign as OptimalDesign
