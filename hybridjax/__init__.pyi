from . import models as models, plot as plot
from ._core.cache import enable_compilation_cache as enable_compilation_cache
from ._core.errors import (
    ComputationError as ComputationError,
    DefinitionError as DefinitionError,
    FileFormatError as FileFormatError,
    HybridJaxError as HybridJaxError,
    PrecisionError as PrecisionError,
)
from ._core.kernels import enable_loop_kernels as enable_loop_kernels
from ._core.precision import enable_x64 as enable_x64
from ._core.results import Result as Result
from .experiments.crest import optimise_phases as optimise_phases
from .experiments.data import (
    ExperimentData as ExperimentData,
    simulate_experiments as simulate_experiments,
)
from .experiments.design import Design as Design
from .experiments.multisine import (
    multisine as multisine,
    paper_design as paper_design,
    single_cosine as single_cosine,
)
from .experiments.records import add_noise as add_noise, odd_part as odd_part
from .experiments.respond import Response as Response
from .experiments.response import (
    ResponseFunction as ResponseFunction,
    response_function as response_function,
)
from .experiments.run import (
    run_experiments as run_experiments,
    stream_experiments as stream_experiments,
)
from .experiments.steady import steady_start as steady_start
from .fitting.fit import fit_model as fit_model, identifiability as identifiability
from .fitting.identifiability import Identifiability as Identifiability
from .fitting.model_fit import ModelFit as ModelFit
from .fitting.observations import (
    AbstractObservation as AbstractObservation,
    ObservedCycle as ObservedCycle,
    ObservedHTF as ObservedHTF,
    ObservedSeries as ObservedSeries,
)
from .fitting.stability import spectral_radius as spectral_radius
from .flow.move import Settings as Settings
from .flow.sections import (
    AtEvent as AtEvent,
    ClockPhase as ClockPhase,
    Crossing as Crossing,
    KinematicPhase as KinematicPhase,
    Sections as Sections,
)
from .flow.trajectory import Event as Event, Trajectory as Trajectory, simulate as simulate
from .identify.aaa import AAAFit as AAAFit, fit_aaa as fit_aaa
from .identify.amplitude import (
    AmplitudeSweep as AmplitudeSweep,
    amplitude_sweep as amplitude_sweep,
)
from .identify.bound import (
    MultiplierBound as MultiplierBound,
    multiplier_bound as multiplier_bound,
)
from .identify.coherence import (
    Coherence as Coherence,
    estimate_coherence as estimate_coherence,
)
from .identify.compare import MultiplierComparison as MultiplierComparison
from .identify.distortion import (
    OutputLevels as OutputLevels,
    output_levels as output_levels,
)
from .identify.leakage import predict_leakage as predict_leakage
from .identify.nonparametric import (
    estimate_htf as estimate_htf,
    missing_frequencies as missing_frequencies,
)
from .identify.order import (
    OrderSelection as OrderSelection,
    select_order as select_order,
)
from .identify.rational import RationalFit as RationalFit, fit_rational as fit_rational
from .identify.realise import realise as realise
from .identify.records import Record as Record
from .identify.series import SeriesFit as SeriesFit, fit_series as fit_series
from .identify.structured import (
    StructuredFit as StructuredFit,
    fit_multipliers as fit_multipliers,
)
from .identify.transient import (
    TransientFit as TransientFit,
    remove_transient as remove_transient,
)
from .identify.validate import Validation as Validation, validate as validate
from .io import load as load, save as save
from .orbits.branch import Branch as Branch, BranchEnd as BranchEnd, BranchPoint as BranchPoint
from .orbits.cycle import LimitCycle as LimitCycle, find_limit_cycle as find_limit_cycle
from .orbits.follow import follow as follow
from .orbits.linearize import linearize as linearize
from .orbits.maps import (
    Arrival as Arrival,
    SectionMap as SectionMap,
    section_map as section_map,
)
from .orbits.place import place_sections as place_sections
from .orbits.placed import PlacedSections as PlacedSections
from .orbits.sweep import (
    LimitCycles as LimitCycles,
    find_limit_cycles as find_limit_cycles,
)
from .periodic.htf import HTF as HTF
from .periodic.ldtp import LDTP as LDTP
from .periodic.synthetic import synthetic_ldtp as synthetic_ldtp
from .recording_report import write_report as write_report
from .recordings.advice import (
    Advice as Advice,
    advise as advise,
    choose_order as choose_order,
    hold_out as hold_out,
    plain_regression as plain_regression,
)
from .recordings.drift import without_drift as without_drift
from .recordings.identification import (
    Identification as Identification,
    identify_recording as identify_recording,
)
from .recordings.impulse import (
    ImpulseResponses as ImpulseResponses,
    impulse_responses as impulse_responses,
)
from .recordings.phase import (
    AnglePhase as AnglePhase,
    CrossingPhase as CrossingPhase,
    EventPhase as EventPhase,
    estimate_phase as estimate_phase,
)
from .recordings.read import read_recording as read_recording
from .recordings.recording import Recording as Recording
from .recordings.sections import SectionData as SectionData, section_data as section_data
from .recordings.simulated import (
    random_force as random_force,
    simulate_recording as simulate_recording,
)
from .recordings.spoil import spoil as spoil
from .recordings.tables import (
    add_command as add_command,
    read_design as read_design,
    write_design as write_design,
)
from .recordings.tracker import PhaseTracker as PhaseTracker
from .store import (
    StoredExperiments as StoredExperiments,
    store_experiments as store_experiments,
)
from .systems.chart import Chart as Chart
from .systems.output import Output as Output
from .systems.system import (
    Guess as Guess,
    HybridSystem as HybridSystem,
    parameter as parameter,
)
from .systems.transition import Scheduled as Scheduled, Transition as Transition

__version__: str
