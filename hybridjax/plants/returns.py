"""Multipliers of a plant from returns of perturbed states."""

from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Float

from .._core.arguments import require_among
from .._core.progress import counted, say
from ..errors import ComputationError, DefinitionError
from ..identify.multiplier_estimate import MultiplierEstimate
from ..sections.families import ClockPhase
from .drive import Stopped


class Returns(MultiplierEstimate):
    """Multipliers from returns of perturbed states to section 0.

    **Fields** beside those of all estimates of multipliers:

    - `jacobian` (d, d): derivatives of the returned coordinates with respect to those at the start.
    - `coordinates`: their names. `state` (d,): their values on the cycle, on section 0.
    - `noise` (d,): standard deviation of returns from nearly equal states.
    - `residual`: largest distance between state and return, in units of the range of the
      coordinate on the cycle.
    - `bound`: multipliers that are not listed cannot be told from 0; this is the largest modulus
      that they may have (0 if all are listed).
    """

    jacobian: Float[np.ndarray, "d d"]
    state: Float[np.ndarray, " d"]
    noise: Float[np.ndarray, " d"]
    coordinates: tuple[str, ...] = eqx.field(static=True)
    residual: float = eqx.field(static=True)
    bound: float = eqx.field(static=True)

    def _about(self) -> str:
        more = len(self.coordinates) - len(self.multipliers)
        hidden = f"{more} more below {self.bound:.1g}; " if more else ""
        return f"{hidden}from {len(self.coordinates)} coordinates, residual {self.residual:.1g}"


class Map:
    """The return map of some coordinates of a plant on section 0, and its fixed point.

    **Fields:** `names`: of the coordinates. `x`: their values, first those of the settled state.
    `size`: their ranges on the cycle. `noise`: of returns. `h`: steps of differences.
    """

    def __init__(self, cycle: Any, names: Any = None):
        self.drive, plant = cycle.drive, cycle.plant
        if not self.drive.sets or self.drive.fixed:
            text = "whose state can be set, and whose steps can end on a section"
            raise DefinitionError(f"perturbed returns need a plant {text}.")
        self.base = np.array(cycle.state, float)
        states = tuple(getattr(plant, "states", [f"x{i}" for i in range(self.base.size)]))
        period = getattr(plant, "period", None)
        if names is None:
            timeless = period is None or isinstance(cycle.sections, ClockPhase)
            names = [x for x in states if not (timeless and x == "time")]
        require_among("coordinate", names, states, "perturbed_returns: ")
        self.names, self.columns = tuple(names), [states.index(x) for x in names]
        turn = 0.0 if period is None else round(cycle.period / period) * period
        self.shift, self.n = turn * np.array([x == "time" for x in names]), 0
        self.x, N = self.base[self.columns], cycle.sections.n_sections
        rows = [self(self.x, k) for k in range(N)]
        self.n, self.size = N, np.ptp(rows, axis=0)
        still = self.size <= 1e-9 * np.abs(rows).max(axis=0)
        self.size[still] = np.where(self.x, np.abs(self.x), 1.0)[still]
        say("noise of returns")
        self.noise = self._noise()
        # Steps at which noise and the error of fourth order are nearly equal for a function of unit
        # derivatives; at most two percent of the range.
        self.h = self.size * min((self.noise / self.size).max() ** 0.2 / 2, 0.02)

    def __call__(self, x: Float[np.ndarray, " d"], n: int | None = None) -> Any:
        """Return coordinates (d,) after n sections. Default: after one cycle, at its beginning."""
        state, drive = self.base.copy(), self.drive
        state[self.columns] = x
        drive.restore(drive.start._replace(state=state))
        drive.phase.begin(drive.t, drive.z, on_section=True)
        for k in range(1, 1 + (self.n if n is None else n)):
            drive.advance(drive.zero, k)
        y = np.array(drive.here().state, float)[self.columns]
        return y - self.shift if n is None else y

    def _noise(self) -> Float[np.ndarray, " d"]:
        """Return the standard deviation of returns from nearly equal states.

        Fourth differences along lines: their variance is 70 times that of the noise (Moré and Wild
        2011, Estimating computational noise). Narrow spacing shows rounding and tolerances, wide
        spacing the events that move through the time steps of a simulator.
        """
        rng = np.random.default_rng(0)
        noise = np.finfo(float).eps * np.maximum(np.abs(self.x), self.size)
        for spacing in (1e-6, 1e-4, 1e-3):
            along = rng.uniform(0.5, 1, len(self.x)) * rng.choice([-1, 1], len(self.x))
            line = [self(self.x + j * spacing * self.size * along) for j in range(-7, 8)]
            squares = np.diff(line, 4, axis=0) ** 2 / 70
            noise = np.maximum(noise, np.sqrt(squares.mean(axis=0)))
        return noise

    def slopes(self, steps: float) -> Any:
        """Return central differences of second order with so many steps."""
        moves = counted(np.diag(steps * self.h), "coordinates", len(self.x))
        return np.array([(self(self.x + e) - self(self.x - e)) / (2 * e.sum()) for e in moves]).T

    def solve(self) -> float:
        """Move x to the fixed point by Newton's method, and return the largest residual, in units
        of the sizes. The plant is then on section 0."""
        for _ in range(8):
            residual = (self(self.x) - self.x) / self.size
            if (np.abs(residual) <= 3 * self.noise / self.size).all():
                break
            J = (self.slopes(1) - np.eye(len(self.x))) * self.size / self.size[:, None]
            # (A multiplier of 1 leaves its direction as it is.)
            self.x = self.x - self.size * np.linalg.lstsq(J, residual, rcond=1e-6)[0]
        return float(np.abs(residual).max())


def returns_of(cycle: Any, names: Any) -> Returns:
    """See `SettledCycle.perturbed_returns`."""
    try:
        map = Map(cycle, names)
        residual = map.solve()
        fine, middle, wide = (map.slopes(k) for k in (1, 2, 4))
    except Stopped as stop:
        raise ComputationError(f"a perturbed state does not return: {stop}.") from stop
    J, coarse = (4 * fine - middle) / 3, (4 * middle - wide) / 3
    # (Weights 8/12 and -1/12 of four returns, each with this noise.)
    error = np.hypot(np.sqrt(2 * (8**2 + 1)) / 12 * map.noise[:, None] / map.h, (J - coarse) / 3)
    scale = map.size / map.size[:, None]
    values, covariance, bound = _resolved(J * scale, error * scale)
    return Returns(
        multipliers=values,
        covariance=covariance,
        covariance_freedom=10.0,  # (eleven differences)
        coefficients=np.poly(values).real[1:] if len(values) else np.zeros(0),
        jacobian=J,
        state=map.x,
        noise=map.noise,
        coordinates=map.names,
        residual=residual,
        bound=bound,
    )


def _resolved(J: Float[np.ndarray, "d d"], error: Float[np.ndarray, "d d"]) -> Any:
    """Return the eigenvalues that differ from 0 by three standard errors, the covariance of their
    polynomial's coefficients, and a bound of the others, from draws within the errors."""

    def ordered(J: Any) -> Any:
        values = np.linalg.eigvals(J).astype(complex)
        return values[np.argsort(-np.abs(values))]

    draws = J + error * np.random.default_rng(0).standard_normal((1000, *J.shape))
    values, each = ordered(J), np.array([ordered(x) for x in draws])
    spread = np.sqrt(((np.abs(each) - np.abs(values)) ** 2).mean(axis=0))
    count = int(np.cumprod(np.abs(values) > 3 * spread).sum())
    if 0 < count < len(values) and values[count - 1].imag > 0 > values[count].imag:
        count -= 1
    polynomials = [np.poly(x[:count]).real[1:] if count else np.zeros(0) for x in each]
    covariance = np.reshape(np.cov(polynomials, rowvar=False) if count else [], (count, count))
    bound = float((np.abs(values) + 3 * spread)[count:].max(initial=0.0))
    return values[:count], covariance, bound
