r"""Criteria of `fit_multipliers`, with all numerators free: the denominator, and its order.

*Order (T-optimality).* The misfit of the best model with fewer multipliers is
$T(p) = \min_\theta \sum_k p_k t_k(\theta)$, where $t_k$ is its squared misfit at a line per unit of
power, in units of the noise. As a minimum of linear functions T is concave, so that $\Psi = 1/T$ is
convex, and $\Psi(tp) = \Psi(p)/t$, with $-\partial \Psi/\partial p_k = t_k / T^2$ at the best model
(Atkinson and Fedorov 1975).
"""

from collections.abc import Iterable, Sequence

import numpy as np
from jaxtyping import Complex, Float, Int
from scipy.optimize import minimize

from ..errors import DefinitionError
from ..identify.denominator import chi
from ..identify.htf_errors import check_values, error_weights, require_frequencies
from ..identify.variable_projection import powers_basis
from ..linear.htf import HTF
from .candidates import Candidates, Kept, Measured, Model, Noise, Powers, measured_htfs
from .criterion import Bound, Channel, Criterion, Information, only_channels
from .goals import Order


# Decimal digits to which the errors of two entries must agree (up to a factor) to be treated
# together. One digit less: fewer channels, with errors that are off by as much.
_EQUAL_WEIGHTS = 9
# The misfit of the best smaller model, relative to H itself, that is rounding. Larger: models that
# are distinguishable with little noise are rejected. Smaller: the design follows rounding errors.
_ROUNDING = 1e-18
# Starting points of the rival's denominator: its roots lie at these parts of the true ones, beside
# zero. Fewer: local minima are missed, and the certificate with them.
_STARTS = (0.0, 0.3, 0.6, 1.0)


def coefficients(order: int, n_sections: int, overhang: int | None) -> int:
    """Return how many coefficients each numerator has."""
    return order * n_sections + (n_sections if overhang is None else overhang) + 1


def denominator_information(
    htfs: Iterable[Measured], c: Float[np.ndarray, " d"], overhang: int | None
) -> Information:
    """Return the information about the coefficients c of the denominator.

    **Raises:** `DefinitionError` if the HTFs have too few frequencies, or harmonics that are not
    symmetric about 0.
    """
    channels, d = [], len(c)
    for htf, cosine, _ in htfs:
        size = coefficients(d, htf.n_sections, overhang)
        require_frequencies(htf, d, size)
        channels += _channels(htf, cosine, c, size, range(1, d + 1))
    return Information(tuple(channels), tuple(f"c{k}" for k in range(1, d + 1)))


def require_symmetric(harmonics: tuple[int, ...], n_sections: int) -> None:
    """**Raises:** `DefinitionError` for harmonics that are not symmetric about 0."""
    if {(-m) % n_sections for m in harmonics} != {m % n_sections for m in harmonics}:
        raise DefinitionError(
            f"the harmonics of `goal` must be symmetric about 0, not {harmonics}."
        )


def _channels(
    htf: HTF,
    cosine: Int[np.ndarray, " F"],
    c: Float[np.ndarray, " d"],
    size: int,
    delays: Sequence[int],
) -> list[Channel]:
    r"""Return H delayed by some periods and divided by the denominator's modulus, and the part of
    it that numerators of so many coefficients can explain.

    From $dH = dB/\chi - H\, d\chi/\chi$ at z and at 1/z, with a channel for all entries whose
    errors depend on the frequency in the same way.

    Where H_m and H_{-m} are different, sum and difference of H_m(w) and H_m(-w) = conj H_{-m}(w)
    are explained by cosines and sines times the coefficients of B_m, whose real and imaginary parts
    are thereby apart: with the same real equations as those of the real B_0. This requires errors
    of the same size in both; otherwise all four equations are taken together.
    """
    N, f = htf.n_sections, np.asarray(htf.f)
    require_symmetric(htf.harmonics, N)
    weight = dict(zip(htf.harmonics, error_weights(htf, check_values(htf))[..., 0], strict=True))
    delay = np.exp(-2j * np.pi * f)
    size_of_chi = np.abs(chi(delay, c))
    delayed = delay ** np.array(delays)[:, None] / size_of_chi
    slope = {
        m: weight[m] * H[:, :, 0] * delayed[..., None]
        for m, H in zip(htf.harmonics, np.asarray(htf.H), strict=True)
    }  # (delays, F, ny)
    angle = 2 * np.pi / N * f[:, None] * np.arange(size)
    cosines, sines = np.cos(angle), np.sin(angle)
    powers = np.concatenate([cosines, -sines])
    groups: dict[bytes, tuple[np.ndarray, list[np.ndarray]]] = {}

    def add(basis: np.ndarray, factor: np.ndarray, *entries: tuple[np.ndarray, ...]) -> None:
        # (Only the shape of the factors counts: numerators take any size.)
        shape = factor / factor.max()
        key = np.round(shape, _EQUAL_WEIGHTS).tobytes()
        if key not in groups:
            shape = shape / np.tile(size_of_chi, len(shape) // len(f))
            groups[key] = powers_basis(basis)[0] * shape[:, None], []
        groups[key][1].extend(np.concatenate(parts, axis=1).T for parts in entries)

    for m in htf.harmonics:
        if m < 0 and -m in weight:
            continue
        for i in range(len(htf.outputs)):
            h, w = slope[m][..., i], weight[m][:, i]
            if 2 * m % N == 0:
                add(powers, np.tile(w, 2), (h.real, h.imag))
                continue
            mirror, v = slope[-m][..., i], weight[-m][:, i]
            if np.allclose(v, w, rtol=10.0**-_EQUAL_WEIGHTS, atol=0):
                even, odd = (h + mirror.conj()) / 2**0.5, (h - mirror.conj()) / 2**0.5
                add(powers, np.tile(w, 2), (even.real, odd.imag), (even.imag, -odd.real))
                continue
            both = [[cosines, sines], [-sines, cosines], [cosines, -sines], [-sines, -cosines]]
            parts = h.real, h.imag, mirror.real, mirror.imag
            add(np.block(both), np.concatenate([w, w, v, v]), parts)
    return [
        Channel(
            np.tile(cosine, len(basis) // len(f)),
            basis,
            np.stack(entries, axis=2).reshape(len(basis), -1),
        )
        for basis, entries in groups.values()
    ]


class OrderCriterion(Criterion):
    """One over the misfit of the best model with fewer multipliers."""

    names: tuple[str, ...]
    channels: tuple[Channel, ...]
    """H delayed by 0, 1, ... periods, and no denominator."""
    delay: Complex[np.ndarray, " K"]
    """z^-N of each cosine."""
    starts: tuple[np.ndarray, ...]
    """Denominators from which the best one is sought."""

    def only(self, kept: Kept) -> "OrderCriterion":
        channels = only_channels(self.channels, kept)
        return OrderCriterion(self.names, channels, self.delay[kept], self.starts)

    def bound(self, power: Powers) -> Bound:
        def misfit(c: np.ndarray) -> tuple[float, np.ndarray]:
            total, slope = 0.0, np.zeros(len(c))
            for channel in self.channels:
                residual, target = self._residual(channel, c, power)
                total += (residual**2).sum()
                z = self.delay[np.unique(channel.cosine)]
                r, fitted = _complex(residual, len(z)), _complex(target - residual, len(z))
                each = (r.conj() * fitted).sum(axis=(0, 2)) / chi(z, c)
                slope += 2 * (z ** np.arange(1, len(c) + 1)[:, None] @ each).real
            return total, slope

        best = self.starts[0]
        if len(best):
            minima = [minimize(misfit, c, jac=True, method="BFGS") for c in self.starts]
            best = min(minima, key=lambda minimum: minimum.fun).x
        squares, size = np.zeros(len(power)), 0.0
        for channel in self.channels:
            residual, target = self._residual(channel, best, power)
            squares += np.bincount(channel.cosine, (residual**2).sum(axis=1), len(power))
            size += (target**2).sum()
        T = squares.sum()
        if not T > _ROUNDING * size:
            raise DefinitionError(
                "fewer multipliers explain these lines as well: the orders are indistinguishable."
            )
        return Bound(np.array([1 / T]), squares / power / T**2, float(1 / T))

    def _residual(
        self, channel: Channel, c: Float[np.ndarray, " d"], power: Powers
    ) -> tuple[Float[np.ndarray, "E n"], Float[np.ndarray, "E n"]]:
        r"""Return the part of $\chi H / |\chi|$ that numerators do not explain, and all of it."""
        size_of_chi = np.abs(chi(self.delay[channel.cosine], c))
        weight = (np.sqrt(power)[channel.cosine] / size_of_chi)[:, None]
        q, _ = np.linalg.qr(weight * channel.basis)
        delayed = channel.slopes.reshape(len(weight), len(c) + 1, -1)
        target = weight * np.tensordot(np.concatenate([[1.0], c]), delayed, axes=(0, 1))
        return target - q @ (q.T @ target), target


def order_criterion(goal: Order, model: Model, cosines: Candidates, noise: Noise) -> OrderCriterion:
    """**Raises:** `DefinitionError` for a rival with as many multipliers."""
    multipliers, rival = np.asarray(model.multipliers, complex), goal.fewer
    if rival >= len(multipliers):
        raise DefinitionError(
            f"`goal`: {rival} multipliers are not fewer than the model's {len(multipliers)}."
        )
    size = coefficients(rival, cosines.n_sections, goal.overhang)
    channels = []
    for htf, cosine, _ in measured_htfs(model, cosines, goal.harmonics, noise):
        require_frequencies(htf, rival, size)
        channels += _channels(htf, cosine, np.zeros(rival), size, range(rival + 1))
    largest = np.real(multipliers[:rival])
    starts = tuple(np.atleast_1d(np.poly(part * largest))[1:] for part in _STARTS)
    name = f"misfit with {rival} multiplier{'s' * (rival != 1)}"
    delay = np.exp(-2j * np.pi * cosines.f)
    return OrderCriterion((name,), tuple(channels), delay, starts if rival else starts[:1])


def _complex(values: Float[np.ndarray, "E n"], lines: int) -> Complex[np.ndarray, "B lines n"]:
    """Return complex numbers from alternating blocks of real and imaginary parts."""
    blocks = values.reshape(-1, 2, lines, values.shape[1])
    return blocks[:, 0] + 1j * blocks[:, 1]
