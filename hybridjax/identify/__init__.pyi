from .fit import Fit as Fit
from .from_system import ModelIdentification as ModelIdentification
from .joint.fit import ldtp_bound as ldtp_bound
from .loops import loop as loop
from .multipliers import multiplier_bound as multiplier_bound
from .rational import fit_rational as fit_rational
from .transient import remove_transient as remove_transient
