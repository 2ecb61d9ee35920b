from ..engine.settings import Settings as Settings
from ..engine.trajectory import Event as Event, Trajectory as Trajectory
from .branches import (
    Bifurcation as Bifurcation,
    Branch as Branch,
    BranchEnd as BranchEnd,
)
from .coincidence import (
    SimultaneousEvents as SimultaneousEvents,
)
from .coupling import (
    Coupling as Coupling,
    Locked as Locked,
)
from .cycle import LimitCycle as LimitCycle
from .flow import Flow as Flow
from .fluctuations import Fluctuations as Fluctuations
from .limit_cycles import (
    LimitCycles as LimitCycles,
    find_limit_cycles as find_limit_cycles,
)
from .responses import (
    Impulse as Impulse,
    PhaseCurve as PhaseCurve,
    Responses as Responses,
)
from .sensitivity import Sensitivity as Sensitivity
