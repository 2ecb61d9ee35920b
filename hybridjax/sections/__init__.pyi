from .abstract import (
    AbstractLevels as AbstractLevels,
    AbstractSections as AbstractSections,
    BoundSections as BoundSections,
    CyclePoint as CyclePoint,
)
from .section_list import FamilyLike as FamilyLike
