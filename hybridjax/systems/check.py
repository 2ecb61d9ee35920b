"""Whether a system is well formed: names, shapes of every function, finite parameters."""

from collections.abc import Callable, Hashable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._core.executor import is_traced
from ..errors import DefinitionError
from .quotient import Quotient
from .solver import ByChart
from .structure import Structure, quoted
from .system import HybridSystem
from .transition import Scheduled


def check_system(system: HybridSystem) -> None:
    """Check that a system is well formed: names, shapes of every function, finite parameters.

    **Raises:** `DefinitionError`, naming the chart, transition or parameter that is wrong.
    """
    for path, leaf in jax.tree_util.tree_leaves_with_path(eqx.filter(system, eqx.is_array)):
        if (
            jnp.issubdtype(leaf.dtype, jnp.inexact)
            and not is_traced(leaf)
            and not np.all(np.isfinite(leaf))
        ):
            raise DefinitionError(
                f"parameter `{jax.tree_util.keystr(path)[1:]}` of {type(system).__name__} is "
                f"{np.asarray(leaf)}; every parameter must be finite."
            )
    form = _form(system)
    if form is None or form not in _checked:
        _check_functions(system)
        if form is not None:
            if len(_checked) >= _KEPT:
                _checked.clear()
            _checked.add(form)
    if isinstance(system, Quotient):
        system.check()


# Systems that were found to be well formed, but for their numbers. (A `Memory` forgets with its
# object, and whoever tries values of a parameter makes a new one for each.)
_checked: set[Hashable] = set()
# So many of them. Doubled: twice as many kinds of systems can be taken turns with.
_KEPT = 256


def _form(system: HybridSystem) -> Hashable:
    """All but the numbers of a system; `None` where that cannot be compared."""
    leaves, structure = jax.tree_util.tree_flatten(system)
    form = structure, *((x.shape, x.dtype) if eqx.is_array(x) else (type(x), x) for x in leaves)
    try:
        hash(form)
    except TypeError:
        return None
    return form


def _check_functions(system: HybridSystem) -> None:
    if not system.charts():
        raise DefinitionError(f"{type(system).__name__} has no charts.")
    _check_units(type(system).__name__, "inputs", system.inputs, system.input_units)
    s = Structure(system)
    for name in system.solver.names if isinstance(system.solver, ByChart) else ():
        s.chart_index(name)
    for a, (name, chart) in enumerate(zip(s.names, s.charts, strict=True)):
        for unknown in set(chart.inputs or ()) - set(system.inputs):
            raise DefinitionError(
                f"chart '{name}' uses input '{unknown}', which the system does not have; inputs "
                f"are {quoted(system.inputs)}."
            )
        if len(set(chart.states)) < len(chart.states):
            raise DefinitionError(f"chart '{name}' names a state twice: {quoted(chart.states)}.")
        _check_units(f"chart '{name}'", "states", chart.states, chart.units)
        s.method(a)
        shape = _shape(f"field of chart '{name}'", lambda t, q, u, a=a: s.field(a, t, q, u), s, a)
        if shape != (s.dims[a],):
            raise DefinitionError(
                f"the field of chart '{name}' returns shape {shape}, but the chart has the "
                f"{s.dims[a]} states {quoted(chart.states)}."
            )
    if len(set(map(str, s.state_names()))) < len(s.state_names()):
        raise DefinitionError(
            f"charts of {type(system).__name__} give a state different units: "
            f"{quoted(s.state_names())}."
        )
    seen: set[str] = set()
    # Those of one kind are one program; the first and the last may reach beyond the states.
    looked_at = {g for kind in s.kinds for g in (kind[0], kind[-1])}
    for g, tr in enumerate(s.transitions):
        if tr.name in seen:
            raise DefinitionError(
                f"two transitions are called '{tr.name}'; give each its own name."
            )
        seen.add(tr.name)
        if g not in looked_at:
            continue
        a, b = s.chart_index(tr.source), s.chart_index(tr.target)
        label = f"transition '{tr.name}' ({tr.source} -> {tr.target})"
        if not isinstance(tr.guard, Scheduled):
            shape = _shape(f"guard of {label}", lambda t, q, u, g=g: s.guard(g, t, q, u), s, a)
            if shape != ():
                raise DefinitionError(f"the guard of {label} returns shape {shape}, not a number.")
        shape = _shape(f"predicate of {label}", lambda t, q, u, g=g: s.enabled(g, t, q, u), s, a)
        if shape != ():
            raise DefinitionError(
                f"`enabled` of {label} returns shape {shape}, not one truth value."
            )
        shape = _shape(f"reset of {label}", lambda t, q, u, g=g: s.reset(g, t, q, u), s, a)
        if shape != (s.dims[b],):
            raise DefinitionError(
                f"the reset of {label} returns shape {shape}, but chart '{tr.target}' has the "
                f"{s.dims[b]} states {quoted(s.charts[b].states)}."
            )
    for output in system.outputs():
        values = s.resolve_outputs(output)
        for a, name in enumerate(s.names):
            if values.defined(a):
                what = f"output '{output.name}' in chart '{name}'"
                _shape(what, lambda t, q, u, a=a, z=values: z(a, t, q, u), s, a)


def _shape(what: str, function: Callable, s: Structure, a: int) -> tuple[int, ...]:
    shapes = (), (s.dims[a],), (s.nu,)
    try:
        found = jax.eval_shape(
            function, *(jax.ShapeDtypeStruct(x, jnp.result_type(float)) for x in shapes)
        ).shape
        _look_within(function, *(np.full(x, 0.5) for x in shapes))
    except DefinitionError:
        raise
    except Exception as error:
        raise DefinitionError(f"the {what} cannot be evaluated: {error}") from error
    return found


def _look_within(function: Callable, *point: np.ndarray) -> None:
    """**Raises:** `IndexError` for a state or an input by a number that there is none of: JAX would
    take the last one, without a word, where NumPy's arrays say so."""
    with np.errstate(all="ignore"):
        try:
            jax.eval_shape(lambda: function(*point))
        except IndexError:
            raise
        except Exception:  # what is for arrays of JAX only
            return


def _check_units(what: str, kind: str, names: Sequence[str], units: Sequence[str]) -> None:
    if len(units) not in (0, len(names)):
        raise DefinitionError(
            f"{what} has the {kind} {quoted(names)}, but {len(units)} units: give one for each, "
            "or none."
        )
