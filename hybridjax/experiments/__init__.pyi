from .data import ExperimentData as ExperimentData, Simulated as Simulated
from .design.design import Design as Design
from .design.filtered_noise import random_input as random_input
from .design.multisine import (
    paper_design as paper_design,
)
from .motion import perturbed_trajectory as perturbed_trajectory
from .noise import (
    ProcessNoise as ProcessNoise,
    add_noise as add_noise,
    simulate_experiments as simulate_experiments,
)
from .record import SectionSeries as SectionSeries
from .response import (
    Response as Response,
    ResponseFunction as ResponseFunction,
    response_function as response_function,
)
from .stored import StoredExperiments as StoredExperiments
