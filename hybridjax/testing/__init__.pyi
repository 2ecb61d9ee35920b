from .recordings import (
    add_artifacts as add_artifacts,
    simulate_beats as simulate_beats,
    simulate_recording as simulate_recording,
)
from .synthetic_system import synthetic_ldtp as synthetic_ldtp
