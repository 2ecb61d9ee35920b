from .._core.exceptions import (
    ComputationError as ComputationError,
    DefinitionError as DefinitionError,
    FileFormatError as FileFormatError,
    FindingWarning as FindingWarning,
    HybridJaxError as HybridJaxError,
    PrecisionError as PrecisionError,
)
from .._core.findings import Finding as Finding
from .._core.results import Result as Result
