from .families import (
    AbstractLevels as AbstractLevels,
    AbstractSections as AbstractSections,
    ArcLength as ArcLength,
    BoundSections as BoundSections,
    SectionList as SectionList,
)
from .maps import (
    Arrival as Arrival,
    SectionMap as SectionMap,
    section_map as section_map,
)
from .place import place_sections as place_sections
from .placed import PlacedSections as PlacedSections
