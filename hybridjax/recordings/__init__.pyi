from ..apps.subjects import SubjectStudy as SubjectStudy
from .beats.response import (
    IntervalForecast as IntervalForecast,
    PhaseResponse as PhaseResponse,
    phase_response as phase_response,
)
from .data import SectionData as SectionData
from .design_tables import attach_design as attach_design
from .findings import Inspection as Inspection
from .fit_warnings import Diagnosis as Diagnosis, diagnose as diagnose
from .held_out import (
    HeldOut as HeldOut,
    HeldOutOrders as HeldOutOrders,
    hold_out as hold_out,
)
from .identification import (
    Identification as Identification,
    NaturalIdentification as NaturalIdentification,
)
from .impulse import (
    ImpulseResponses as ImpulseResponses,
    impulse_responses as impulse_responses,
)
from .inspection.inspect import check_recording as check_recording
from .natural import (
    NaturalMultipliers as NaturalMultipliers,
    natural_multipliers as natural_multipliers,
)
from .phase import Phase as Phase
from .phase_estimation import estimate_phase as estimate_phase
from .population.maps import MapResult as MapResult, PopulationMaps as PopulationMaps
from .population.population import Population as Population
from .recording import Trial as Trial
from .sampling import sample_sections as sample_sections
