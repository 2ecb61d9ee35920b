"""Systems modulo a symmetry: legs that are relabeled, a position that has no effect."""

import functools as ft
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

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

    Inputs are those of the charts that are kept.

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
        return [
            self._transition(x)
            for x in self.system.transitions()
            if x.source not in self.swap.values()
        ]

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
                raise DefinitionError(
                    f"{type(self.system).__name__} does not have the symmetry of its Quotient: "
                    f"{sentence}."
                )

    def _claims(self):
        """The statements of the symmetry: a sentence for its failure, and two functions of
        (t, q, u) that are equal. The first numbers of q are the state without translations."""
        charts, events = self.system.charts(), self.system.transitions()
        kept_of = {name: name for name in charts} | {b: a for a, b in self.swap.items()}

        def functions(name, shift=0.0):
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
            for (what, before), (_, after) in zip(
                functions(name), functions(name, 0.7), strict=True
            ):
                yield f"the {what} changes under the translation", before, after
        for kept, other in self.swap.items():
            ours, images = list(functions(kept)), list(functions(other))
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
