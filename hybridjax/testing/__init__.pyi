from .dirt import spoil as spoil
from .simulated import random_force as random_force, simulate_recording as simulate_recording
from .synthetic import synthetic_ldtp as synthetic_ldtp
