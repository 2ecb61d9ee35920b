from .abstract import (
    AbstractLevels as AbstractLevels,
    AbstractSections as AbstractSections,
    BoundSections as BoundSections,
)
