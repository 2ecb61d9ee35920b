from .fit import Fit as Fit
from .joint.fit import ldtp_bound as ldtp_bound
from .joint.realization import realize as realize
from .loops import loop as loop
from .multipliers import multiplier_bound as multiplier_bound
from .transient import remove_transient as remove_transient
