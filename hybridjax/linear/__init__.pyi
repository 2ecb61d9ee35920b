from .htf import HTF as HTF, VarianceDof as VarianceDof
from .ldtp import LDTP as LDTP
