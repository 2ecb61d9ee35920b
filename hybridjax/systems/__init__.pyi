from ..mechanics.mechanism import (
    Constrained as Constrained,
    Impact as Impact,
    Mechanism as Mechanism,
)
from .drawing import Drawing as Drawing
from .quotient import Quotient as Quotient
from .sliding import Sliding as Sliding, sliding as sliding
from .solver import Radau as Radau
from .transition import Scheduled as Scheduled
