from ..mechanics.mechanism import (
    Constrained as Constrained,
    Impact as Impact,
    Mechanism as Mechanism,
)
from .drawing import Drawing as Drawing
from .quotient import Symmetric as Symmetric
from .solver import Radau as Radau
from .surfaces import FilippovParts as FilippovParts, filippov as filippov
from .transition import Scheduled as Scheduled
