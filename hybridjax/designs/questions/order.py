r"""Whether fewer multipliers explain the data as well (T-optimality).

The misfit of the best model with fewer is $T(p) = \min_\theta \sum_k p_k t_k(\theta)$, where
$t_k$ is its squared misfit at a line per unit of power, in units of the noise. As a minimum of
linear functions T is concave, so that $\Psi = 1/T$ is convex, and $\Psi(tp) = \Psi(p)/t$, with
$-\partial \Psi/\partial p_k = t_k / T^2$ at the best model (Atkinson and Fedorov 1975).
"""

import numpy as np
from jaxtyping import Complex, Float, Int
from scipy.optimize import minimize

from ...errors import DefinitionError
from ...identify.denominator import chi
from ...identify.htf_errors import require_frequencies
from ..candidates import Candidates
from ..goals import Order
from ..noise import Noise
from ..signals import Model
from .measured import measured
from .question import AbstractQuestion, Answer
from .sensitivities import Channel, channels_of, only_channels


# The misfit of the best smaller model, relative to H itself, that is rounding. Ten times more:
# models that differ ten times as much count as the same.
_ROUNDING = 1e-18
# First guesses of the rival's denominator: its roots lie at these parts of the true ones, beside
# zero. More: local minima are missed less often.
_STARTS = (0.0, 0.3, 0.6, 1.0)


class OrderQuestion(AbstractQuestion):
    """How badly the best model with fewer multipliers fits."""

    channels: tuple[Channel, ...]
    """With H delayed by 0, 1, ... periods, and no denominator."""
    delay: tuple[np.ndarray, ...]
    """z^-N of each channel's equations."""
    starts: tuple[np.ndarray, ...]
    """Denominators from which the best one is looked for."""
    names: tuple[str, ...]

    def only(self, some: Int[np.ndarray, " k"]) -> "OrderQuestion":
        kept = [np.isin(one.cosine, some) for one in self.channels]
        delay = tuple(z[k] for z, k in zip(self.delay, kept, strict=True) if k.any())
        return OrderQuestion(
            tuple(only_channels(self.channels, some)), delay, self.starts, self.names
        )

    def answer(self, power: Float[np.ndarray, " K"]) -> Answer:
        def misfit(c):
            total, slope = 0.0, np.zeros(len(c))
            for one, z in zip(self.channels, self.delay, strict=True):
                left, all_of_it = _misfit(one, z, c, power)
                total += (left**2).sum()
                lines = len(np.unique(one.cosine))
                left, fitted = _complex(left, lines), _complex(all_of_it - left, lines)
                each = (left.conj() * fitted).sum(axis=(0, 2)) / chi(z[:lines], c)
                slope += 2 * (z[:lines] ** np.arange(1, len(c) + 1)[:, None] @ each).real
            return total, slope

        best = self.starts[0]
        if len(best):
            found = [minimize(misfit, c, jac=True, method="BFGS") for c in self.starts]
            best = min(found, key=lambda one: one.fun).x
        squares, size = np.zeros(len(power)), 0.0
        for one, z in zip(self.channels, self.delay, strict=True):
            left, all_of_it = _misfit(one, z, best, power)
            squares += np.bincount(one.cosine, (left**2).sum(axis=1), len(power))
            size += (all_of_it**2).sum()
        T = squares.sum()
        if not T > _ROUNDING * size:
            raise DefinitionError(
                "fewer multipliers explain these lines as well: nothing tells the orders apart."
            )
        return Answer(np.array([1 / T]), squares / power / T**2, float(1 / T))


def about_order(goal: Order, model: Model, cosines: Candidates, noise: Noise) -> OrderQuestion:
    """As `question_of`."""
    multipliers, rival = np.asarray(model.multipliers), goal.fewer
    if rival >= len(multipliers):
        raise DefinitionError(
            f"`goal`: {rival} multipliers are not fewer than the model's {len(multipliers)}."
        )
    N = cosines.n_sections
    size = rival * N + (N if goal.overhang is None else goal.overhang) + 1
    channels, delay = [], []
    for htf, cosine, _ in measured(model, cosines, goal.harmonics, noise):
        require_frequencies(htf, rival, size)
        z = np.exp(-2j * np.pi * np.asarray(htf.f))
        for one in channels_of(htf, cosine, np.zeros(rival), size, range(rival + 1)):
            channels.append(one)
            delay.append(np.tile(z, len(one.cosine) // len(z)))
    largest = multipliers[:rival].real
    starts = tuple(np.atleast_1d(np.poly(part * largest))[1:] for part in _STARTS)
    starts = starts if rival else starts[:1]
    names = (f"misfit with {rival} multipliers" if rival != 1 else "misfit with 1 multiplier",)
    return OrderQuestion(tuple(channels), tuple(delay), starts, names)


def _misfit(
    one: Channel,
    z: np.ndarray,
    c: Float[np.ndarray, " d"],
    power: Float[np.ndarray, " K"],
) -> tuple[Float[np.ndarray, "E n"], Float[np.ndarray, "E n"]]:
    r"""What the best numerators leave of $\chi H / |\chi|$, and all of it."""
    weight = (np.sqrt(power)[one.cosine] / np.abs(chi(z, c)))[:, None]
    q, _ = np.linalg.qr(weight * one.basis)
    delayed = one.slopes.reshape(len(z), len(c) + 1, -1)
    whole = weight * np.tensordot(np.concatenate([[1.0], c]), delayed, axes=(0, 1))
    return whole - q @ (q.T @ whole), whole


def _complex(values: Float[np.ndarray, "E n"], lines: int) -> Complex[np.ndarray, "B lines n"]:
    """From blocks of real and imaginary parts, by turns."""
    blocks = values.reshape(-1, 2, lines, values.shape[1])
    return blocks[:, 0] + 1j * blocks[:, 1]
