"""Multipliers of a plant from returns of perturbed states."""

import dataclasses
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Float

from .._core.arguments import require_among
from .._core.progress import counted, say
from ..errors import ComputationError, DefinitionError
from ..identify.multiplier_estimate import MultiplierEstimate
from ..sections.families import ClockPhase


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


class _Map:
    """The return map of some coordinates of a plant."""

    def __init__(self, cycle: Any, names: Any):
        plant, self.cycle, self.experiment = cycle.plant, cycle, cycle.experiment
        try:
            self.base = np.array(self.experiment.start.state, float)
        except (TypeError, ValueError):
            self.base = np.full(1, np.nan)
        if not np.isfinite(self.base).all() or getattr(plant, "fixed_step", False):
            text = "numbers that can be changed, and whose steps can end on a section"
            raise DefinitionError(f"this needs a plant whose `get_state` returns {text}.")
        states = tuple(getattr(plant, "states", [f"x{i}" for i in range(self.base.size)]))
        period = getattr(plant, "period", None)
        if names is None:
            timeless = period is None or isinstance(cycle.sections, ClockPhase)
            names = [x for x in states if not (timeless and x == "time")]
        require_among("coordinate", names, states, "perturbed_returns: ")
        self.names, self.columns = tuple(names), [states.index(x) for x in names]
        turn = 0.0 if period is None else round(cycle.period / period) * period
        self.shift = np.array([turn if x == "time" else 0.0 for x in names])
        rows = [self(self.base[self.columns], k) for k in range(cycle.sections.n_sections)]
        largest, self.size = np.abs(rows).max(axis=0), np.ptp(rows, axis=0)
        still = self.size <= 1e-9 * largest
        self.size[still] = np.where(largest > 0, largest, 1.0)[still]

    def __call__(self, x: Float[np.ndarray, " d"], n: int | None = None) -> Any:
        """Return coordinates (d,) after n sections. Default: after one cycle, at its beginning.

        **Raises:** `ComputationError`.
        """
        state, cycle = self.base.copy(), self.cycle
        state[self.columns] = x
        u = [[0.0] * len(cycle.inputs)] * (1 + (cycle.sections.n_sections if n is None else n))
        start = self.experiment.start._replace(state=state)
        trial = dataclasses.replace(self.experiment, start=start).run(cycle.seed, u, repeats=True)
        if trial.cause:
            raise ComputationError(f"a perturbed state does not return: {trial.cause}.")
        y = np.array(cycle.plant.get_state(), float)[self.columns]
        return y - self.shift if n is None else y

    def noise(self, x: Float[np.ndarray, " d"]) -> Float[np.ndarray, " d"]:
        """Return the standard deviation of returns from nearly equal states.

        Fourth differences along lines: their variance is 70 times that of the noise (Moré and Wild
        2011, Estimating computational noise). Narrow spacing shows rounding and tolerances, wide
        spacing the events that move through the time steps of a simulator.
        """
        rng = np.random.default_rng(0)
        noise = np.finfo(float).eps * np.maximum(np.abs(x), self.size)
        for spacing in (1e-6, 1e-4, 1e-3):
            along = spacing * self.size * rng.uniform(0.5, 1, len(x)) * rng.choice([-1, 1], len(x))
            line = np.array([self(x + j * along) for j in range(-7, 8)])
            squares = np.diff(line, 4, axis=0) ** 2 / 70
            noise = np.maximum(noise, np.sqrt(squares.mean(axis=0)))
        return noise

    def slopes(self, x: Float[np.ndarray, " d"], h: Float[np.ndarray, " d"]) -> Any:
        """Return central differences of second order with steps h."""
        moves = counted(np.diag(h), "coordinates", len(x))
        return np.array([(self(x + e) - self(x - e)) / (2 * e.sum()) for e in moves]).T


def returns_of(cycle: Any, names: Any) -> Returns:
    """See `SettledCycle.perturbed_returns`."""
    map = _Map(cycle, names)
    x, size = map.base[map.columns], map.size
    say("noise of returns")
    noise = map.noise(x)
    # Steps at which noise and the error of fourth order are nearly equal for a function of unit
    # derivatives; at most two percent of the range.
    h = size * min((noise / size).max() ** 0.2 / 2, 0.02)
    J, y = map.slopes(x, h), map(x)
    scale = size / size[:, None]  # (of derivatives)
    for _ in range(5):
        residual = (y - x) / size
        if (np.abs(residual) <= 3 * noise / size).all():
            break
        x = x - size * np.linalg.lstsq((J - np.eye(len(x))) * scale, residual, rcond=1e-9)[0]
        y = map(x)
    fine, middle, wide = (map.slopes(x, k * h) for k in (1, 2, 4))
    J, coarse = (4 * fine - middle) / 3, (4 * middle - wide) / 3
    # (Weights 8/12 and -1/12 of four returns, each with this noise.)
    error = np.hypot(np.sqrt(2 * (8**2 + 1)) / 12 * noise[:, None] / h, (J - coarse) / 3)
    values, covariance, bound = _resolved(J * scale, error * scale)
    return Returns(
        multipliers=values, covariance=covariance, covariance_freedom=10.0,  # (eleven differences)
        coefficients=np.poly(values).real[1:] if len(values) else np.zeros(0),
        jacobian=J, state=x, noise=noise, coordinates=map.names,
        residual=float(np.abs((y - x) / size).max()), bound=bound,
    )  # fmt: skip


def _resolved(J: Float[np.ndarray, "d d"], error: Float[np.ndarray, "d d"]) -> Any:
    """Return the eigenvalues that differ from 0 by three standard errors, the covariance of their
    polynomial's coefficients, and a bound of the others.

    To first order, dλ = wᴴ dJ v / wᴴ v with left and right eigenvectors w and v.
    """
    values, V = np.linalg.eig(J)
    # (Perturbed within the errors, so that a defective eigenvalue 0 has eigenvectors.)
    values, V = values.astype(complex), V.astype(complex)
    W = np.linalg.pinv(V, rcond=1e-14)
    gradient = np.einsum("ia,bi->iab", W, V)
    spread = np.sqrt(np.einsum("iab,ab->i", np.abs(gradient) ** 2, error**2))
    order = np.argsort(-np.abs(values))
    values, gradient, spread = values[order], gradient[order], spread[order]
    sure = np.abs(values) > 3 * spread
    count = int(np.argmin(sure)) if not sure.all() else len(sure)
    if count and count < len(values) and np.isclose(values[count - 1], values[count].conj()):
        count -= int(values[count].imag != 0)
    kept, gradient = values[:count], gradient[:count]
    slopes = [-np.poly(np.delete(kept, i)) for i in range(count)]  # of coefficients
    change = np.einsum("ij,iab->jab", np.reshape(slopes, (count, count)), gradient).real
    covariance = np.einsum("jab,kab,ab->jk", change, change, error**2)
    bound = float((np.abs(values) + 3 * spread)[count:].max(initial=0.0))
    return kept, covariance, bound
