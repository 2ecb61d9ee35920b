from .data import phase_response as phase_response
from .designs import spectrum as spectrum, standard_errors as standard_errors
from .explorer import Explorer as Explorer
from .frequency import bode as bode, htf as htf
from .look import COLORS as COLORS, PAGE as PAGE, Plot as Plot, style as style
from .motion import Motion as Motion, animate as animate
from .orbit import cycle as cycle
from .over_parameters import branch as branch
from .plane import multipliers as multipliers, poles_zeros as poles_zeros
from .returns import return_map as return_map
from .subjects import paired as paired
