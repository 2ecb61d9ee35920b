from .cycle import SettledCycle as SettledCycle, settle as settle
from .fmu import from_fmu as from_fmu
from .gymnasium_env import from_gymnasium as from_gymnasium
from .mujoco_model import from_mujoco as from_mujoco
from .plant import Plant as Plant
