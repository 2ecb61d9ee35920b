from .advice import Advice as Advice, advise as advise, plain_regression as plain_regression
from .beats.cross_validation import (
    IntervalForecast as IntervalForecast,
    forecast_intervals as forecast_intervals,
)
from .beats.response import PhaseResponse as PhaseResponse, phase_response as phase_response
from .data import SectionData as SectionData
from .design_tables import (
    add_command as add_command,
    read_design as read_design,
    write_design as write_design,
)
from .drift import without_drift as without_drift
from .held_out import (
    HeldOut as HeldOut,
    choose_order as choose_order,
    hold_out as hold_out,
)
from .identification import Identification as Identification
from .impulse import ImpulseResponses as ImpulseResponses, impulse_responses as impulse_responses
from .inspection.finding import Finding as Finding, Inspection as Inspection
from .inspection.look import inspect as inspect, inspect_cycles as inspect_cycles
from .phase.estimation import PhaseDefinition as PhaseDefinition, estimate_phase as estimate_phase
from .phase.tracker import PhaseTracker as PhaseTracker
from .phase.winding import Phase as Phase, Winding as Winding
from .recording import Trial as Trial
from .sampling import section_data as section_data
from .variability.natural import (
    NaturalMultipliers as NaturalMultipliers,
    natural_multipliers as natural_multipliers,
)
