from .adapters import (
    FMUPlant as FMUPlant,
    GymnasiumPlant as GymnasiumPlant,
    MuJoCoPlant as MuJoCoPlant,
)
from .cycle import Returns as Returns, SettledCycle as SettledCycle, settle as settle
from .drive import Plant as Plant
