from .htf import HTF as HTF, Scatter as Scatter
from .ldtp import LDTP as LDTP
