"""`estimate_loop`: plant, controller, closed loop and sensitivity from experiments in a control
loop.

Each of these is an HTF from one set of signals to another, with an external reference as the
instrument; it is estimated by `instrument.solve` from the same sums. `Loop.missing` says which of
them the data do not give.

If an HTF is wrong, look at its signals and its reference in `estimate_loop`, and at `_without`,
which takes out the other references; if all are wrong, at `instrument.py`. A further HTF is a field
of `Loop`, and a call of `estimate` there. The sign of the controller, which is fed back with a
minus, must stay.
"""

from collections.abc import Sequence

import equinox as eqx
import numpy as np

from .._core.boundary.checked import checked
from .._core.boundary.kinds import Count, SignalNames
from .._core.precision import require_x64
from .._core.showable import Showable
from .._core.text import folded
from ..errors import DefinitionError
from ..experiments.data import ExperimentData
from ..linear.htf import HTF
from .instrument import Roles, Sums, require_loop, solve, spectral_products


Names = Sequence[str]


class Loop(Showable, eqx.Module):
    r"""Estimated HTFs of the control loop $u = r - F y$, $y = P u + d$ with references r and d.

    **Fields**, each with variances:

    - `plant`: P, from u to y; None without a reference r. `controller`: F, from y to u (fed back
      with a negative sign); None without a reference d.
    - `closed`: $(I + P F)^{-1} P$, from r to y. `sensitivity`: $(I + F P)^{-1}$, from r to u. With
      the reference d alone: $-F (I + P F)^{-1}$, from d to u, and $(I + P F)^{-1}$, from d to y.
    - `missing`: sentences that name the experiments with which the others can be estimated.
    """

    plant: HTF | None
    controller: HTF | None
    closed: HTF
    sensitivity: HTF
    missing: tuple[str, ...] = eqx.field(static=True)

    def __repr__(self) -> str:
        lines = ["Loop"]
        for name in ("plant", "controller", "closed", "sensitivity"):
            htf = getattr(self, name)
            if htf is not None:
                lines.append(folded(f"  {name:11} {htf!r}", "  "))
        return "\n".join([*lines, *(f"  {text}" for text in self.missing)])


@checked
def estimate_loop(
    data: ExperimentData,
    *,
    at_input: SignalNames | None = None,
    at_output: SignalNames | None = None,
    repeats: Count = 1,
) -> Loop:
    """Estimate the HTFs of a plant and of its controller from experiments in closed loop.

    The plant is estimated from references that are added to its input u, the controller from
    references that are added to the measured output y. Both kinds may act in the same experiments
    or in different ones: the response to references of the other kind is subtracted. Variances are
    of first order, see `estimate_htf` with `references`. `hj.fit_multipliers` and `hj.fit_ldtp`
    accept the HTFs, also those of unstable plants.

    **Arguments:**

    - `data`: experiments whose inputs are u and the references. References are periodic and excite
      all lines f + integers.
    - `at_input`: names of the references that are added to u, at least as many as inputs u.
      Default: None.
    - `at_output`: names of the references that are added to y, at least as many as outputs y.
      Default: None.
    - `repeats`: as for `estimate_htf`. Default: 1.

    **Returns:** `hj.identify.Loop`: the HTFs `plant`, `controller`, `closed` and `sensitivity`,
    each with variances, in units of their outputs per unit of their inputs. An HTF without its
    reference is None, and `missing` names the reference.

    **Raises:** `DefinitionError` without a reference, for references that are not among the inputs,
    too few of them, equal to an input, or those that excite too little.

    **Example:**

    ```python
    design = hj.multisine(4, 8, frequencies=(0, 2), amplitude=1.0)
    r = design.realizations(4).signals(8)
    u = r / 1.5                                       # plant y = u, controller u = r - 0.5 y
    both = np.concatenate([u, r], axis=2)
    names = {"inputs": ("u", "r"), "outputs": "y"}
    loop_data = hj.experiments.ExperimentData(both, u, n_sections=4, periods=8, **names)
    loop = hj.identify.estimate_loop(loop_data, at_input="r")
    ```

    **Before:** `hj.run_experiments`. **After:** `hj.fit_multipliers`, `hj.fit_ldtp`.
    """
    require_x64()
    r = at_input or ()
    d = at_output or ()
    if not (r or d):
        raise DefinitionError(
            "`estimate_loop` needs references: name those that enter at the plant's input "
            "(`at_input`), at its output (`at_output`), or both."
        )
    roles = Roles.of(data.inputs, (*r, *d), fewest=0)
    require_loop(roles, [data.u], data.inputs)
    u = tuple(data.inputs[i] for i in roles.inputs)
    y = data.outputs
    _require_references("at_input", r, u)
    _require_references("at_output", d, y)
    products = spectral_products(data, repeats)

    def estimate(outputs: Names, inputs: Names, reference: Names) -> HTF:
        others = [name for name in (*r, *d) if name not in reference]
        sums = _without(products, products.rows(others))
        names = tuple(outputs), tuple(inputs)
        return solve(sums, *names, reference, (repeats, "auto"))

    plant = None
    controller = None
    missing = []
    if r:
        plant = estimate(y, u, r)
    else:
        missing.append(
            "The plant is not estimated: this needs experiments with a reference that is added to "
            "its input (a push, an injected current)."
        )
    if d:
        controller = estimate(u, y, d)
        controller = eqx.tree_at(lambda x: x.H, controller, -controller.H)
    else:
        missing.append(
            "The controller is not estimated: this needs experiments with a reference that is "
            "added to its measured signal y (a moved scene, an offset)."
        )
    closed = estimate(y, r, r) if r else estimate(u, d, d)
    sensitivity = estimate(u, r, r) if r else estimate(y, d, d)
    return Loop(plant, controller, closed, sensitivity, tuple(missing))


def _require_references(what: str, given: Names, needed: Names) -> None:
    """**Raises:** `DefinitionError` for some references that are too few."""
    if given and len(given) < len(needed):
        raise DefinitionError(
            f"`{what}` needs {len(needed)} references, one for each of {', '.join(needed)}, "
            f"not {len(given)}."
        )


def _without(sums: Sums, rows: np.ndarray) -> Sums:
    """Return the products of spectra after regression of all signals on the signals in `rows`
    (products of the residuals).

    Each of these rows takes one degree of freedom.
    """
    total = sums.total
    power = total[:, rows[:, None], rows]
    inverse = np.linalg.pinv(power, hermitian=True)
    coefficients = total[:, :, rows] @ inverse
    explained = coefficients @ total[:, rows]
    freedom = sums.experiments - len(rows)
    return sums._replace(total=total - explained, experiments=freedom)
