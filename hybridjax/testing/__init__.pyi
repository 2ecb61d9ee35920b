from .beats import simulate_beats as simulate_beats
from .dirt import Dirt as Dirt, spoil as spoil
from .mishaps.catalog import (
    EVENT_MISHAPS as EVENT_MISHAPS,
    MISHAPS as MISHAPS,
    mishandle as mishandle,
)
from .perturbation import random_force as random_force
from .simulated_recording import simulate_recording as simulate_recording
from .synthetic_system import synthetic_ldtp as synthetic_ldtp
