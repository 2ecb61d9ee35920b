from .bounds import cramer_rao as cramer_rao
from .fit import Fit as Fit
from .from_system import ModelIdentification as ModelIdentification
from .joint.fit import LDTPFit as LDTPFit
from .loops import Loop as Loop, estimate_loop as estimate_loop
from .multiplier_estimate import (
    MultiplierComparison as MultiplierComparison,
    MultiplierEstimate as MultiplierEstimate,
)
from .multipliers import (
    OrderSelection as OrderSelection,
    StructuredFit as StructuredFit,
)
from .rational import RationalFit as RationalFit, fit_rational as fit_rational
from .series.fit import SeriesFit as SeriesFit
from .transient import (
    TransientFit as TransientFit,
    remove_transient as remove_transient,
)
from .validation import Validation as Validation
