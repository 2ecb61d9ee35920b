from .recordings import (
    random_force as random_force,
    simulate_beats as simulate_beats,
    simulate_recording as simulate_recording,
    spoil as spoil,
)
from .synthetic_system import synthetic_ldtp as synthetic_ldtp
