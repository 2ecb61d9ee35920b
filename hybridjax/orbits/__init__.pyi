from .branches.branch import BranchEnd as BranchEnd, BranchPoint as BranchPoint
from .return_map import ReturnMap as ReturnMap
