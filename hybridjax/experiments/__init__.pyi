from .data import Simulated as Simulated
from .design.crest import optimize_phases as optimize_phases
from .design.multisine import single_cosine as single_cosine
from .events import EventTimes as EventTimes, ExperimentEvent as ExperimentEvent
from .flow_batch import IntervalEvents as IntervalEvents, Response as Response
from .linear_model import simulate_experiments as simulate_experiments
from .noise import ProcessNoise as ProcessNoise
from .postprocess import add_noise as add_noise, odd_part as odd_part
from .record import HasRecords as HasRecords
from .response_function import ResponseFunction as ResponseFunction
from .run import stream_experiments as stream_experiments
from .steady import steady_start as steady_start
from .stepping.plan import Plan as Plan, Stepping as Stepping
from .stored.store import StoredExperiments as StoredExperiments
