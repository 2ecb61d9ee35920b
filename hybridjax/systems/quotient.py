"""Systems modulo a symmetry: legs that are relabeled, a position that has no effect."""

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
from .transition import TOGETHER, Scheduled, Transition
from .varied import parameter_of, with_parameters


@checked
class Quotient(Derived):
    """`system` modulo a symmetry. The symmetry is declared here, and the resets of `system` do not
    contain it.

    ```python
    walker = Quotient(Biped(), swap={"left stance": "right stance"}, relabel={"left": "right"},
                      translation=("x",))
    step = hj.find_limit_cycle(walker, section=hj.AtEvent("heelstrike"))
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
    - `translation`: states that have no effect on others, nor on outputs, such as the position
        along the floor. They are left out.
    - `half_period`: for cycles with x(t + T/2) = S x(t), with S from the arguments above. For a
        system that is driven by a clock: True. Otherwise: the name of a state, or a function of
        (t, q), that changes its sign under S and rises through zero once per half period. At this
        zero, or after half a period of the clock, the transition "half period" (with several
        charts, "half period (chart)") replaces the state by its mirror image. The multipliers of
        the full cycle are the squares of those of this half map. All charts are kept; if one is its
        own mirror image, its last transition is the image of its first. A clock becomes the state
        `clock`, the time since the transition, so that the system is autonomous. Default: False.

    Inputs are those of the charts that are kept; with `half_period`, they act on the mirror image
    in every second half of a cycle.

    **Raises:** `DefinitionError` if charts or states do not fit together and, when a cycle or a
    trajectory is computed, if a function does not have the symmetry; it names the function.
    Derivatives by a parameter that breaks the symmetry (the stiffness of one leg) are refused, and
    inside of `jit` a system that is made there with such a parameter.
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
        swap, relabel = dict(swap or {}), dict(relabel or {})
        if half_period:  # every chart is kept, and has an image
            swap |= {b: a for a, b in swap.items()}
            swap = {name: swap.get(name, name) for name in (*system.charts(), *swap)}
        partners = {b: a for a, b in relabel.items()} | relabel
        self.system, self.solver, self.half_period = system, system.solver, half_period
        self.pairs, self.names = tuple(swap.items()), tuple(partners.items())
        self.flipped, self.translation = tuple(flipped), tuple(translation)

    @property
    def swap(self) -> dict[str, str]:
        """Charts that are kept, each with its mirror image, which is left out."""
        return dict(self.pairs)

    @property
    def _kept_of(self) -> dict[str, str]:
        """Charts that are left out, each with its mirror image."""
        return {} if self.half_period else {b: a for a, b in self.pairs}

    def __check_init__(self):
        charts = self.system.charts()
        require_among("chart", (*self.swap, *self.swap.values()), charts, "Quotient: ")
        states = sorted({state for chart in charts.values() for state in chart.states})
        named = (*dict(self.names), *self.flipped, *self.translation)
        require_among("state", named, states, "Quotient: ")
        for kept, image in self.swap.items():
            mirrored = {self._partner(name) for name in charts[kept].states}
            if mirrored != set(charts[image].states):
                text = (
                    f"{sorted(mirrored)}, but '{image}' {sorted(charts[image].states)}"
                )
                raise DefinitionError(
                    f"Quotient: '{kept}' mirrored has {text}: use `relabel`."
                )
        if self.half_period:
            self._check_half_period()

    def _check_half_period(self):
        if (self.system.period() is not None) != (self.half_period is True):
            sentence = "True if a clock drives the system, else a state or a function of (t, q)"
            raise DefinitionError(f"Quotient: `half_period` must be {sentence}.")
        for x in self.system.transitions():
            if isinstance(x.guard, Scheduled) and not is_traced(x.guard):
                if abs(math.remainder(x.guard.offset / x.guard.period, 1.0)) < TOGETHER:
                    text = (
                        f"'{x.name}' must not be scheduled at t = 0, where halves begin"
                    )
                    raise DefinitionError(
                        f"Quotient: {text}: let the clock begin earlier."
                    )
        for name, x in (
            self.system.charts().items() if isinstance(self.half_period, str) else ()
        ):
            require_among(
                "state", [str(self.half_period)], x.states, f"Quotient: in '{name}' "
            )

    def period(self):
        return None if self.half_period else self.system.period()

    def charts(self):
        return {
            x: self._reduced(x) for x in self.system.charts() if x not in self._kept_of
        }

    def transitions(self):
        events = [x for x in self.system.transitions() if x.source not in self._kept_of]
        made = [self._transition(x, self._kept_of, 1.0) for x in events]
        return made + [self._transition(x, self.swap, 0.0) for x in self._halves()]

    def _transition(
        self, x: Transition, images: Mapping[str, str], clock: float
    ) -> Transition:
        """A transition, with the state in the image of its target; the clock is multiplied."""
        chart, guard, direction = self._reduced(x.source), x.guard, x.direction
        target, landed = self._landing(x, images)
        if isinstance(guard, Scheduled) and chart.clocked:
            guard, direction = _phase_of(guard), "rising"
        guard = guard if isinstance(guard, Scheduled) else chart.lifted(guard)
        enabled = None if x.enabled is None else chart.lifted(x.enabled)
        at, n = chart.lifted(landed), len(chart.kept)
        reset = lambda *point: jnp.append(at(*point), clock * point[1][n:])  # noqa: E731
        return Transition(x.name, x.source, target, guard, direction, reset, enabled)

    def _halves(self):
        """The ends of half a period, as transitions of the original system."""
        rises, period, charts = (
            self.half_period,
            self.system.period(),
            self.system.charts(),
        )
        for name in self.swap if rises else ():
            if period is not None:
                guard = lambda t, q, u: t - period / 2  # noqa: E731
            elif callable(rises):
                guard = lambda t, q, u: rises(t, q)  # noqa: E731
            else:
                place = charts[name].states.index(rises)
                guard = lambda t, q, u, k=place: q[k]  # noqa: E731
            title = "half period" + f" ({name})" * (len(self.pairs) > 1)
            yield Transition(title, name, name, guard, "rising")

    def guess(self):
        guess = self.system.guess()
        if guess is None or guess.chart not in self.charts():
            return None
        chart, period = self.charts()[guess.chart], self.system.period()
        state, time = chart.less(guess.state), guess.time
        if chart.clocked and period is not None:
            state, time = jnp.append(state, jnp.asarray(time) % (period / 2)), 0.0
        return Guess(guess.chart, state, time, after=guess.after)

    def outputs(self):
        charts, outputs = self.charts(), []
        for x in self.system.outputs():
            functions = (
                dict.fromkeys(charts, x.function)
                if callable(x.function)
                else x.function
            )
            kept = {
                name: charts[name].lifted(f)
                for name, f in functions.items()
                if name in charts
            }
            outputs.append(Output(x.name, kept, x.unit))
        return outputs

    def draw(self, chart: str, t: Float[Array, ""], q: Mapping[str, Any]):
        """The picture of the original system, which stands at the translation 0 and moves."""
        whole, still = self.system.charts()[chart], dict.fromkeys(self.translation, 0.0)
        state = jnp.stack(
            [jnp.asarray((still | dict(q))[x], float) for x in whole.states]
        )
        time = q["clock"] if self.charts()[chart].clocked else t
        drawing = self.system.draw(chart, time, {**q, **still})
        if drawing is None or len(self.translation) != 1:
            return drawing
        rates = as_vector(whole.field(t, state, jnp.zeros(len(self.inputs))))
        along = rates[whole.states.index(self.translation[0])]
        return eqx.tree_at(lambda x: x.velocity, drawing, jnp.stack([along, 0 * along]))

    def whole(self, at: Guess) -> tuple[HybridSystem, Guess] | None:
        """With `half_period`, the system whose cycle has both halves, and there a state of this."""
        if not self.half_period:
            return None
        if self.charts()[at.chart].clocked:
            at = Guess(at.chart, at.state[:-1], at.state[-1])
        still = self.translation
        return Quotient(self.system, translation=still) if still else self.system, at

    def _claims(self, sizes: Mapping[str, Any]):
        """The statements of the symmetry: a sentence for its failure, and two functions of
        (t, q, u) that are equal. The first numbers of q are the state without translations, in
        its `sizes`."""
        for name in self.system.charts() if self.translation else ():
            parts = (
                self._parts(name, self._kept_of, sizes, shift=x) for x in (0.0, 0.7)
            )
            for (what, before), (_, after) in zip(*parts, strict=True):
                yield f"the {what} changes under the translation", before, after
        clock: Any = self.system.period()
        images = self.swap if self.half_period else self._kept_of
        later = 0.5 * clock if self.half_period is True else 0.0
        for kept, other in self.swap.items():
            ours = list(self._parts(kept, self._kept_of, sizes))
            # In a chart that is its own mirror image, the last transition is that of the first.
            theirs = list(
                self._parts(other, images, sizes, later=later, back=kept == other)
            )
            if len(ours) != len(theirs):
                sentence = (
                    f"'{kept}' and '{other}' have different numbers of transitions"
                )
                yield sentence, lambda *_: 0.0, lambda *_: 1.0
            for (what, function), (name, image) in zip(ours, theirs, strict=False):
                yield (
                    f"the {name} is not the mirror image of the {what}",
                    function,
                    image,
                )

    def _parts(self, name, images, sizes, shift=None, later=0.0, back=False):
        """All functions of a chart, of points of the reduced one, with rates and states mirrored if
        the chart is among the `images`; transitions in the order of their list, or `back`; under a
        translation by `shift`, outputs, too."""
        kept = images.get(name, name)
        chart, mirrored = (
            self._reduced(kept),
            self._mirrored if name in images else _same,
        )
        n, moves = len(chart.kept), np.isin(chart.chart.states, self.translation)
        size = sizes[kept][:n]
        state = lambda q: mirrored(kept, chart.full(size * q[:n], shift or 0.0))  # noqa: E731
        field, used = (
            getattr(self.system.charts()[name], x) for x in ("field", "inputs")
        )
        used = slice(None if used is None else len(used))
        at = lambda f: lambda t, q, u: f(t + later, state(q), u[used])  # noqa: E731
        rates = lambda *point: mirrored(kept, as_vector(field(*point)), back=True)  # noqa: E731
        yield (
            f"field of chart '{name}'",
            at(lambda *point: chart.less(rates(*point)) / size),
        )
        yield f"field of chart '{name}'", at(lambda *point: rates(*point)[moves])
        for x in list(self.system.transitions())[:: -1 if back else 1]:
            if x.source == name:
                (target, reset), guard = self._landing(x, images), x.guard
                if isinstance(guard, Scheduled):
                    guard = _phase_of(guard)
                into = sizes[target][: len(self._reduced(target).kept)]
                yield (
                    f"transition '{x.name}'",
                    at(lambda *y, r=reset, c=into: r(*y) / c),
                )
                yield (
                    f"transition '{x.name}'",
                    at(lambda *y, g=guard, x=x: x.sign * g(*y)),
                )
        for x in self.system.outputs() if shift is not None else ():
            function = x.function if callable(x.function) else x.function.get(name)
            if function is not None:
                yield f"output '{x.name}'", at(function)
        sign = -1.0 if name in images else 1.0
        for x in self._halves() if self.system.period() is None else ():
            if x.source == name and callable(x.guard):
                yield (
                    f"sign of '{x.name}'",
                    at(lambda *point, g=x.guard: sign * g(*point)),
                )

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
            new = mirrored(target, as_vector(x.reset(t, q, u)), back=True)
            return self._reduced(target).less(new)

        return target, reset

    def _partner(self, name: str) -> str:
        return dict(self.names).get(name, name)

    def _mirrored(self, kept: str, q: Any, back: bool = False):
        """The mirror image of a state of a chart that is kept, or with `back`, of a state of its
        image."""
        charts = self.system.charts()
        source, target = charts[kept].states, charts[self.swap[kept]].states
        if back:
            source, target = target, source
        order = [source.index(self._partner(name)) for name in target]
        names = target if back else map(self._partner, target)
        return q[np.array(order)] * np.array(
            [-1.0 if x in self.flipped else 1.0 for x in names]
        )


@jax.ensure_compile_time_eval()
def check_symmetry(
    system: HybridSystem, sizes: Any = None, along: str | None = None
) -> None:
    """Raise an error if functions, or with `along` their derivatives by this parameter, do not have
    the symmetry that a `Quotient` states.

    **Arguments:** `sizes`: magnitudes of the states of each chart. Default: 1. (In units in
    which states are small, states of 1 hide all but the highest powers.)
    """
    if not isinstance(system, Quotient):
        return
    check_symmetry(system.system, None, along and along.removeprefix("system."))
    sizes = sizes or {
        name: np.ones(len(x.states)) for name, x in system.charts().items()
    }
    clock, rng = system.system.period(), np.random.default_rng(0)
    q = rng.normal(size=(3, max(map(len, sizes.values()))))
    t = rng.normal(size=3) * (1.0 if clock is None else clock)
    values = _sides(system, sizes, q, t, along)
    for (sentence, *_), pair in zip(system._claims(sizes), values, strict=True):
        size = np.nanmax(np.abs(pair[0]), initial=0.0) or 1.0
        x, y = (values / size for values in pair)
        if x.shape != y.shape or not np.allclose(x, y, rtol=0, equal_nan=True):
            text = f"{type(system.system).__name__} does not have the symmetry of its Quotient"
            raise DefinitionError(
                f"{text}{f' once {along!r} changes' * bool(along)}: {sentence}."
            )


@eqx.filter_jit
def _sides(quotient: Any, sizes: Any, q: Any, t: Any, along: str | None) -> list[tuple]:
    """Both sides of all claims of a symmetry, or with `along` their derivatives by a parameter."""
    if along:
        at = lambda x: _sides(with_parameters(quotient, {along: x}), sizes, q, t, None)  # noqa: E731
        return jax.jvp(at, (parameter_of(quotient, along),), (1.0,))[1]
    u, claims = (
        jnp.zeros(len(quotient.inputs)),
        [x for _, *x in quotient._claims(sizes)],
    )
    return jax.vmap(
        lambda q, t: [tuple(as_vector(f(t, q, u)) for f in x) for x in claims]
    )(q, t)


def _same(kept: str, q: Any, back: bool = False):
    return q


def _phase_of(guard: Scheduled) -> Callable:
    """A function that rises through zero at scheduled times."""
    return lambda t, q, u: jnp.sin(2 * jnp.pi * (t - guard.offset) / guard.period)


class _Reduced(DerivedChart):
    """A chart without the states of a translation; if `clocked`, the time is its last state."""

    translation: Sequence[str] = eqx.field(static=True)
    clocked: bool = eqx.field(static=True)

    @property
    def kept(self) -> np.ndarray:
        return np.array(
            [k for k, x in enumerate(self.chart.states) if x not in self.translation]
        )

    @property
    def states(self) -> tuple[str, ...]:  # type: ignore[override]
        return *(self.chart.states[k] for k in self.kept), *("clock",) * self.clocked

    @property
    def units(self) -> tuple[str, ...]:  # type: ignore[override]
        units = self.chart.units
        return (*(units[k] for k in self.kept), *("",) * self.clocked) if units else ()

    def full(self, q, shift=0.0):
        """The state of the whole chart, translated by a shift."""
        kept = self.kept
        return jnp.full(len(self.chart.states), shift).at[kept].set(q[: len(kept)])

    def less(self, q):
        return jnp.asarray(q)[self.kept]

    def lifted(self, function: Callable) -> Callable:
        """A function of the whole chart's state, of the reduced one."""
        return lambda t, q, u: function(q[-1] if self.clocked else t, self.full(q), u)

    def field(self, t, q, u):
        rates = self.less(as_vector(self.lifted(self.chart.field)(t, q, u)))
        return jnp.append(rates, 1.0) if self.clocked else rates
