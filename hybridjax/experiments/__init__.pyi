from .data import simulate_experiments as simulate_experiments
from .design.crest import optimize_phases as optimize_phases
from .design.multisine import single_cosine as single_cosine
from .periodic_response import steady_start as steady_start
from .postprocess import add_noise as add_noise, odd_part as odd_part
from .record import HasRecords as HasRecords
from .respond import Response as Response
from .response_function import ResponseFunction as ResponseFunction
from .run import stream_experiments as stream_experiments
from .store import StoredExperiments as StoredExperiments, store_experiments as store_experiments
