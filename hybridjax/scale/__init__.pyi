from .._core.cache import enable_compilation_cache as enable_compilation_cache
from .._core.compilation import enable_loop_kernels as enable_loop_kernels
from .._core.execution import Execution as Execution
from .._core.progress import enable_progress as enable_progress
from .draws import monte_carlo as monte_carlo
from .family import SweepPoints as SweepPoints
