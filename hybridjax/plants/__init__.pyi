from .adapters import (
    FMUPlant as FMUPlant,
    GymnasiumPlant as GymnasiumPlant,
    MuJoCoPlant as MuJoCoPlant,
)
from .cycle import (
    PlantCycle as PlantCycle,
    find_cycle as find_cycle,
)
from .drive import Plant as Plant
from .returns import Returns as Returns
