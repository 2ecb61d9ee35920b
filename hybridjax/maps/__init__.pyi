from .placed import SectionsLike as SectionsLike
from .section_map import Arrival as Arrival, SectionMap as SectionMap
