from . import (
    convert as convert,
    designs as designs,
    errors as errors,
    experiments as experiments,
    identify as identify,
    models as models,
    plants as plants,
    plot as plot,
    recordings as recordings,
    testing as testing,
)
from ._core.cache import enable_compilation_cache as enable_compilation_cache
from ._core.compilation import enable_loop_kernels as enable_loop_kernels
from ._core.execution import Execution as Execution
from ._core.precision import enable_x64 as enable_x64
from ._core.progress import enable_progress as enable_progress
from ._core.results import Result as Result
from .apps.identify import write_report as write_report
from .apps.subjects import identify_subjects as identify_subjects
from .designs.optimize import optimal_design as optimal_design
from .engine.settings import Settings as Settings
from .engine.trajectory import simulate as simulate
from .errors import (
    ComputationError as ComputationError,
    DefinitionError as DefinitionError,
    HybridJaxError as HybridJaxError,
)
from .experiments.data import ExperimentData as ExperimentData
from .experiments.design.design import Design as Design
from .experiments.design.multisine import (
    multisine as multisine,
    paper_design as paper_design,
)
from .experiments.record import Record as Record
from .experiments.response import response_function as response_function
from .experiments.run import run_experiments as run_experiments
from .fitting.fit import fit_model as fit_model, identifiability as identifiability
from .fitting.observations import (
    AbstractObservation as AbstractObservation,
    ObservedCycle as ObservedCycle,
    ObservedHTF as ObservedHTF,
    ObservedSeries as ObservedSeries,
)
from .fitting.stability import spectral_radius as spectral_radius
from .identify.from_system import identify_model as identify_model
from .identify.htf_estimate import estimate_htf as estimate_htf
from .identify.joint.fit import fit_ldtp as fit_ldtp
from .identify.multipliers import (
    fit_multipliers as fit_multipliers,
    select_order as select_order,
)
from .identify.series.fit import fit_series as fit_series
from .identify.validate import validate as validate
from .io import load as load, save as save
from .linear.htf import HTF as HTF, Scatter as Scatter
from .linear.ldtp import LDTP as LDTP
from .mechanics.mechanism import Mechanism as Mechanism
from .orbits.coincidence import coincidences as coincidences
from .orbits.continuation import continuation as continuation
from .orbits.crossing import AtEvent as AtEvent, Crossing as Crossing
from .orbits.cycle import LimitCycle as LimitCycle
from .orbits.find import find_limit_cycle as find_limit_cycle
from .orbits.limit_cycles import find_limit_cycles as find_limit_cycles
from .plot.explore import explore as explore
from .recordings.identification import identify_recording as identify_recording
from .recordings.read import read_recording as read_recording
from .recordings.recording import Recording as Recording
from .scale.draws import monte_carlo as monte_carlo
from .scale.family import Points as Points
from .scale.sweep import sweep as sweep
from .sections.families import (
    AbstractLevels as AbstractLevels,
    AbstractSections as AbstractSections,
    ArcLength as ArcLength,
    BoundSections as BoundSections,
    ClockPhase as ClockPhase,
    KinematicPhase as KinematicPhase,
    SectionList as SectionList,
)
from .sections.linearize import linearize as linearize
from .sections.place import place_sections as place_sections
from .sections.section_map import section_map as section_map
from .systems.chart import Chart as Chart
from .systems.drawing import Drawing as Drawing
from .systems.quotient import Quotient as Quotient
from .systems.sliding import sliding as sliding
from .systems.solver import Radau as Radau
from .systems.system import (
    Guess as Guess,
    HybridSystem as HybridSystem,
    Output as Output,
    Parameter as Parameter,
    parameter as parameter,
)
from .systems.transition import Scheduled as Scheduled, Transition as Transition

__version__: str
