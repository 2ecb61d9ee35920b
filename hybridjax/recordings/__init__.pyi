from .beats.response import phase_response as phase_response
from .design_tables import add_command as add_command, write_design as write_design
from .fit_warnings import advise as advise
from .held_out import choose_order as choose_order, hold_out as hold_out
from .impulse import impulse_responses as impulse_responses
from .inspection.inspect import inspect as inspect
from .natural import natural_multipliers as natural_multipliers
from .phase_estimation import estimate_phase as estimate_phase
from .population.maps import PopulationMaps as PopulationMaps
from .population.population import Population as Population
from .sampling import section_data as section_data
