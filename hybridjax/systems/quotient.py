"""`Symmetric`: a system modulo a symmetry, so that one step is a whole cycle.

Two kinds of symmetry are possible: charts are mirror images of each other (legs change their
roles), and a translation of some states has no effect (the distance walked). `Symmetric` keeps one
chart of each pair and leaves out the translated states (`_Reduced`). A transition into a chart that
is left out leads to its mirror image (`_landing`). With `half_period`, all charts are kept, and one
more transition mirrors the state (`_halves`).

`check_symmetry` tests, at random points, the statements (`_claims`) that would follow from the
symmetry: the functions of a chart (`_View`) are those of its image, and do not depend on the
translation. `_View` says again what `_Reduced.field`, `_transition` and `outputs` do: a change
there needs one in `_View`.

If a symmetry that is right is refused, look at `_mirrored` (order and signs of states) and `_View`.
If multipliers are wrong without an error, look at `_landing` (which chart) and, with `half_period`,
at `_halves` and the clock in `_transition`.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._core.arguments import require_among
from .._core.boundary.checked import checked
from .._core.boundary.kinds import SignalNames
from .._core.executor import is_traced
from ..errors import DefinitionError
from .chart import DerivedChart
from .structure import as_vector
from .system import Derived, Guess, HybridSystem, Output, name_of
from .transition import TOGETHER, Scheduled, Transition
from .varied import parameter_of, with_parameters


@checked
class Symmetric(Derived):
    """`system` modulo a symmetry. The symmetry is declared here, and the resets of `system` do not
    contain it.

    ```python
    walker = Symmetric(Biped(), swap={"left stance": "right stance"}, relabel={"left": "right"},
                      translation=("x",))
    step = hj.find_limit_cycle(walker, section=hj.AtEvent("heelstrike"))
    ```

    Of two charts that are mirror images of each other, one is left out. A transition into it leads
    into the other chart, and mirrors the state. A step is therefore a cycle, and two steps are a
    stride. Let S be the symmetry and P the map of a step of `system`. A step has the multipliers of
    S P. A stride has those of (S P)^2, which are their squares.

    **Arguments:**

    - `system`: written in full, with its guess in a chart that is kept.
    - `swap`: charts that are mirror images of each other, {kept: left out}. The transitions of
        both are listed in the same order.
    - `relabel`: states that are exchanged in the mirror, {name: name}, in either order.
    - `flipped`: states that change their sign in the mirror.
    - `translation`: states that have no effect on others, nor on outputs, such as the position
        along the floor. They are left out.
    - `half_period`: True for a system that is driven by a clock. Otherwise: the name of a state, or
        a function of (t, q), that changes its sign under the symmetry and rises through zero once
        per half period. Default: False.

    Inputs act on the state in the charts that are kept, which is the mirrored one in every second
    step. With `half_period`, they act on the mirrored state in every second half of a cycle.

    **Half periods:** `half_period` is for cycles with x(t + T/2) = S x(t), with S from the other
    arguments. At the zero of the function, or after half a period of the clock, the transition
    "half period" (with several charts, "half period (chart)") replaces the state by its mirror
    image. The multipliers of the full cycle are the squares of those of this half map. All charts
    are kept. In a chart that is its own mirror image, list the transitions such that the last is
    the image of the first, the last but one that of the second, and so on. A clock becomes the
    state `clock`, the time since the transition, so that the system is autonomous.

    **Raises:** `DefinitionError` if charts or states do not fit together. When a cycle or a
    trajectory is computed, `DefinitionError` if a function does not have the symmetry; the message
    names the function. A derivative with respect to a parameter that breaks the symmetry (the
    stiffness of one leg) raises an error. A system that is made inside of `jit` with such a
    parameter raises an error, too.
    """

    pairs: tuple[tuple[str, str], ...] = eqx.field(static=True)
    names: tuple[tuple[str, str], ...] = eqx.field(static=True)
    flipped: tuple[str, ...] = eqx.field(static=True)
    translation: tuple[str, ...] = eqx.field(static=True)
    half_period: str | Callable | bool = eqx.field(static=True)

    def __init__(
        self,
        system: HybridSystem,
        swap: Mapping[str, str] | None = None,
        relabel: Mapping[str, str] | None = None,
        flipped: SignalNames = (),
        translation: SignalNames = (),
        half_period: str | Callable | bool = False,
    ):
        swap = dict(swap or {})
        relabel = dict(relabel or {})
        if half_period:  # every chart is kept, and has an image
            swap |= {b: a for a, b in swap.items()}
            swap = {name: swap.get(name, name) for name in (*system.charts(), *swap)}
        partners = {b: a for a, b in relabel.items()} | relabel
        self.system = system
        self.solver = system.solver
        self.half_period = half_period
        self.pairs = tuple(swap.items())
        self.names = tuple(partners.items())
        self.flipped = tuple(flipped)
        self.translation = tuple(translation)

    @property
    def swap(self) -> dict[str, str]:
        """The mirror image of each chart that is kept; with `half_period`, of every chart."""
        return dict(self.pairs)

    @property
    def _kept_of(self) -> dict[str, str]:
        """The chart that is kept, for each chart that is left out."""
        return {} if self.half_period else {b: a for a, b in self.pairs}

    def __check_init__(self):
        charts = self.system.charts()
        require_among("chart", (*self.swap, *self.swap.values()), charts, "Symmetric: ")
        states = sorted(set().union(*(chart.states for chart in charts.values())))
        named = (*dict(self.names), *self.flipped, *self.translation)
        require_among("state", named, states, "Symmetric: ")
        for kept, image in self.swap.items():
            mirrored = {self._partner(name) for name in charts[kept].states}
            if mirrored != set(charts[image].states):
                raise DefinitionError(
                    f"Symmetric: '{kept}' mirrored has {sorted(mirrored)}, but '{image}' "
                    f"{sorted(charts[image].states)}: use `relabel`."
                )
        if self.half_period:
            self._check_half_period()

    def _check_half_period(self):
        if (self.system.period() is not None) != (self.half_period is True):
            raise DefinitionError(
                "Symmetric: `half_period` must be True if a clock drives the system, else a state "
                "or a function of (t, q)."
            )
        for x in self.system.transitions():
            if not isinstance(x.guard, Scheduled) or is_traced(x.guard):
                continue
            phase = math.remainder(x.guard.offset / x.guard.period, 1.0)
            if abs(phase) < TOGETHER:
                raise DefinitionError(
                    f"Symmetric: '{x.name}' must not be scheduled at t = 0, where halves begin: "
                    "let the clock begin earlier."
                )
        if isinstance(self.half_period, str):
            for name, chart in self.system.charts().items():
                here = f"Symmetric: in '{name}' "
                require_among("state", [self.half_period], chart.states, here)

    def period(self):
        return None if self.half_period else self.system.period()

    def charts(self):
        kept = [x for x in self.system.charts() if x not in self._kept_of]
        return {name: self._reduced(name) for name in kept}

    def transitions(self):
        events = [x for x in self.system.transitions() if x.source not in self._kept_of]
        halves = [self._transition(x, self.swap, False) for x in self._halves()]
        return [self._transition(x, self._kept_of, True) for x in events] + halves

    def _transition(
        self,
        x: Transition,
        images: Mapping[str, str],
        keeps_clock: bool,
    ) -> Transition:
        """A transition of the original system, which leads to the image of its target. The state
        `clock` goes on, or starts again at 0."""
        chart = self._reduced(x.source)
        guard = x.guard
        direction = x.direction
        target, landed = self._landing(x, images)
        if not isinstance(guard, Scheduled):
            guard = chart.lifted(guard)
        elif chart.clocked:
            guard = chart.lifted(_phase_of(guard))
            direction = "rising"
        enabled = None if x.enabled is None else chart.lifted(x.enabled)
        state_after = chart.lifted(landed)
        n = len(chart.kept)
        factor = 1.0 if keeps_clock else 0.0

        def reset(t, q, u):
            return jnp.append(state_after(t, q, u), factor * q[n:])

        return Transition(x.name, x.source, target, guard, direction, reset, enabled)

    def _halves(self):
        """The ends of half a period, as transitions of the original system."""
        if not self.half_period:
            return
        for name in self.swap:
            title = "half period" if len(self.pairs) == 1 else f"half period ({name})"
            yield Transition(title, name, name, self._end_of_half(name), "rising")

    def _end_of_half(self, name: str) -> Callable:
        """A function (t, q, u) of a chart that rises through zero after half a period."""
        rises = self.half_period
        period = self.system.period()
        if period is not None:
            return lambda t, q, u: t - period / 2
        if callable(rises):
            return lambda t, q, u: rises(t, q)
        place = self.system.charts()[name].states.index(rises)
        return lambda t, q, u: q[place]

    def guess(self):
        guess = self.system.guess()
        if guess is None or guess.chart not in self.charts():
            return None
        chart = self.charts()[guess.chart]
        period = self.system.period()
        state = chart.less(guess.state)
        time = guess.time
        if chart.clocked and period is not None:
            state = jnp.append(state, jnp.asarray(time) % (period / 2))
            time = 0.0
        return Guess(guess.chart, state, time, after=guess.after)

    def outputs(self):
        charts = self.charts()
        outputs = []
        for x in self.system.outputs():
            lifted = {}
            for name, chart in charts.items():
                function = x.in_chart(name)
                if function is not None:
                    lifted[name] = chart.lifted(function)
            outputs.append(Output(x.name, lifted, x.unit))
        return outputs

    def draw(self, chart: str, t: Float[Array, ""], q: Mapping[str, Any]):
        """Return the picture of the original system at the translation 0. Its
        `velocity` is the speed of the translation."""
        time = q["clock"] if self.charts()[chart].clocked else t
        states = {**q, **dict.fromkeys(self.translation, 0.0)}
        drawing = self.system.draw(chart, time, states)
        if drawing is None or len(self.translation) != 1:
            return drawing
        speed = self._speed(chart, time, states)
        return eqx.tree_at(lambda x: x.velocity, drawing, jnp.stack([speed, 0 * speed]))

    def _speed(self, chart: str, time: Any, states: Mapping[str, Any]):
        """The rate of the only translated state, without inputs."""
        whole = self.system.charts()[chart]
        q = jnp.stack([jnp.asarray(states[x], float) for x in whole.states])
        rates = as_vector(whole.field(time, q, jnp.zeros(len(self.inputs))))
        return rates[whole.states.index(self.translation[0])]

    def whole(self, at: Guess) -> tuple[HybridSystem, Guess] | None:
        """With `half_period`: the original system, whose cycle has both halves, and the given state
        in it. Otherwise None."""
        if not self.half_period:
            return None
        if self.charts()[at.chart].clocked:
            state = at.state[:-1]
            at = Guess(at.chart, state, at.state[-1])
        if not self.translation:
            return self.system, at
        return Symmetric(self.system, translation=self.translation), at

    def _claims(self, sizes: Mapping[str, Any]):
        """Iterate over the statements of the symmetry. Each is a sentence for the error, and two
        functions of (t, q, u) that must be equal (see `_View`)."""
        if self.translation:
            yield from self._claims_of_translation(sizes)
        clock: Any = self.system.period()
        images = self.swap if self.half_period else self._kept_of
        later = 0.5 * clock if self.half_period is True else 0.0
        for kept, image in self.swap.items():
            ours = list(_View(self, kept, self._kept_of, sizes).functions())
            view = _View(self, image, images, sizes, later=later)
            # In a chart that is its own mirror image, the last transition is the mirror image of
            # the first.
            theirs = list(view.functions(reversed_order=kept == image))
            if len(ours) != len(theirs):
                sentence = (
                    f"'{kept}' and '{image}' have different numbers of transitions"
                )
                yield sentence, lambda *_: 0.0, lambda *_: 1.0
            for (what, function), (name, mirrored) in zip(ours, theirs, strict=False):
                sentence = f"the {name} is not the mirror image of the {what}"
                yield sentence, function, mirrored

    def _claims_of_translation(self, sizes: Mapping[str, Any]):
        for name in self.system.charts():
            here = _View(self, name, self._kept_of, sizes, shift=0.0)
            there = _View(self, name, self._kept_of, sizes, shift=0.7)
            before = [*here.functions(), *here.outputs()]
            after = [*there.functions(), *there.outputs()]
            for (what, first), (_, second) in zip(before, after, strict=True):
                yield f"the {what} changes under the translation", first, second

    def _reduced(self, name: str) -> "_Reduced":
        clocked = bool(self.half_period) and self.system.period() is not None
        return _Reduced(self.system.charts()[name], self.translation, clocked)

    def _landing(
        self, x: Transition, images: Mapping[str, str]
    ) -> tuple[str, Callable]:
        """The chart to which a transition leads, or its image, and the state there."""
        target = images.get(x.target, x.target)
        mirrored = self._mirrored if x.target in images else _same

        def reset(t, q, u):
            after = mirrored(target, as_vector(x.reset(t, q, u)), from_image=True)
            return self._reduced(target).less(after)

        return target, reset

    def _partner(self, name: str) -> str:
        return dict(self.names).get(name, name)

    def _mirrored(self, kept: str, q: Any, from_image: bool = False):
        """The mirror image of a state of a chart that is kept, or of a state of the image of this
        chart."""
        charts = self.system.charts()
        source = charts[kept].states
        target = charts[self.swap[kept]].states
        if from_image:
            source, target = target, source
        order = [source.index(self._partner(name)) for name in target]
        in_kept = target if from_image else [self._partner(x) for x in target]
        signs = np.where([x in self.flipped for x in in_kept], -1.0, 1.0)
        return q[np.array(order)] * signs


class _View:
    """The functions of a chart of the original system, for comparisons, as functions of points (t,
    q, u) of its reduced chart.

    The first numbers of q are the state without translated states, in units of `sizes`. For a chart
    among the `images`, {chart: its mirror image}, the points are those of the image, and states and
    rates are mirrored. Translated states are `shift`, and the time is later by `later`.
    """

    def __init__(
        self,
        symmetric: Symmetric,
        name: str,
        images: Mapping[str, str],
        sizes: Mapping[str, Any],
        shift: float = 0.0,
        later: Any = 0.0,
    ):
        self.symmetric = symmetric
        self.system = symmetric.system
        self.name = name
        self.images = images
        self.sizes = sizes
        self.shift = shift
        self.later = later
        self.kept_chart = images.get(name, name)
        self.chart = self.system.charts()[name]
        self.reduced = symmetric._reduced(self.kept_chart)
        self.mirrored = symmetric._mirrored if name in images else _same

    def at(self, function: Callable, scale: Any = None) -> Callable:
        """A function of the chart, divided by a scale, as a function of reduced points."""
        n = len(self.reduced.kept)
        size = self.sizes[self.kept_chart][:n]
        inputs = self.chart.inputs
        used = slice(None if inputs is None else len(inputs))

        def of_reduced(t, q, u):
            whole = self.reduced.full(size * q[:n], self.shift)
            state = self.mirrored(self.kept_chart, whole)
            value = function(t + self.later, state, u[used])
            return value if scale is None else value / scale

        return of_reduced

    def functions(self, reversed_order: bool = False):
        """Iterate over the names and functions of field and transitions."""
        yield from self._fields()
        yield from self._transitions(reversed_order)
        yield from self._ends_of_halves()

    def outputs(self):
        """Iterate over the names and functions of outputs."""
        for x in self.system.outputs():
            function = x.in_chart(self.name)
            if function is not None:
                yield f"output '{x.name}'", self.at(function)

    def _fields(self):
        reduced = self.reduced
        moves = np.isin(reduced.chart.states, self.symmetric.translation)
        size = self.sizes[self.kept_chart][: len(reduced.kept)]

        def rates(t, q, u):
            original = as_vector(self.chart.field(t, q, u))
            return self.mirrored(self.kept_chart, original, from_image=True)

        title = f"field of chart '{self.name}'"
        yield title, self.at(lambda *point: reduced.less(rates(*point)), size)
        yield title, self.at(lambda *point: rates(*point)[moves])

    def _transitions(self, reversed_order: bool):
        transitions = [x for x in self.system.transitions() if x.source == self.name]
        if reversed_order:
            transitions.reverse()
        for x in transitions:
            target, reset = self.symmetric._landing(x, self.images)
            size_after = self.sizes[target][: len(self.symmetric._reduced(target).kept)]
            guard = _phase_of(x.guard) if isinstance(x.guard, Scheduled) else x.guard
            yield f"transition '{x.name}'", self.at(reset, size_after)
            yield f"transition '{x.name}'", self.at(guard, x.sign)
            yield f"`enabled` of transition '{x.name}'", self.at(_enabled(x))

    def _ends_of_halves(self):
        if self.system.period() is not None:
            return
        sign = -1.0 if self.name in self.images else 1.0
        for x in self.symmetric._halves():
            if x.source == self.name and callable(x.guard):
                yield f"sign of '{x.name}'", self.at(x.guard, sign)


@jax.ensure_compile_time_eval()
def check_symmetry(
    system: HybridSystem, sizes: Any = None, along: str | None = None
) -> None:
    """Raise an error if functions, or with `along` their derivatives by this parameter, do not have
    the symmetry that a `Symmetric` states.

    **Arguments:** `sizes`: magnitudes of the states of each chart. Default: 1. (With states of
    magnitude 1 in unsuitable units, the highest powers would hide all other terms.)
    """
    if not isinstance(system, Symmetric):
        return
    check_symmetry(system.system, None, along and along.removeprefix("system."))
    if not sizes:
        charts = system.charts()
        sizes = {name: np.ones(len(chart.states)) for name, chart in charts.items()}
    clock = system.system.period()
    rng = np.random.default_rng(0)
    q = rng.normal(size=(3, max(map(len, sizes.values()))))
    t = rng.normal(size=3) * (1.0 if clock is None else clock)
    values = _sides(system, sizes, q, t, along)
    for (sentence, *_), pair in zip(system._claims(sizes), values, strict=True):
        largest = np.nanmax(np.abs(pair[0]), initial=0.0) or 1.0
        left, right = (side / largest for side in pair)
        if left.shape != right.shape or not np.allclose(
            left, right, rtol=0, equal_nan=True
        ):
            once = f" once {along!r} changes" if along else ""
            raise DefinitionError(
                f"{name_of(system.system)} does not have the symmetry of its "
                f"Symmetric{once}: {sentence}."
            )


@eqx.filter_jit
def _sides(quotient: Any, sizes: Any, q: Any, t: Any, along: str | None) -> list[tuple]:
    """Both sides of all claims of a symmetry, or with `along` their derivatives by a parameter."""
    if along:

        def at(x):
            return _sides(with_parameters(quotient, {along: x}), sizes, q, t, None)

        return jax.jvp(at, (parameter_of(quotient, along),), (1.0,))[1]
    u = jnp.zeros(len(quotient.inputs))

    def at_a_point(q, t):
        values = []
        for _, first, second in quotient._claims(sizes):
            left = as_vector(first(t, q, u))
            right = as_vector(second(t, q, u))
            values.append((left, right))
        return values

    return jax.vmap(at_a_point)(q, t)


def _same(kept: str, q: Any, from_image: bool = False):
    """The state itself, where `_mirrored` would mirror it."""
    return q


def _enabled(x: Transition) -> Callable:
    """Whether a transition may happen: 1 or 0."""
    enabled = x.enabled
    if enabled is None:
        return lambda t, q, u: 1.0
    return lambda t, q, u: jnp.asarray(enabled(t, q, u), float)


def _phase_of(guard: Scheduled) -> Callable:
    """A function that rises through zero at scheduled times."""
    return lambda t, q, u: jnp.sin(2 * jnp.pi * (t - guard.offset) / guard.period)


class _Reduced(DerivedChart):
    """A chart without the translated states. If `clocked`, the time is its last state."""

    translation: Sequence[str] = eqx.field(static=True)
    clocked: bool = eqx.field(static=True)

    @property
    def kept(self) -> np.ndarray:
        return np.flatnonzero(~np.isin(self.chart.states, self.translation))

    @property
    def states(self) -> tuple[str, ...]:  # type: ignore[override]
        kept = tuple(self.chart.states[k] for k in self.kept)
        return (*kept, "clock") if self.clocked else kept

    @property
    def units(self) -> tuple[str, ...]:  # type: ignore[override]
        units = self.chart.units
        if not units:
            return ()
        kept = tuple(units[k] for k in self.kept)
        return (*kept, "") if self.clocked else kept

    def full(self, q, shift=0.0):
        """The state of the whole chart, translated by a shift."""
        kept = self.kept
        state = jnp.full(len(self.chart.states), shift)
        return state.at[kept].set(q[: len(kept)])

    def less(self, q):
        return jnp.asarray(q)[self.kept]

    def lifted(self, function: Callable) -> Callable:
        """A function of the whole chart's state, of the reduced one."""

        def of_reduced(t, q, u):
            time = q[-1] if self.clocked else t
            return function(time, self.full(q), u)

        return of_reduced

    def field(self, t, q, u):
        whole = as_vector(self.lifted(self.chart.field)(t, q, u))
        rates = self.less(whole)
        return jnp.append(rates, 1.0) if self.clocked else rates
