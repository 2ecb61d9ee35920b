"""The beginning of a search for a limit cycle: from a guess to a state on the section.

`return_map_near` takes the stages in order: it checks the guess, estimates the magnitudes of the
states and simulates for `settle`. If no clock drives the system, it then flows to the section and
back to it (`_on_section`). The time between gives the first guess of the period. The order of the
stages must stay, since flows need the magnitudes.

If a search begins at a wrong place, look at these stages in turn; if the section is not found, at
`_next_crossing`; if a cycle gets an unsuitable section, at `_on_section`, and at
`after_rarest_event` and `met_once`, which `find.py` calls for another one. The constants limit how
long it looks: change them if guesses are given up too early.
"""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._core.arguments import require_equal
from .._core.compilation import host_first
from .._core.executor import from_host, namespace, to_host
from .._core.precision import real
from .._core.progress import say
from .._core.results import Result
from .._core.text import signal_values
from ..engine import kernels
from ..engine.lanes import IDLE, Lanes, lane_at, side_by_side
from ..engine.move import Options, move
from ..engine.replay import recorded_moves
from ..engine.search.state import Moved
from ..engine.settings import TRANSIENT, Settings
from ..engine.target import Target, toward, until
from ..engine.trajectory import begins_beyond
from ..engine.watch import slopes
from ..errors import ComputationError, DefinitionError
from ..systems.start import own_guess
from ..systems.structure import Structure
from ..systems.system import Guess, HybridSystem
from .checks import check_claims
from .coincidence import SAME
from .crossing import AtEvent, Crossing, to_section
from .return_map import ReturnMap, Turn
from .scale import Sizes, fastest, in_sizes, scale_of, sizes_near, slow_time


# An autonomous system is given up if it does not return within this multiple of the time scale of
# the states at the guess. Smaller: slow cycles are lost. Larger: vain searches last longer.
_PATIENCE = 1000.0
# Before a search for the section is given up, its patience is extended this many times if the
# states have become slower than at the guess. Fewer: cycles are lost if the guess lies where the
# states are fast. More: vain searches last longer.
_LOOKS = 10
# On a slow manifold, the search waits this multiple of the time scale of the motion there, if that
# is longer; but each extension is at most this multiple of the time so far. Smaller: the search
# ends before the slow manifold is left. Larger: vain searches last longer.
_UNMOVED = 3.0
_LOOKS_FURTHER = 2.0
# Number of recorded steps in which events are counted. More: memory. Fewer: rare events are missed.
_RECORDED = 4096
# If a default section is missed, the next one is placed a little later than the event or the time
# at which the flow ended: by this part of the patience. Smaller: the section lies at the event.
# Larger: time.
_ONWARD = 3.7e-4
# States are at rest if they are closer to an equilibrium than this, in sizes of the states. Larger:
# slow cycles near an equilibrium count as being at rest. Smaller: errors of the flow count as
# motion.
_REST = 1e-5


class _Plane(eqx.Module):
    """The hyperplane through a point, across the flow (in sizes of the states)."""

    point: Array
    normal: Array

    def __call__(self, t, q):
        return jnp.dot(q - self.point, self.normal)


def is_default(section: Crossing | AtEvent | None) -> bool:
    """True for the plane through the guess, which is the section if none is given."""
    return isinstance(section, Crossing) and isinstance(section.signal, _Plane)


def return_map_near(
    s: Structure,
    guess: Guess | None,
    section: Crossing | AtEvent | None,
    multiplicity: int,
    settle: float,
    max_period: float | None,
    settings: Settings,
    given: Sizes,
) -> ReturnMap:
    """The return map at a guess (Default: the model's own), on a section, with a rough period.

    **Raises:** `DefinitionError` for a guess that does not fit the system; `ComputationError` if
    the flow does not lead from it to the section and back, or nothing moves.
    """
    guess = own_guess(s.system) if guess is None else guess
    lane = lane_at(s, guess.chart, guess.state, guess.time, "the guess")
    _check_event_before(s, guess)
    _check_field(s, guess, lane)
    lanes = from_host(lane)
    given_period = s.system.period()
    period = None if given_period is None else float(given_period)
    a = int(lane.chart[0])
    state = lane.q[:, 0]
    near = sizes_near(s, a, lane.t[0], state, period)
    settings = dataclasses.replace(settings, scale=scale_of(s, near.sizes | given))
    charts = np.arange(len(s.charts))
    times = np.repeat(lane.t, len(charts))
    check_claims(s, times, charts, near.points.T, settings.scale, near.time)
    map = ReturnMap(s.system, settings, lanes, None, real(np.nan), {}, multiplicity)
    if settle:
        map = _settled(map, float(settle), period)
    if period is not None:
        return dataclasses.replace(map, expected=real(multiplicity * period))
    base = section
    if base is None and guess.after is not None:
        base = AtEvent(guess.after)
    is_after = section is None and not settle
    return _on_section(map, base, is_after, near.time, max_period)


def _check_event_before(s: Structure, guess: Guess) -> None:
    """**Raises:** `DefinitionError` for a guess after an event that leads to another chart."""
    if guess.after is None:
        return
    event = s.transitions[s.transition_index(guess.after)]
    if event.target != guess.chart:
        raise DefinitionError(
            f"the guess is in chart '{guess.chart}', but the event '{event.name}', after which "
            f"it is said to be, leads to chart '{event.target}'."
        )


def _check_field(s: Structure, guess: Guess, lane: Lanes) -> None:
    """**Raises:** `DefinitionError` for a guess at which the field is not finite."""
    a = int(lane.chart[0])
    u = np.zeros((s.nu, 1))
    q = lane.q[: s.dims[a]]
    rows = kernels.field(s, a, lane.t, q, u)
    rate = rows[:, 0, 0]
    if not np.isfinite(rate).all():
        raise DefinitionError(
            f"the field of chart '{guess.chart}' at the guess, {guess.state}, is {rate}: start "
            "elsewhere, or look for a division by zero or a mass matrix that is singular or not "
            "positive."
        )


def _settled(map: ReturnMap, settle: float, period: float | None) -> ReturnMap:
    """The return map at the state to which the flow leads in the time `settle`; in a clocked
    system, after whole periods."""
    say("settling")
    lanes = map.anchor
    wait = settle if period is None else np.ceil(settle / period) * period
    end = np.asarray(lanes.t) + wait
    lanes = _go(map, "settling", lanes, toward(end, -1, end))
    if period is not None:
        begin = np.asarray(lanes.t) - wait
        lanes = lanes._replace(t=real(begin))
    return dataclasses.replace(map, anchor=lanes)


def _patience(map: ReturnMap, lanes: Lanes) -> float:
    """The time after which a search for a section is given up at a lane."""
    s = map.structure
    lane = to_host(lanes)
    a = int(lane.chart[0])
    t = float(lane.t[0])
    state = lane.q[:, 0]
    near = sizes_near(s, a, t, state, None)
    return _PATIENCE * max(near.time, slow_time(s, t, near.points))


def _time_of_motion(map: ReturnMap, lanes: Lanes) -> float:
    """The time in which the first of the states at a lane changes by its own magnitude."""
    s = map.structure
    lane = to_host(lanes)
    a = int(lane.chart[0])
    q = lane.q[: s.dims[a]]
    u = np.zeros((s.nu, 1))
    rows = kernels.field(s, a, lane.t, q, u)
    rates = rows[:, 0, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        times = np.abs(q[:, 0] / rates)
    return float(np.nanmin(times, initial=np.inf))


def _decays(map: ReturnMap, lanes: Lanes) -> bool:
    """Test whether a mode decays at a lane."""
    s = map.structure
    lane = to_host(lanes)
    a = int(lane.chart[0])
    state = lane.q[: s.dims[a]]
    (rate,) = fastest(s, a, lane.t, state)
    return bool(rate > 0)


def _on_section(
    map: ReturnMap,
    section: Crossing | AtEvent | None,
    is_after: bool,
    time: float,
    max_period: float | None,
    last: bool = False,
) -> ReturnMap:
    """The map of an autonomous system, with its anchor on the section and a rough period.

    **Arguments:** `section`; Default: the plane through the anchor, across the flow. `is_after`:
    whether the event of the section has just led to the anchor. `time`: time scale of the states.
    `max_period`: longest time until the section is reached. Default: from the time scales of the
    states. `last`: whether to give up if the default plane is missed; otherwise the next plane goes
    through the state at which the flow ended.
    """
    s = map.structure
    at_guess = map
    lanes = map.anchor
    a = int(np.asarray(lanes.chart)[0])
    q = np.asarray(lanes.q)[: s.dims[a], 0]
    with_section = dataclasses.replace(map, base=section)
    f, level, rate = jax.device_get(_at_anchor(with_section))
    f = f[: s.dims[a]]
    if not f.any():
        raise ComputationError(
            f"the search starts at an equilibrium of chart '{s.names[a]}', {q}, from where nothing "
            "moves: start elsewhere."
        )
    place = str(section)
    advice = ""
    rounding = -SAME * time * rate
    on_section = rate < 0 and abs(level) <= rounding  # up to rounding
    if isinstance(section, AtEvent):
        on_section = is_after
    if section is None:
        section = _across(map, a, q, f)
        on_section = True
        place = "through the guess, across the flow"
        advice = _another_section(s)
    map = dataclasses.replace(map, base=section)
    if not on_section:
        doing = "looking for the section"
        say(doing)
        moved, late = _next_crossing(map, section, lanes, max_period)
        lanes = _arrived(map, f"{doing} ({place})", moved, advice, late)
    back = lanes
    doing = "looking for the return to the section"
    for _ in range(map.multiplicity):
        say(doing)
        moved, late = _next_crossing(map, section, back, max_period)
        if is_default(section) and _misses(moved) and not last:
            say("a section where the flow has led")
            # (The flow that missed the section may have ended at an event.)
            longest = _ONWARD * _patience(map, moved.lanes)
            end = np.asarray(moved.lanes.t) + longest
            onward = _go(map, "settling", moved.lanes, toward(end, -1, end))
            later = dataclasses.replace(at_guess, anchor=onward)
            return _on_section(later, None, False, time, max_period, last=True)
        back = _arrived(map, f"{doing} ({place})", moved, advice, late)
    duration = np.asarray(back.t)[0] - np.asarray(lanes.t)[0]
    return dataclasses.replace(map, anchor=lanes, expected=real(duration))


def _across(map: ReturnMap, a: int, q: np.ndarray, f: np.ndarray) -> Crossing:
    """The plane through a state of chart a that is orthogonal to the field there, in sizes."""
    scale = np.asarray(map.scale)
    sizes = scale[a, : len(q)]
    length = np.linalg.norm(f / sizes)
    normal = f / sizes**2 / length
    plane = _Plane(real(q), real(normal))
    return Crossing(plane, "rising", charts=(map.structure.names[a],))


def _another_section(s: Structure) -> str:
    """Advice to choose a section, with an example."""
    example = f"Crossing({s.state_names()[0]!r}, 'rising')"
    if s.transitions:
        example = f"AtEvent({s.transitions[0].name!r})"
    return f"Choose a section that each turn crosses once, e.g. `section={example}`. "


def _misses(moved: Moved) -> bool:
    """Test whether a flow to a section was given up."""
    return int(np.asarray(moved.result)[0]) == Result.SECTION_MISSED


def _next_crossing(
    map: ReturnMap,
    section: Crossing | AtEvent,
    lanes: Lanes,
    max_period: float | None,
) -> tuple[Moved, str]:
    """The flow to the next crossing of a section; and advice for the message, if the section was
    not reached.

    **Raises:** `ComputationError` if the flow comes to rest before.
    """
    wait = _patience(map, lanes) if max_period is None else max_period
    begin = float(np.asarray(lanes.t)[0])
    for _ in range(_LOOKS):
        no_time = np.full(1, np.inf)
        last = np.asarray(lanes.t) + wait
        target = toward(no_time, -1, last)
        moved = _moved(map, lanes, to_section(target, section, map.event))
        end = float(np.asarray(moved.lanes.t)[0])
        waited = end - begin
        if not _misses(moved) or max_period is not None:
            break
        # (The states may have become slower than at the guess, or may drift away.)
        lanes = moved.lanes
        _require_motion(map, lanes)
        unmoved = min(_UNMOVED * _time_of_motion(map, lanes), _LOOKS_FURTHER * waited)
        wait = max(_patience(map, lanes), unmoved) - waited
        if wait <= 0 or not _decays(map, lanes):
            break
    late = (
        f"Allow more time than {waited:.3g}, by `max_period`, or for the slow modes of a stiff "
        'system, take `settings=Settings(solver="auto")`. '
    )
    if _misses(moved):
        _require_motion(map, moved.lanes)
        s = map.structure
        no_input = np.zeros((s.nu, 1))
        doubts = begins_beyond(s, to_host(map.anchor), no_input, waited)
        causes = [f"One cause may be that {x.text} " for x in doubts]
        late = "".join(causes) or late
    return moved, late


def after_rarest_event(map: ReturnMap, periods: int) -> Guess | None:
    """The state right after the rarest event within some periods from the anchor on, which is the
    section that a cycle meets least often. `None` without events."""
    s = map.structure
    lanes = to_host(map.anchor)
    end = lanes.t + periods * float(map.expected)
    accuracy = np.array(TRANSIENT)
    settings = Settings(accuracy, accuracy, _RECORDED, to_host(map.settings).scale)
    u = np.zeros((s.nu, 1))
    tape = move(s, lanes, u, until(end), settings, options=Options(tape=True)).tape
    assert tape is not None
    code = np.asarray(tape.code)[:, 0]
    follows = np.asarray(tape.at_once)[:, 0]
    # (An event that another event follows at once cannot be a section.)
    is_followed = np.append(follows[1:], False)
    happens = (code >= 0) & ~is_followed
    if not happens.any():
        return None
    happened = code[code >= 0]
    counts = np.bincount(happened, minlength=len(s.transitions))
    g = min(np.unique(code[happens]).tolist(), key=lambda g: counts[g])
    row = np.flatnonzero(happens & (code == g))[-1]
    a = int(tape.chart[row, 0])
    state = np.asarray(tape.after)[row, : s.dims[a], 0]
    name = s.transitions[g].name
    time = float(tape.t[row, 0])
    return Guess(s.names[a], state, time=time, after=name)


def met_once(map: ReturnMap, turn: Turn) -> ReturnMap | None:
    """For a turn that closes, the return map on a plane that the turn meets once; `None` if there
    is none. Planes are tried across the flow where the pieces of the turn begin."""
    s = map.structure
    tape = side_by_side(to_host(turn.tapes))
    pieces = to_host(turn.pieces)
    moves = recorded_moves(pieces, tape)
    lane, row = np.nonzero(tape.code.T != IDLE)
    ends = tape.before[row, :, lane].T
    no_input = np.zeros((s.nu, 1))
    f = slopes(s, pieces.t, pieces.chart, pieces.q, no_input)
    (begins,) = np.nonzero(moves.order == 0)
    for k in range(1, len(pieces.t)):
        a = int(pieces.chart[k])
        n = s.dims[a]
        state = pieces.q[:n, k]
        plane = _across(map, a, state, f[:n, k])
        signal: Any = plane.signal
        point = np.asarray(signal.point)
        normal = np.asarray(signal.normal)
        begins_from_point = moves.q[:n] - point[:, None]
        before = normal @ begins_from_point
        ends_from_point = ends[:n] - point[:, None]
        after = normal @ ends_from_point
        meets = (moves.chart == a) & (before <= 0) & (after >= 0)
        # (The moves before and after the beginning of the piece meet the plane there.)
        meets[begins[k] - 1 : begins[k] + 1] = False
        if meets.any():
            continue
        anchor = jax.tree_util.tree_map(lambda x, k=k: x[..., k : k + 1], pieces)
        return dataclasses.replace(map, anchor=anchor, base=plane, expected=turn.period)
    return None


def _require_motion(map: ReturnMap, lanes: Lanes) -> None:
    """**Raises:** `ComputationError` if the states of a lane are at rest."""
    s = map.structure
    lane = to_host(lanes)
    a = int(lane.chart[0])
    t = lane.t
    n = s.dims[a]
    u = np.zeros((s.nu, 1))
    rows = kernels.field(s, a, t, lane.q[:n], u)
    field = rows[..., 0]
    scale = np.asarray(map.scale)[a, :n]
    magnitude = np.abs(lane.q[:n, 0])
    sizes = np.maximum(magnitude, scale)
    rate = field[:, 0] / sizes
    by_state = field[:, 2 : 2 + n]
    jacobian = in_sizes(by_state, sizes)
    # (On a slow manifold rates are small, too. Newton's step gives the distance of the equilibrium,
    # which is large there.)
    distance = np.linalg.lstsq(jacobian, rate)[0]
    if np.any(np.abs(distance) > _REST):
        return
    # (A state that drifts at a constant rate is not near an equilibrium.)
    drift = rate - jacobian @ distance
    largest = np.abs(rate).max()
    if np.abs(drift).max() > 0.1 * largest:
        return
    beyond = []
    guards = s.guards(a)
    if guards:
        first = np.zeros(1, np.int32)
        expanded = kernels.watched(s, a, None, t, lane.q[:n], u, first)
        levels = expanded[:, 0, 0]
        passed = [g for g, level in zip(guards, levels, strict=True) if level < 0]
        beyond = [f"'{s.transitions[g].name}'" for g in passed]
    text = ""
    if beyond:
        text = (
            f" It lies beyond the guard of {', '.join(beyond)}, which cannot trigger."
        )
    # (States of the equilibrium are known up to the part `_REST` of their sizes: smaller values are
    # zero.)
    known = magnitude > _REST * scale
    place = np.where(known, lane.q[:n, 0], 0.0)
    place = signal_values(s.states(a), place)
    raise ComputationError(
        f"the flow from the guess leads to an equilibrium of chart '{s.names[a]}', {place}, where "
        f"nothing moves: start elsewhere.{text}"
    )


@host_first
def _at_anchor(map: ReturnMap):
    """The field (d,), and the value and rate of the level of a crossing."""
    section = to_section(until(map.anchor.t), map.base, -1)
    watched = map.watch(map.anchor, section)
    slope = map.slopes(map.anchor)[:, 0]
    value = watched.value[-1, 0]
    rate = watched.rate[-1, 0]
    return slope, value, rate


def _go(map: ReturnMap, doing: str, lanes: Lanes, target: Target) -> Lanes:
    """The lane at a target, however many steps it takes.

    **Raises:** `ComputationError`.
    """
    return _arrived(map, doing, _moved(map, lanes, target))


def _arrived(
    map: ReturnMap, doing: str, moved: Moved, advice: str = "", if_late: str = ""
) -> Lanes:
    """The lane at the end of a flow.

    **Raises:** `ComputationError` with advice, also with that for a section that is missed.
    """
    result = Result(int(np.asarray(moved.result)[0]))
    if result != Result.OK:
        lanes = to_host(moved.lanes)
        s = map.structure
        advice += if_late if result == Result.SECTION_MISSED else ""
        raise ComputationError(
            f"{doing} failed at t = {float(lanes.t[0]):.6g} in chart "
            f"'{s.names[int(lanes.chart[0])]}': {result.message}. {advice}Check the guess and "
            "the guards with `simulate(..., throw=False)`."
        )
    return moved.lanes


@host_first
def _moved(map: ReturnMap, lanes: Lanes, target: Target) -> Moved:
    """The flow of a lane to a target, of low accuracy, without inputs."""
    accuracy = np.array(TRANSIENT)
    settings = Settings(accuracy, accuracy, 1_000_000, map.scale)
    u = namespace(lanes.t).zeros((map.structure.nu, 1))
    return move(map.structure, lanes, u, target, settings).moved


def require_similar(guess: ReturnMap, system: HybridSystem) -> None:
    """**Raises:** `DefinitionError` if the cycle of a map cannot be a guess for another system."""
    maps = guess, dataclasses.replace(guess, system=system)
    sizes = [(len(x.structure.charts), x.structure.d) for x in maps]
    require_equal(
        "`guess` (a cycle) and the system", "numbers of charts and states", *sizes
    )
