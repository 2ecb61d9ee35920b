"""Systems modulo a symmetry: legs that are relabeled, a position that has no effect."""

import dataclasses
import functools as ft
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
from .system import Derived, Guess, HybridSystem, Output
from .transition import Scheduled, Transition


@checked
class Quotient(Derived):
    """`system` modulo a symmetry. The symmetry is declared here, and the resets of `system` do not
    contain it.

    ```python
    walker = Quotient(Biped(), swap={"left stance": "right stance"}, relabel={"left": "right"},
                      translation=("x",))
    step = hj.find_limit_cycle(walker, section=hj.AtEvent("heelstrike"))
    stride = hj.find_limit_cycle(walker, step, multiplicity=2)
    ```

    A transition into a chart that was left out leads into its mirror image, with the state
    mirrored, so that a step is a cycle; two steps are a stride. With S the symmetry and P the map
    of a step of `system`, the multipliers of a step are those of S P, and those of the stride,
    (S P)^2, are their squares.

    **Arguments:**

    - `system`: written in full, with its guess in a chart that is kept.
    - `swap`: charts that are mirror images of each other, {kept: left out}. The transitions of
        both are listed in the same order.
    - `relabel`: states that are exchanged in the mirror, {name: name}, in either order.
    - `flipped`: states that change their sign in the mirror.
    - `translation`: states that have no effect on others, such as the position along the floor.
        They are left out.
    - `half_period`: for cycles with x(t + T/2) = S x(t), with S from the arguments above. True if a
        clock drives the system; otherwise the name of a state, or a function of (t, q), that S
        multiplies by -1 and that rises through zero once in half a period. There, or after half a
        period of the clock, the transition "half period" (with several charts, "half period
        (chart)") puts the mirror image of the state. The
        multipliers are those of this half map, whose squares are those of the cycle. All charts are
        kept; if one is its own mirror image, its last transition is the image of its first. The
        state `clock`, the time since that transition, makes a system with a clock autonomous.
        Default: False.

    Inputs are those of the charts that are kept; with `half_period`, they act on the mirror image
    in every second half of a cycle.

    **Raises:** `DefinitionError` if charts or states do not fit together and, when a cycle is
    looked for, if a function does not have the symmetry; it names the function.
    """

    pairs: tuple[tuple[str, str], ...] = eqx.field(static=True)
    names: tuple[tuple[str, str], ...] = eqx.field(static=True)
    flipped: tuple[str, ...] = eqx.field(static=True)
    translation: tuple[str, ...] = eqx.field(static=True)

    def __init__(
        self,
        system: HybridSystem,
        swap: Mapping[str, str] | None = None,
        relabel: Mapping[str, str] | None = None,
        flipped: SignalNames = (),
        translation: SignalNames = (),
        half_period: str | Callable | bool = False,
    ):
        if half_period:
            images = {**(swap or {}), **{b: a for a, b in (swap or {}).items()}}
            images = {name: images.get(name, name) for name in system.charts()}
            system = _Halves(system, half_period, tuple(images.items()))
            swap = {name: image + SECOND for name, image in images.items()}
        self.system, self.solver = system, system.solver
        self.pairs, self.names = (tuple((x or {}).items()) for x in (swap, relabel))
        self.flipped, self.translation = (
            (x,) if isinstance(x, str) else tuple(x) for x in (flipped, translation)
        )

    @property
    def swap(self) -> dict[str, str]:
        """Charts that are kept, each with its mirror image, which is left out."""
        return dict(self.pairs)

    @property
    def relabel(self) -> dict[str, str]:
        """States that are exchanged."""
        return dict(self.names)

    def __check_init__(self):
        charts = self.system.charts()
        require_among("chart", (*self.swap, *self.swap.values()), charts, "Quotient: ")
        states = sorted({state for chart in charts.values() for state in chart.states})
        named = (*self.relabel, *self.relabel.values(), *self.flipped, *self.translation)
        require_among("state", named, states, "Quotient: ")
        for kept, left_out in self.swap.items():
            mirrored = {self._partner(name) for name in charts[kept].states}
            if mirrored != set(charts[left_out].states):
                raise DefinitionError(
                    f"Quotient: mirrored, chart '{kept}' has the states {sorted(mirrored)}, but "
                    f"chart '{left_out}' has {sorted(charts[left_out].states)}: give the states "
                    "that are exchanged by `relabel`."
                )

    def charts(self):
        left_out = set(self.swap.values())
        charts = self.system.charts().items()
        return {name: _Reduced(x, self.translation) for name, x in charts if name not in left_out}

    def transitions(self):
        left_out = self.swap.values()
        return [self._transition(x) for x in self.system.transitions() if x.source not in left_out]

    def _transition(self, x: Transition) -> Transition:
        at = self._reduced(x.source).lifted
        target, reset = self._landing(x)
        guard = x.guard if isinstance(x.guard, Scheduled) else at(x.guard)
        enabled = None if x.enabled is None else at(x.enabled)
        return Transition(x.name, x.source, target, guard, x.direction, at(reset), enabled)

    def guess(self):
        guess = self.system.guess()
        if guess is None or guess.chart not in self.charts():
            return None
        state = self.charts()[guess.chart].less(guess.state)
        return Guess(guess.chart, state, guess.time, after=guess.after)

    def outputs(self):
        charts, outputs = self.charts(), []
        for x in self.system.outputs():
            functions = dict.fromkeys(charts, x.function) if callable(x.function) else x.function
            kept = {name: charts[name].lifted(f) for name, f in functions.items() if name in charts}
            outputs.append(Output(x.name, kept, x.unit))
        return outputs

    def draw(self, chart: str, t: Float[Array, ""], q: Mapping[str, Any]):
        """The picture of the original system, which stands at the translation 0 and moves."""
        whole, still = self.system.charts()[chart], dict.fromkeys(self.translation, 0.0)
        state = jnp.stack([jnp.asarray((still | dict(q))[x], float) for x in whole.states])
        drawing = self.system.draw(chart, t, {**q, **still})
        if drawing is None or len(self.translation) != 1:
            return drawing
        rates = as_vector(whole.field(t, state, jnp.zeros(len(self.inputs))))
        along = rates[whole.states.index(self.translation[0])]
        return eqx.tree_at(lambda x: x.velocity, drawing, jnp.stack([along, 0 * along]))

    def whole(self, at: Guess) -> tuple[HybridSystem, Guess] | None:
        """With `half_period`, the system whose cycle has both halves, and there a state of this."""
        if not isinstance(halves := self.system, _Halves):
            return None
        full = halves.system
        if full.period() is not None:
            at = Guess(at.chart, at.state[:-1], at.state[-1])
        return Quotient(full, translation=self.translation) if self.translation else full, at

    def check(self) -> None:
        """Raise an error for a function that does not have the symmetry."""
        if is_traced(self):
            return
        claims = list(self._claims())
        rng, d = np.random.default_rng(0), max(len(c.states) for c in self.system.charts().values())
        u = jnp.zeros(len(self.inputs))

        @jax.jit
        @jax.vmap
        def both(q, t):
            return [tuple(as_vector(f(t, q, u)) for f in pair) for _, *pair in claims]

        values = both(rng.normal(size=(3, d)), rng.normal(size=3))
        for (sentence, *_), pair in zip(claims, values, strict=True):
            if not _equal(*pair):
                full = self.system.system if isinstance(self.system, _Halves) else self.system
                raise DefinitionError(
                    f"{type(full).__name__} does not have the symmetry of its Quotient: {sentence}."
                )

    def _claims(self):
        """The statements of the symmetry: a sentence for its failure, and two functions of
        (t, q, u) that are equal. The first numbers of q are the state without translations."""
        charts, events = self.system.charts(), self.system.transitions()
        kept_of = {name: name for name in charts} | {b: a for a, b in self.swap.items()}

        def parts(name, shift=0.0):
            """All functions of a chart, with rates mirrored back if it is left out."""
            kept = kept_of[name]
            back = lambda x: x if name == kept else self._mirrored(kept, x, back=True)  # noqa: E731
            field = lambda *point: back(as_vector(charts[name].field(*point)))  # noqa: E731
            named = [(f"transition '{x.name}'", self._event(x)) for x in events if x.source == name]
            for what, function in [(f"field of chart '{name}'", field), *named]:
                yield what, ft.partial(of_kept, function, name, shift)

        def of_kept(function, name, shift, t, q, u):
            kept = kept_of[name]
            chart = self._reduced(kept)
            state = chart.full(q[: len(chart.kept)], shift)
            return function(t, state if name == kept else self._mirrored(kept, state), u)

        for name in charts if self.translation else ():
            for (what, before), (_, after) in zip(parts(name), parts(name, 0.7), strict=True):
                yield f"the {what} changes under the translation", before, after
        for kept, other in self.swap.items():
            ours, images = list(parts(kept)), list(parts(other))
            if len(ours) != len(images):
                sentence = f"'{kept}' and '{other}' have different numbers of transitions"
                yield sentence, lambda *_: 0.0, lambda *_: 1.0
            for (what, function), (name, image) in zip(ours, images, strict=False):
                yield f"the {name} is not the mirror image of the {what}", function, image

    def _reduced(self, name: str) -> "_Reduced":
        return _Reduced(self.system.charts()[name], self.translation)

    def _landing(self, x: Transition) -> tuple[str, Callable]:
        """The chart to which a transition leads, one that is kept, and the state there."""
        target = {left_out: kept for kept, left_out in self.swap.items()}.get(x.target, x.target)

        def reset(t, q, u):
            new = as_vector(x.reset(t, q, u))
            mirrored = new if target == x.target else self._mirrored(target, new, back=True)
            return self._reduced(target).less(mirrored)

        return target, reset

    def _event(self, x: Transition) -> Callable:
        """Guard and reset of a transition, as one vector."""
        (_, reset), guard = self._landing(x), x.guard
        if isinstance(guard, Scheduled):
            return reset
        return lambda t, q, u: jnp.append(reset(t, q, u), x.sign * guard(t, q, u))

    def _partner(self, name: str) -> str:
        back = {b: a for a, b in self.relabel.items()}
        return self.relabel.get(name, back.get(name, name))

    def _mirrored(self, kept: str, q: Any, back: bool = False):
        """The mirror image of a state of a chart that is kept, or with `back`, of a state of its
        image."""
        charts = self.system.charts()
        source, target = charts[kept].states, charts[self.swap[kept]].states
        if back:
            source, target = target, source
        order = [source.index(self._partner(name)) for name in target]
        names = target if back else map(self._partner, target)
        return q[np.array(order)] * np.array([-1.0 if x in self.flipped else 1.0 for x in names])


SECOND = " (second half)"
# Distance from the begin of a half, in periods, at which a scheduled transition coincides with it.
# Smaller: it is missed. Larger: ones that are distinct are refused.
SAME_TIME = 1e-9


class _Halves(Derived):
    """A system whose charts have copies for the second half of a cycle."""

    half_period: str | Callable | bool = eqx.field(static=True)
    images: tuple[tuple[str, str], ...] = eqx.field(static=True)

    def __check_init__(self):
        if (self.system.period() is not None) != (self.half_period is True):
            sentence = "True if a clock drives the system, else a state or a function of (t, q)"
            raise DefinitionError(f"Quotient: `half_period` must be {sentence}.")
        for x in self.system.transitions():
            if isinstance(x.guard, Scheduled) and not is_traced(x.guard):
                if abs(math.remainder(x.guard.offset / x.guard.period, 1.0)) < SAME_TIME:
                    raise DefinitionError(
                        f"Quotient: with `half_period`, '{x.name}' must not be scheduled at t = 0, "
                        "where halves begin: let the clock begin earlier."
                    )
        for name, chart in self.system.charts().items():
            named = [self.half_period] if isinstance(self.half_period, str) else []
            require_among("state", named, chart.states, f"Quotient: in '{name}' ")

    def period(self):
        return None

    def charts(self):
        period, charts = self.system.period(), self.system.charts().items()
        first, later = (None, None) if period is None else (0.0, period / 2)
        pairs = [(x, "", first) for x in charts] + [(x, SECOND, later) for x in charts]
        return {name + when: _Half(chart, later) for (name, chart), when, later in pairs}

    def transitions(self):
        charts, events, made = self.charts(), list(self.system.transitions()), []
        for when, other, sign in (("", SECOND, 1), (SECOND, "", -1)):
            for name, image in self.images:
                chart = charts[name + when]
                copies = [chart.copied(x, when) for x in events if x.source == name]
                guard, places = ft.partial(self._switch, chart, sign), (name + when, name + other)
                made += copies[::-1] if when and name == image else copies
                title = "half period" + f" ({name})" * (len(self.images) > 1)
                made += [Transition(title, *places, guard, "rising", chart.anew)]
        return made

    def _switch(self, chart: "_Half", sign: int, t, q, u):
        if (period := self.system.period()) is not None:
            return q[-1] - period / 2
        if callable(self.half_period):
            return sign * self.half_period(t, q)
        return sign * q[chart.chart.states.index(self.half_period)]

    def guess(self):
        guess, period = self.system.guess(), self.system.period()
        if guess is None or period is None:
            return guess
        clock = jnp.asarray(guess.time) % (period / 2)
        return Guess(guess.chart, jnp.append(guess.state, clock), after=guess.after)

    def outputs(self):
        charts, outputs = self.charts(), []
        for x in self.system.outputs():
            given = dict.fromkeys(charts, x.function) if callable(x.function) else x.function
            lifted = {name: charts[name].lifted(f) for name, f in given.items()}
            outputs.append(Output(x.name, lifted, x.unit))
        return outputs

    def draw(self, chart, t, q):
        return self.system.draw(chart.removesuffix(SECOND), q.get("clock", t), q)


class _Half(DerivedChart):
    """A chart in one half of a cycle: with the time since its begin, if a clock drives the system,
    and then for times that are `later` by so much."""

    later: Any

    @property
    def states(self) -> tuple[str, ...]:  # type: ignore[override]
        return (*self.chart.states, *(() if self.later is None else ("clock",)))

    @property
    def units(self) -> tuple[str, ...]:  # type: ignore[override]
        extra = () if self.later is None or not self.chart.units else ("",)
        return (*self.chart.units, *extra)

    def lifted(self, function: Callable) -> Callable:
        if self.later is None:
            return function
        return lambda t, q, u: function(q[-1] + self.later, q[:-1], u)

    def field(self, t, q, u):
        rates = as_vector(self.lifted(self.chart.field)(t, q, u))
        return rates if self.later is None else jnp.append(rates, 1.0)

    def anew(self, t, q, u):
        """The state when the other half begins."""
        return q if self.later is None else jnp.append(q[:-1], 0.0)

    def copied(self, x: Transition, when: str) -> Transition:
        """A transition of this half; the clock goes on."""
        at, guard, kept = self.lifted, x.guard, slice(len(self.chart.states), None)
        if isinstance(tick := x.guard, Scheduled):
            guard = lambda t, q, u: jnp.sin(2 * jnp.pi * (t - tick.offset) / tick.period)  # noqa: E731
            x = dataclasses.replace(x, direction="rising")
        assert callable(guard)
        reset = lambda t, q, u: jnp.append(as_vector(at(x.reset)(t, q, u)), q[kept])  # noqa: E731
        copy = dataclasses.replace(x, guard=at(guard), reset=reset)
        copy = dataclasses.replace(copy, enabled=x.enabled and at(x.enabled))
        return dataclasses.replace(copy, source=x.source + when, target=x.target + when)


class _Reduced(DerivedChart):
    """A chart without the states of a translation."""

    translation: Sequence[str] = eqx.field(static=True)

    @property
    def kept(self) -> np.ndarray:
        return np.array([k for k, x in enumerate(self.chart.states) if x not in self.translation])

    @property
    def states(self) -> tuple[str, ...]:  # type: ignore[override]
        return tuple(self.chart.states[k] for k in self.kept)

    @property
    def units(self) -> tuple[str, ...]:  # type: ignore[override]
        return tuple(self.chart.units[k] for k in self.kept) if self.chart.units else ()

    def full(self, q, shift=0.0):
        """The state of the whole chart, translated by a shift."""
        return jnp.full(len(self.chart.states), shift).at[self.kept].set(q)

    def less(self, q):
        return jnp.asarray(q)[self.kept]

    def lifted(self, function: Callable) -> Callable:
        """A function of the whole chart's state, of the reduced one."""
        return lambda t, q, u: function(t, self.full(q), u)

    def field(self, t, q, u):
        return self.less(as_vector(self.chart.field(t, self.full(q), u)))


def _equal(x, y):
    size = np.nanmax(np.abs(x), initial=0.0) or 1.0
    return x.shape == y.shape and np.allclose(x / size, y / size, rtol=0, equal_nan=True)
