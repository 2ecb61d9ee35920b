from .joint.realization import ldtp_bound as ldtp_bound, realize as realize
from .loops import loop as loop
from .multipliers import multiplier_bound as multiplier_bound
from .transient import remove_transient as remove_transient
