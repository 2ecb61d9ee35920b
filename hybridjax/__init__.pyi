from ._core.cache import enable_compilation_cache as enable_compilation_cache
from ._core.errors import (
    ComputationError as ComputationError,
    DefinitionError as DefinitionError,
    FileFormatError as FileFormatError,
    HybridJaxError as HybridJaxError,
    PrecisionError as PrecisionError,
)
from ._core.precision import enable_x64 as enable_x64
from ._core.results import Result as Result
from .periodic.htf import HTF as HTF
from .periodic.ldtp import LDTP as LDTP

__version__: str
