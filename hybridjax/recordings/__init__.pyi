from .advice import (
    Advice as Advice,
    HeldOut as HeldOut,
    advise as advise,
    choose_order as choose_order,
    hold_out as hold_out,
    plain_regression as plain_regression,
)
from .design_tables import (
    add_command as add_command,
    read_design as read_design,
    write_design as write_design,
)
from .drift import without_drift as without_drift
from .identification import Identification as Identification
from .impulse import ImpulseResponses as ImpulseResponses, impulse_responses as impulse_responses
from .phase import (
    AnglePhase as AnglePhase,
    CrossingPhase as CrossingPhase,
    EventPhase as EventPhase,
    Phase as Phase,
    estimate_phase as estimate_phase,
)
from .recording import Trial as Trial
from .sampling import SectionData as SectionData, section_data as section_data
from .tracker import PhaseTracker as PhaseTracker
