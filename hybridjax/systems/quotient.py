"""Systems modulo a symmetry: legs that trade their names, a place that does not matter."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._core.boundary.checked import checked
from .._core.boundary.kinds import SignalNames
from .._core.executor import is_traced
from ..errors import DefinitionError
from .chart import Chart
from .output import Output
from .system import Guess, HybridSystem
from .transition import Scheduled, Transition


# States at which symmetry is looked for. Twice as many: hardly a function is found that is
# symmetric at these and not at others.
_SAMPLES = 3
# How far functions may be apart, relative to the largest of their numbers.
_EQUAL = 1e-9
# How far states are translated to see whether it matters. Any number does.
_SHIFT = 0.7


@checked
class Quotient(HybridSystem):
    """`system` modulo a symmetry, which is declared here once and written into no reset.

    ```python
    walker = Quotient(Biped(), swap={"left stance": "right stance"}, relabel={"left": "right"},
                      translation=("x",))
    step = hj.find_limit_cycle(walker, section=hj.AtEvent("heelstrike"))
    stride = hj.find_limit_cycle(walker, step, multiplicity=2)
    ```

    What leads into a chart that was left out leads into its mirror image, with the state mirrored,
    so that a step is a cycle already; two of them are a stride. With S the symmetry and P the map
    of a step of `system`, the multipliers of a step are those of S P, and those of the stride,
    (S P)^2, are their squares.

    **Arguments:**

    - `system`: written in full, with its own guess in a chart that is kept.
    - `swap`: charts that are mirror images of each other, {kept: left out}. The transitions of
        both stand in the same order.
    - `relabel`: states that trade their names in the mirror, {name: name}, in either order.
    - `flipped`: states that change their sign.
    - `translation`: states on which nothing else depends, such as the place along the floor. They
        are left out.

    Inputs are those of the charts that are kept.

    **Raises:** `DefinitionError` where charts or states do not fit together, and, when a cycle is
    looked for, with the name of a function that has not the symmetry.
    """

    system: HybridSystem
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
    ):
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
        """States that trade their names."""
        return dict(self.names)

    def __check_init__(self):
        charts = self.system.charts()
        for name in (*self.swap, *self.swap.values()):
            if name not in charts:
                raise DefinitionError(
                    f"Quotient: there is no chart '{name}' to swap; charts are {[*charts]}."
                )
        known = {state for chart in charts.values() for state in chart.states}
        for name in (*self.relabel, *self.relabel.values(), *self.flipped, *self.translation):
            if name not in known:
                raise DefinitionError(
                    f"Quotient: there is no state '{name}'; states are {sorted(known)}."
                )
        for kept, left_out in self.swap.items():
            mirrored = {self._partner(name) for name in charts[kept].states}
            if mirrored != set(charts[left_out].states):
                raise DefinitionError(
                    f"Quotient: mirrored, chart '{kept}' has the states {sorted(mirrored)}, but "
                    f"chart '{left_out}' has {sorted(charts[left_out].states)}: say which states "
                    "trade their names, by `relabel`."
                )

    @property
    def inputs(self) -> tuple[str, ...]:
        return self.system.inputs

    @property
    def input_units(self) -> tuple[str, ...]:
        return self.system.input_units

    @property
    def time_unit(self) -> str:
        return self.system.time_unit

    def charts(self):
        left_out = set(self.swap.values())
        charts = self.system.charts().items()
        return {name: _Reduced(x, self.translation) for name, x in charts if name not in left_out}

    def transitions(self):
        left_out, found = self.swap.values(), []
        for x in self.system.transitions():
            if x.source not in left_out:
                source = self._reduced(x.source)
                target, reset = self._landing(x)
                guard = x.guard if isinstance(x.guard, Scheduled) else _of_reduced(source, x.guard)
                enabled = None if x.enabled is None else _of_reduced(source, x.enabled)
                landing = _of_reduced(source, reset)
                found.append(
                    Transition(x.name, x.source, target, guard, x.direction, landing, enabled)
                )
        return found

    def period(self):
        return self.system.period()

    def guess(self):
        guess = self.system.guess()
        if guess is None or guess.chart not in self.charts():
            return None
        state = self.charts()[guess.chart].less(guess.state)
        return Guess(guess.chart, state, guess.time, after=guess.after)

    def check(self) -> None:
        """Raise for a function that has not the symmetry."""
        if is_traced(self):
            return
        claims = list(self._claims())
        rng, d = np.random.default_rng(0), max(len(c.states) for c in self.system.charts().values())
        u = jnp.zeros(len(self.inputs))

        @jax.jit
        @jax.vmap
        def both(q, t):
            return [tuple(_vector(f(t, q, u)) for f in pair if f) for _, *pair in claims]

        samples = rng.normal(size=(_SAMPLES, d)), rng.normal(size=_SAMPLES)
        for (sentence, *_), pair in zip(claims, both(*samples), strict=True):
            if not pair or not _equal(*pair):
                raise DefinitionError(
                    f"{type(self.system).__name__} has not the symmetry that Quotient states: "
                    f"{sentence}."
                )

    def _claims(self):
        """What the symmetry says: functions of (t, q, u) that are equal, and the sentence for where
        they are not. Of q the first numbers are the state, without what is translated."""
        charts, events = self.system.charts(), self.system.transitions()
        cut = lambda name, q: q[: len(self._reduced(name).kept)]  # noqa: E731
        moved = lambda name, q: self._reduced(name).full(cut(name, q), _SHIFT)  # noqa: E731
        still = lambda name, q: self._reduced(name).full(cut(name, q))  # noqa: E731
        at = lambda place, name, f: lambda t, q, u: f(t, place(name, q), u)  # noqa: E731
        if self.translation:
            for name, chart in charts.items():
                sentence = f"the field of chart '{name}' changes under the translation"
                yield sentence, at(moved, name, chart.field), at(still, name, chart.field)
            for x in events:
                sentence = f"the transition '{x.name}' changes under the translation"
                f = self._event(x)
                yield sentence, at(moved, x.source, f), at(still, x.source, f)
        for kept, other in self.swap.items():
            image = lambda name, q, kept=kept: self._image(charts, kept, still(kept, q))  # noqa: E731
            sentence = f"the field of chart '{other}' is not the mirror image of that of '{kept}'"
            field = at(image, other, charts[other].field)
            mirrored = lambda t, q, u, kept=kept, field=field: self._mirror(  # noqa: E731
                charts, kept, _vector(field(t, q, u))
            )
            yield sentence, at(still, kept, charts[kept].field), mirrored
            own = [x for x in events if x.source == kept]
            images = [x for x in events if x.source == other]
            if len(own) != len(images):
                yield f"'{kept}' and '{other}' have different numbers of transitions", None, None
            for x, y in zip(own, images, strict=False):
                sentence = f"the transition '{y.name}' is not the mirror image of '{x.name}'"
                yield sentence, at(still, kept, self._event(x)), at(image, other, self._event(y))

    def _image(self, charts: Mapping[str, Chart], kept: str, q: Any):
        """The mirror image of a state in a chart that is kept."""
        states, image = charts[kept].states, charts[self.swap[kept]].states
        order = np.array([states.index(self._partner(name)) for name in image])
        sign = [-1.0 if self._partner(name) in self.flipped else 1.0 for name in image]
        return q[order] * np.array(sign)

    def outputs(self):
        charts = self.charts()
        found = []
        for output in self.system.outputs():
            given = output.function
            functions = dict.fromkeys(charts, given) if callable(given) else given
            there = {
                name: _of_reduced(charts[name], function)
                for name, function in functions.items()
                if name in charts
            }
            found.append(Output(output.name, there, output.unit))
        return found

    def _reduced(self, name: str) -> "_Reduced":
        return _Reduced(self.system.charts()[name], self.translation)

    def _landing(self, x: Transition) -> tuple[str, Callable]:
        """The chart to which a transition leads, one that is kept, and the state there."""
        back = {left_out: kept for kept, left_out in self.swap.items()}
        target = back.get(x.target, x.target)
        charts, after = self.system.charts(), self._reduced(target)

        def reset(t, q, u):
            new = _vector(x.reset(t, q, u))
            return after.less(new if target == x.target else self._mirror(charts, target, new))

        return target, reset

    def _event(self, x: Transition) -> Callable:
        """Guard and reset of a transition, as one vector."""
        _, reset = self._landing(x)
        if isinstance(x.guard, Scheduled):
            return reset
        return lambda t, q, u: jnp.append(reset(t, q, u), x.sign * x.guard(t, q, u))

    def _partner(self, name: str) -> str:
        back = {b: a for a, b in self.relabel.items()}
        return self.relabel.get(name, back.get(name, name))

    def _mirror(self, charts: Mapping[str, Chart], kept: str, q: Any):
        """The state in a chart that is kept, from one in its mirror image."""
        states, image = charts[kept].states, charts[self.swap[kept]].states
        order = np.array([image.index(self._partner(name)) for name in states])
        return q[order] * np.array([-1.0 if name in self.flipped else 1.0 for name in states])


class _Reduced(Chart):
    """A chart without the states of a translation."""

    chart: Chart
    translation: Sequence[str] = eqx.field(static=True)

    @property
    def kept(self) -> np.ndarray:
        return np.array([k for k, x in enumerate(self.chart.states) if x not in self.translation])

    @property
    def states(self) -> tuple[str, ...]:
        return tuple(self.chart.states[k] for k in self.kept)

    @property
    def units(self) -> tuple[str, ...]:
        return tuple(self.chart.units[k] for k in self.kept) if self.chart.units else ()

    @property
    def inputs(self) -> tuple[str, ...] | None:
        return self.chart.inputs

    @property
    def solver(self) -> Any:
        return self.chart.solver

    @property
    def absent(self) -> Mapping[str, float]:
        return self.chart.absent

    def full(self, q, place=0.0):
        return jnp.full(len(self.chart.states), place).at[self.kept].set(q)

    def less(self, q):
        return jnp.asarray(q)[self.kept]

    def field(self, t, q, u):
        return self.less(_vector(self.chart.field(t, self.full(q), u)))


def _of_reduced(chart: _Reduced, function):
    return lambda t, q, u: function(t, chart.full(q), u)


def _equal(one, other):
    size = np.nanmax(np.abs(one), initial=0.0)
    same = one.shape == other.shape
    return same and np.allclose(one, other, rtol=0, atol=_EQUAL * size, equal_nan=True)


def _vector(value):
    return jnp.stack([jnp.asarray(x, float) for x in value])
