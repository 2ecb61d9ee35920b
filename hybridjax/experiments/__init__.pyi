from .design.multisine import optimize_phases as optimize_phases
from .motion import perturbed_trajectory as perturbed_trajectory
from .noise import (
    ProcessNoise as ProcessNoise,
    add_noise as add_noise,
    simulate_experiments as simulate_experiments,
)
from .run import Options as Options
from .stored import (
    StoredExperiments as StoredExperiments,
    stream_experiments as stream_experiments,
)
