"""From a definition of phase to the phase of a recording."""

from ..._core.boundary.checked import checked
from ...errors import DefinitionError
from ...orbits.crossing import AtEvent, Crossing
from ...sections.families import KinematicPhase
from ..recording import Recording, signal_of
from ..smoothing import Bandwidth
from .angle import AngleFunction, from_angles, function_angles, kinematic_angles
from .crossings import from_crossings, from_events
from .winding import Phase


PhaseDefinition = KinematicPhase | Crossing | AtEvent | AngleFunction
"""What the phase of a recording may be defined by; see `estimate_phase`."""


@checked
def estimate_phase(
    recording: Recording,
    definition: PhaseDefinition,
    *,
    bandwidth: Bandwidth | None = None,
    causal: bool = False,
) -> Phase:
    """The phase of every trial.

    **Arguments:**

    - `definition`, one of
        - a `KinematicPhase`: the angle of two signals about a center, counted in the sense in which
          it turns.
        - a `Crossing`: grows by one from each crossing of a level by a signal to the next, linearly
          in between. The signal should cross the level once in each cycle in this direction, and
          fast: at mid-stance, at the apex.
        - `AtEvent`: grows by one from each recorded event to the next, linearly in between. Events
          that follow the one before by less than half of the trial's median period are taken for
          doubled and left out; where an interval is longer than 1.5 median periods one was missed,
          and these cycles are left out. In irregular rhythms, whose intervals are of all lengths,
          these limits are where the lengths end: at the first gap in their distribution. A
          crossing in a gap counts as missed. Since this phase, and
          that of a `Crossing`, depends on the event that comes next, so do the outputs sampled at
          it.
        - a function of the times (n,) and the signals by name, that returns an angle (n,) in rad,
          with or without its whole turns, NaN where it is not known.
    - `bandwidth`: in Hz, of the splines through the signals of a `KinematicPhase` (by default 32
      harmonics of the cycle) or a `Crossing` (16).
    - `causal`: from the past only, as hardware in real time would find it: an angle by a
      `PhaseTracker`; from events by the duration of the last cycle, which remembers three cycles
      (fit it with `overhang=2 * n_sections`).

    Angles that run backwards in noise are replaced by the mean of the two monotone envelopes, one
    from below and one from above. Stretches end at gaps longer than a quarter of a cycle: of the
    signals of an angle, and of all signals where the phase comes from crossings or events.

    **Raises:** `DefinitionError` for signals or events that are not there, sections that a
    recording cannot have (functions of a state, charts), a phase that does not wind, or a recording
    of less than two cycles.
    """
    if isinstance(definition, Crossing):
        return from_crossings(recording, definition, bandwidth, causal)
    if isinstance(definition, KinematicPhase):
        if causal and bandwidth is not None:
            raise DefinitionError("an angle from the past only is not smoothed: no `bandwidth`.")
        angles = kinematic_angles(recording, definition, bandwidth, smooth=not causal)
        return from_angles(angles, definition.n_sections, causal)
    if bandwidth is not None:
        raise DefinitionError("events, and functions, are not smoothed: no `bandwidth`.")
    if isinstance(definition, AtEvent):
        return from_events(recording, definition, causal)
    return from_angles(function_angles(recording, definition), None, causal)


def signals_of(definition: PhaseDefinition) -> set[str]:
    """The signals from which the phase is found, as far as the definition names them."""
    if isinstance(definition, Crossing):
        return {signal_of(definition)}
    if isinstance(definition, KinematicPhase):
        anchor = definition.anchor
        at_anchor = signals_of(anchor) if isinstance(anchor, Crossing) else set()
        return {definition.position, definition.velocity} | at_anchor
    return set()
