from . import (
    convert as convert,
    designs as designs,
    errors as errors,
    experiments as experiments,
    fitting as fitting,
    identify as identify,
    linear as linear,
    models as models,
    orbits as orbits,
    plants as plants,
    plot as plot,
    recordings as recordings,
    scale as scale,
    sections as sections,
    systems as systems,
    testing as testing,
)
from ._core.precision import enable_x64 as enable_x64
from .apps.subjects import identify_subjects as identify_subjects
from .designs.optimize import optimal_design as optimal_design
from .engine.trajectory import simulate as simulate
from .experiments.design.multisine import multisine as multisine
from .experiments.stored import run_experiments as run_experiments
from .fitting.fit import fit_model as fit_model
from .identify.from_system import identify_model as identify_model
from .identify.htf_estimate import estimate_htf as estimate_htf
from .identify.joint.fit import fit_ldtp as fit_ldtp
from .identify.multipliers import fit_multipliers as fit_multipliers
from .identify.series.fit import fit_series as fit_series
from .identify.validation import validate as validate
from .io import load as load, save as save
from .orbits.branches import continuation as continuation
from .orbits.crossing import AtEvent as AtEvent, Crossing as Crossing
from .orbits.find import find_limit_cycle as find_limit_cycle
from .orbits.flow import flow as flow
from .plot.explorer import explore as explore
from .recordings.identification import identify_recording as identify_recording
from .recordings.order import select_order as select_order
from .recordings.read import read_recording as read_recording
from .recordings.recording import Recording as Recording
from .scale.sweeps import sweep as sweep
from .sections.families import (
    ClockPhase as ClockPhase,
    KinematicPhase as KinematicPhase,
)
from .sections.linearization import linearize as linearize
from .systems.chart import Chart as Chart
from .systems.system import (
    Guess as Guess,
    HybridSystem as HybridSystem,
    Output as Output,
    Parameter as Parameter,
    parameter as parameter,
)
from .systems.transition import Transition as Transition

__version__: str
