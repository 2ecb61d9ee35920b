from .branches.branch import BranchEnd as BranchEnd, BranchPoint as BranchPoint
