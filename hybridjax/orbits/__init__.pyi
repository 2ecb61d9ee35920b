from .branches.branch import BranchEnd as BranchEnd, BranchPoint as BranchPoint
from .coincidence import Coincidence as Coincidence, coincidences as coincidences
from .return_map import ReturnMap as ReturnMap
