from .data import (
    experiment as experiment,
    impulse_responses as impulse_responses,
    phase as phase,
    phase_response as phase_response,
    section_data as section_data,
    validation as validation,
)
from .designs import spectrum as spectrum, standard_errors as standard_errors
from .explorer import Explorer as Explorer
from .frequency import bode as bode, htf as htf
from .look import (
    COLORS as COLORS,
    PAGE as PAGE,
    Plot as Plot,
    save as save,
    style as style,
)
from .motion import Motion as Motion, animate as animate
from .orbit import cycle as cycle
from .over_parameters import branch as branch, sweep as sweep
from .plane import multipliers as multipliers, poles_zeros as poles_zeros
from .returns import return_map as return_map
from .subjects import forest as forest, paired as paired, subject_maps as subject_maps
