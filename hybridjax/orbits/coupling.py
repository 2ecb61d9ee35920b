"""The mean effect of a weak periodic push on the phase of a cycle: entrainment, and coupling to an
equal cycle.

`Responses.coupling` calls `mean_effect`, which returns a `Coupling`: a Fourier series over the lead
of the push. The coefficients are products of those of the push and of the phase response, from
integrals over the cycle (`_quadrature`). The effect is the mean of response(phase) times push(phase
+ lead), in cycles per time: this sign and this unit must stay, since `locked` and `locking` use
them. To first order in the strength of the push, the zeros of the series are the states in which
phases move together (`Locked`).

If coefficients are wrong at high harmonics alone, look at `_quadrature`; if they are wrong for
inputs that act at events alone, at the last terms of `mean_effect`; if a locked state is missing,
at the grid of `Coupling._zeros`.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Complex, Float

from .._core.arguments import require_among
from .._core.boundary.checked import checked_methods
from .._core.boundary.members import leading_on
from .._core.executor import Array, namespace, on_host, to_host
from .._core.showable import Showable
from .._core.text import fields
from ..errors import DefinitionError
from ..systems.structure import Structure
from .linear_flow import NODES, LinearFlow, Phases, by_name


# The push is resolved if the last quarter of its coefficients is below this part of the largest.
# Larger: effects of pushes that jump have visible errors. Smaller: more harmonics are asked for
# than needed.
_LATE = 1e-3


@leading_on
class Locked(NamedTuple):
    """A state in which phases move together: `lead` of the push, in cycles, and the `rate` at which
    deviations grow, per time and strength of the push. The rate is negative if the state is
    stable."""

    lead: float
    rate: float


@checked_methods
class Coupling(Showable, eqx.Module):
    r"""Mean effect of a weak push, by its lead $\psi$ in cycles (see `Responses.coupling`).

    The rate of the phase is $f_0 + \varepsilon \Gamma(\psi)$ in cycles per time under a push of the
    strength $\varepsilon$. `coupling(lead)` returns $\Gamma$ at one or several leads $\psi$.

    **Fields:** `coefficients` (n,): those of $e^{2 \pi i n \psi}$ in $\Gamma$, n = 0, 1, ...
    """

    coefficients: Complex[Array, " n"]

    def __call__(self, lead: Phases) -> Float[Array, " p"]:
        xp = namespace(self.coefficients)
        n = np.arange(len(self.coefficients))
        angle = 2j * np.pi * xp.asarray(lead)[..., None]
        waves = xp.exp(angle * n)
        twice = np.where(n == 0, 1, 2)
        return xp.real(waves @ (self.coefficients * twice))

    __repr__ = fields

    @property
    def locking(self) -> tuple[float, float]:
        """The Arnold tongue, to first order: least and largest difference between the frequency of
        a push that entrains the cycle and the frequency of the cycle, per strength of the push."""
        values = self([x.lead for x in self._slope._zeros()] or [0.0])
        return float(values.min()), float(values.max())

    def locked(self, mutual: bool = False) -> tuple[Locked, ...]:
        """The leads at which the phases stay together, if the push has the frequency of the cycle.

        **Arguments:** `mutual`: whether the push comes from an equal cycle that is pushed in
        return. Default: False.
        """
        # (The lead of the push falls while the phase of the cycle advances: hence the sign.)
        c = to_host(self.coefficients)
        return Coupling(np.conj(c) - c if mutual else -c)._zeros()

    @property
    def _slope(self) -> "Coupling":
        c = to_host(self.coefficients)
        rates = 2j * np.pi * np.arange(len(c))
        return Coupling(rates * c)

    def _zeros(self) -> tuple[Locked, ...]:
        """Zeros in one cycle, with their slopes. (Two that lie within a step of the grid are
        missed.)"""
        from scipy import optimize  # (a third of a second)

        steps = 16 * len(self.coefficients)
        grid = (np.arange(steps + 1) - 0.5) / steps
        sign = np.sign(self(grid))

        def value(x):
            return float(self([x])[0])

        products = sign[:-1] * sign[1:]
        crossed = np.flatnonzero(products < 0)
        roots = [
            optimize.brentq(value, *grid[k : k + 2], full_output=True)[0]
            for k in crossed
        ]
        locked = []
        for x in roots:
            slope = float(self._slope([x])[0])
            locked.append(Locked(x % 1.0, slope))
        return tuple(locked)


def mean_effect(
    s: Structure,
    flow: LinearFlow,
    period: Float[Array, ""],
    response: Float[Array, "P K"],
    impulses: Sequence[tuple[Float[Array, ""], Float[Array, ""]]],
    push: Callable | str,
    harmonics: int,
) -> Coupling:
    """Return the mean effect of a push (see `Responses.coupling`).

    **Arguments:** `response`: that of the phase to the input, at the nodes of the flow. `impulses`:
    phases of events, and the change of the phase there per unit of the input.
    """
    xp = namespace(flow.q)
    phase, weight = _quadrature(flow, period, harmonics)
    chart, response_values, states = flow.at(phase, period, response, flow.q)
    if isinstance(push, str):
        require_among("state", [push], s.state_names(), "`push`: ")
        push_values = by_name(s, chart, states)[push]
    else:
        push_values = xp.asarray(push(phase), float)
    n = np.arange(harmonics + 1)
    exponent = -2j * np.pi * n[:, None] * phase
    integrals = xp.exp(exponent) * weight
    push_harmonics = integrals @ push_values
    response_harmonics = integrals @ response_values
    for phase_of_event, change in impulses:
        wave = xp.exp(-2j * np.pi * n * phase_of_event)
        response_harmonics += wave * change / period
    coefficients = xp.conj(response_harmonics) * push_harmonics / period
    if on_host(coefficients):
        _require_resolved(coefficients)
    return Coupling(coefficients)


def _quadrature(
    flow: LinearFlow, period: Float[Array, ""], harmonics: int
) -> tuple[Float[Array, " x"], Float[Array, " x"]]:
    """Return phases, and weights of integrals over a cycle: Gauss's, in so many equal parts of each
    piece that the fastest wave is resolved."""
    parts = 1 + harmonics // 2
    nodes, weights = np.polynomial.legendre.leggauss(NODES)
    begin_of_part = np.arange(parts)[:, None]
    place = ((begin_of_part + (nodes + 1) / 2) / parts).ravel()
    since = flow.length[:, None] * place
    times = flow.turn[:, None] + since
    phase = (times / period).ravel()
    weight = flow.length[:, None] / period * np.tile(weights / 2 / parts, parts)
    return phase, weight.ravel()


def _require_resolved(coefficients: Complex[Array, " n"]) -> None:
    """**Raises:** `DefinitionError` if the last coefficients are not small."""
    late = coefficients[len(coefficients) * 3 // 4 :]
    if np.abs(late).max() > _LATE * np.abs(coefficients).max():
        raise DefinitionError(
            f"`harmonics` = {len(coefficients) - 1} does not resolve jumps of the push."
        )
