from .adapters import (
    FMUPlant as FMUPlant,
    GymnasiumPlant as GymnasiumPlant,
    MuJoCoPlant as MuJoCoPlant,
)
from .cycle import SettledCycle as SettledCycle, settle as settle
from .drive import Plant as Plant
