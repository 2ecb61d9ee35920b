"""All models of the campaign.

They are fixed before the first run of hybridjax on them: this is what the benchmark promises. Later
models get a new file, which names its own date. Afterwards only errors of the harness and errors
against the sources are mended; no model and no guess changes in order to pass.

Changes since the first run: the words of `truth` of "pulse vaccination" (its cycle without
infection is unstable) and of "buck, comparator on at the tick, duty 0". The checker follows the
rules of docs/mathematics.md for guards beyond zero after a reset and for clocks that tick together,
which were written after the models, and a motion that settles beyond a guard is no cycle.
"""

import models_converters
import models_mechanics
import models_neurons
import models_oscillators
import models_relays
import models_schedules


GROUPS = {
    "oscillators": models_oscillators.MODELS,
    "relays": models_relays.MODELS,
    "neurons": models_neurons.MODELS,
    "converters": models_converters.MODELS,
    "mechanics": models_mechanics.MODELS,
    "schedules": models_schedules.MODELS,
}
MODELS = tuple(model for group in GROUPS.values() for model in group)
