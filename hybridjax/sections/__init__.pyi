from .abstract import (
    AbstractLevels as AbstractLevels,
    AbstractSections as AbstractSections,
    BoundSections as BoundSections,
    CyclePoint as CyclePoint,
    Structure as Structure,
)
from .section_list import FamilyLike as FamilyLike
