from .htf.coherence import Coherence as Coherence, estimate_coherence as estimate_coherence
from .htf.distortion import OutputLevels as OutputLevels, output_levels as output_levels
from .htf.leakage import predict_leakage as predict_leakage
from .htf.nonparametric import missing_frequencies as missing_frequencies
from .htf.p_values import htf_p_values as htf_p_values
from .htf.transient import TransientFit as TransientFit, remove_transient as remove_transient
from .joint.fit import LDTPFit as LDTPFit, ldtp_bound as ldtp_bound
from .joint.noise import noise_spectrum as noise_spectrum
from .joint.realization import realize as realize
from .multipliers.bound import (
    MultiplierBound as MultiplierBound,
    multiplier_bound as multiplier_bound,
)
from .multipliers.compare import MultiplierComparison as MultiplierComparison
from .multipliers.multiplier_estimate import MultiplierEstimate as MultiplierEstimate
from .multipliers.order import OrderSelection as OrderSelection
from .multipliers.structured import StructuredFit as StructuredFit
from .rational.aaa import AAAFit as AAAFit, fit_aaa as fit_aaa
from .rational.fit import RationalFit as RationalFit
from .series.fit import SeriesFit as SeriesFit
from .validation.amplitude import (
    AmplitudeSweep as AmplitudeSweep,
    amplitude_sweep as amplitude_sweep,
)
from .validation.validate import Validation as Validation
