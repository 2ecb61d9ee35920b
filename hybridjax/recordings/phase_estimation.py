"""From a definition of phase to the phase of a recording."""

from .._core.boundary.checked import checked
from ..errors import DefinitionError
from ..orbits.crossing import AtEvent, Crossing
from ..sections.families import KinematicPhase
from .angle import from_angles, kinematic_angles
from .events import from_crossings, from_events
from .phase import Phase
from .recording import Recording, signal_of
from .smoothing import Bandwidth


PhaseDefinition = KinematicPhase | Crossing | AtEvent
"""Definition of the phase of a recording; see `estimate_phase`."""


@checked
def estimate_phase(
    recording: Recording, definition: PhaseDefinition, *, bandwidth: Bandwidth | None = None
) -> Phase:
    """Estimate the phase of every trial.

    **Arguments:**

    - `definition`, one of
        - a `KinematicPhase`: the angle of two signals about a center, counted in the sense in which
          it turns.
        - a `Crossing`: the phase grows by one from each crossing of a level by a signal to the
          next, linearly in between. The signal should cross the level once in each cycle in this
          direction, and fast: at mid-stance, at the apex.
        - `AtEvent`: the phase grows by one from each recorded event to the next, linearly in
          between. Events that follow the one before by less than half of the trial's median period
          are taken for doubled and left out; where an interval is longer than 1.5 median periods an
          event was missed, and these cycles are left out. In irregular rhythms, with intervals of
          all lengths, these limits are the first gaps in the distribution of intervals. A crossing
          in a gap counts as missed. This phase, and that of a `Crossing`, depends on the next
          event, and so do the outputs sampled at it.
    - `bandwidth`: bandwidth in Hz of the splines through the signals. Default: 32 harmonics of the
      cycle for a `KinematicPhase`, 16 for a `Crossing`.

    Angles that run backwards in noise are replaced by the mean of the two monotone envelopes, one
    from below and one from above. Stretches end at gaps longer than a quarter of a cycle: in the
    signals of an angle, or in all signals where the phase comes from crossings or events.

    **Raises:** `DefinitionError` for unknown signals or events, sections that a recording cannot
    have (functions of a state, charts), a phase that does not wind, or a recording of less than two
    cycles.
    """
    if isinstance(definition, Crossing):
        return from_crossings(recording, definition, bandwidth)
    if isinstance(definition, KinematicPhase):
        angles = kinematic_angles(recording, definition, bandwidth)
        return from_angles(angles, definition.n_sections)
    if bandwidth is not None:
        raise DefinitionError("events are not smoothed: no `bandwidth`.")
    return from_events(recording, definition)


def signals_of(definition: PhaseDefinition) -> set[str]:
    """Return the signals that define the phase, as far as the definition names them."""
    if isinstance(definition, Crossing):
        return {signal_of(definition)}
    if isinstance(definition, KinematicPhase):
        anchor = definition.anchor
        at_anchor = signals_of(anchor) if isinstance(anchor, Crossing) else set()
        return {definition.position, definition.velocity} | at_anchor
    return set()
