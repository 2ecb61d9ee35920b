from .amplitude import amplitude_sweep as amplitude_sweep
from .htf_estimate import missing_frequencies as missing_frequencies
from .joint.fit import LDTPFit as LDTPFit, ldtp_bound as ldtp_bound
from .joint.noise import noise_spectrum as noise_spectrum
from .joint.realization import realize as realize
from .multipliers import multiplier_bound as multiplier_bound
from .series.fit import SeriesFit as SeriesFit
from .transient import remove_transient as remove_transient
