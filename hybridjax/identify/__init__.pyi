from .htf_estimate import (
    missing_frequencies as missing_frequencies,
    output_levels as output_levels,
)
from .joint.bound import ldtp_bound as ldtp_bound
from .joint.ldtp_fit import LDTPFit as LDTPFit
from .joint.noise import noise_spectrum as noise_spectrum
from .multipliers import multiplier_bound as multiplier_bound
from .series.fit import SeriesFit as SeriesFit
from .series.realization import realize as realize
from .transient import remove_transient as remove_transient
from .validation.amplitude import amplitude_sweep as amplitude_sweep
