from .adapters import (
    from_fmu as from_fmu,
    from_gymnasium as from_gymnasium,
    from_mujoco as from_mujoco,
)
from .cycle import SettledCycle as SettledCycle, settle as settle
from .plant import Plant as Plant
