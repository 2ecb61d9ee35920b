r"""Multipliers from natural variability, with intervals by a block bootstrap.

With $x_k$ the state at a section in cycle k, $x_{k+1} = J x_k + w_k$, and $z_k = x_k + v_k$ is
measured. Least squares on $z_k$ gives $J \Sigma_x (\Sigma_x + \Sigma_v)^{-1}$: noise biases towards
fast decay. States $q_k$ at earlier sections of the same cycle depend on $x_k$, but not on its
noise, and not on what happens after it; so

$$J = E[z_{k+1} q_k^T] \, E[z_k q_k^T]^{+}$$

has no such bias (instrumental variables, two-stage least squares: Söderström and Stoica 1983).
"""

import dataclasses
from typing import Annotated, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Complex, Float, Int
from scipy import stats

from .._core.boundary.checked import checked, checked_methods
from .._core.boundary.kinds import Probability, Seed
from .._core.boundary.values import Whole
from .._core.findings import Finding, print_findings
from .._core.progress import working
from ..errors import DefinitionError
from .data import SectionData
from .fit_warnings import about_natural_multipliers


# Draws of the bootstrap. More: time. Fewer: the ends of intervals scatter.
_DRAWS = 1000
# Fewest cycles of a block (else the third root of their number), and of blocks in a record, below
# which whole records are drawn. More: few blocks. Fewer: memory of disturbances is cut.
_SHORTEST_BLOCK = 4
# Number of sections of a state, of sections between a state and its instruments, and of
# combinations of the instruments per dimension of the state. More: weak instruments, and a first
# stage that follows noise. Fewer: smoothing correlates their noise, and directions are missed.
_EACH = 2

Draws = Complex[np.ndarray, "B d"]
MultiplierCount = Annotated[int, Whole(1, 12)]


@checked_methods
class NaturalMultipliers(eqx.Module):
    """Multipliers of a rhythm that nobody perturbed.

    **Fields:**

    - `multipliers` (d,): by instruments, without the bias of measurement noise, and with that of
      few cycles corrected.
    - `plain` (d,): by least squares on the return map, as is usual; with both biases.
    - `draws`, `plain_draws` (B, d): both for B resamplings of blocks of cycles.
    - `strength`: fraction of the states' variance that the instruments explain.
    - `cycles`: number of used cycles, which are followed by another one, in so many `records`.
      `block`: cycles of a block; those of a record, where whole records are drawn.
    - `doubt`: a sentence if one multiplier more changes the largest modulus, as one for slow drift
      of the outputs does; else "".
    """

    multipliers: Complex[np.ndarray, " d"]
    plain: Complex[np.ndarray, " d"]
    draws: Draws
    plain_draws: Draws
    strength: float = eqx.field(static=True)
    cycles: int = eqx.field(static=True)
    records: int = eqx.field(static=True)
    block: int = eqx.field(static=True)
    doubt: str = eqx.field(static=True, default="")

    def interval(
        self, level: Probability = 0.95, *, plain: bool = False
    ) -> Float[np.ndarray, "d 2"]:
        """Return bounds that hold the modulus of each multiplier with this probability, in the
        order of moduli; `plain`: those of least squares.

        They are percentiles of the bootstrap, widened by the ratio of Student's distribution for so
        many blocks to the normal one (Hesterberg, *Am. Stat.* 69, 2015).
        """
        n = max(self.cycles / self.block, 2.0)
        reach = np.sqrt(n / (n - 1)) * stats.t.ppf((1 + level) / 2, n - 1)
        draws = self.plain_draws if plain else self.draws
        return np.quantile(np.abs(draws), stats.norm.cdf([-reach, reach]), axis=0).T

    @property
    def warnings(self) -> tuple[Finding, ...]:
        """Limits of what the data support."""
        return tuple(about_natural_multipliers(self))

    def __repr__(self) -> str:
        d, b = len(self.multipliers), self.block
        lines = [
            f"NaturalMultipliers({self.cycles} cycles, order {d}, blocks of {b} cycles)"
        ]
        for plain, values in enumerate((self.multipliers, self.plain)):
            for z, (low, high) in zip(
                values, self.interval(plain=bool(plain)), strict=True
            ):
                name = "least squares" if plain else "by instruments"
                value = f"{z.real:.3f}" if abs(z.imag) < 1e-12 else f"{z:.3f}"
                bounds = f"modulus {abs(z):.3f}, 95 %: {low:.3f} to {high:.3f}"
                lines.append(f"  {name:15s} {value:>15s}   {bounds}")
        return "\n".join([*lines, print_findings(self.warnings, "  ")]).rstrip()


@checked
@working("natural_multipliers")
def natural_multipliers(
    data: SectionData, order: MultiplierCount = 1, *, seed: Seed = 0
) -> NaturalMultipliers:
    r"""Estimate Floquet multipliers from variability alone: output-only identification.

    The return map of every section is estimated from the deviations in successive cycles, as in the
    Floquet analysis of gait (Hurmuzlu and Basdogan 1994). Disturbances of the rhythm are unknown,
    and taken as independent from cycle to cycle. The state at a section consists of all outputs
    there and at the section before, in the `order` combinations that vary most. All sections have
    the same multipliers: the coefficients of their characteristic polynomials are averaged.

    The mean of each record is estimated, which biases the multipliers if there are few cycles. This
    bias is corrected to first order in the inverse number of cycles (Pope 1990). Measurement noise
    biases a plain regression towards zero (Dingwell and Cusumano 2000 show why to be careful with
    so few cycles and so much noise). Here the states at earlier sections of the same cycle serve as
    instruments: noise that is not correlated over three sections or more has no effect on them.

    **Arguments:**

    - `data`: result of `section_data(..., inputs=())`; the average cycle of each trial is
      subtracted.
    - `order`: the number of multipliers. Directions of smaller variance act as disturbances. If
      one multiplier more contradicts the largest modulus, `doubt` says so. Default: 1.
    - `seed`: seed of the bootstrap, which draws blocks of successive cycles with replacement
      (Künsch 1989), within each record; whole records where these are short.

    **Raises:** `DefinitionError` for too few cycles or signals.
    """
    result = _estimate(data, order, seed)
    try:
        larger = _estimate(data, order + 1, seed)
    except DefinitionError:
        return result
    pair = [(abs(x.multipliers[0]), x.interval()[0]) for x in (result, larger)]
    agree = any(low <= z <= high for (z, _), (_, (low, high)) in (pair, pair[::-1]))
    text = f"{order + 1} multipliers give {pair[1][0]:.3f} for the largest modulus: raise `order`"
    text += ", or, if outputs drift, take them `without_drift`."
    return result if agree else dataclasses.replace(result, doubt=text)


def _estimate(data: SectionData, order: int, seed: int) -> NaturalMultipliers:
    """Estimate so many multipliers, without a second number of them."""
    moments = _moments(data, order)
    K = len(moments.records)
    counts = np.unique(moments.records, return_counts=True)[1]
    length, block = K / len(counts), max(_SHORTEST_BLOCK, round(K ** (1 / 3)))
    if np.median(counts) < _SHORTEST_BLOCK * block and len(counts) >= _SHORTEST_BLOCK:
        block = int(counts.max())
    rng = np.random.default_rng(seed)
    # The first weights are those of all cycles, the others draws.
    drawn = [_resampled(moments.records, block, rng) for _ in range(_DRAWS)]
    weights = np.stack([np.ones(K), *drawn])
    state, forward, square, cross, ahead = (
        np.tensordot(weights, products, (1, 1)) for products in moments[:5]
    )
    first = np.linalg.pinv(square, hermitian=True) @ np.swapaxes(cross, 2, 3)
    by_instruments = _corrected(
        _multipliers(ahead @ first @ np.linalg.pinv(cross @ first)), length
    )
    plain = _multipliers(forward @ np.linalg.inv(state))
    explained = cross[0] @ np.linalg.solve(square[0], np.swapaxes(cross[0], 1, 2))
    shares = np.trace(explained, axis1=1, axis2=2) / np.trace(
        state[0], axis1=1, axis2=2
    )
    draws, plain_draws, strength = by_instruments[1:], plain[1:], float(shares.mean())
    return NaturalMultipliers(
        by_instruments[0], plain[0], draws, plain_draws, strength, K, len(counts), block
    )


class _Moments(NamedTuple):
    """Products of the state, the next state and the instruments of one cycle, for every section;
    zero where anything is missing."""

    state: Float[np.ndarray, "N K d d"]
    forward: Float[np.ndarray, "N K d d"]
    """Products of the next state with the state."""
    square: Float[np.ndarray, "N K r r"]
    """Products of the instruments with themselves."""
    cross: Float[np.ndarray, "N K d r"]
    """Products of the state with the instruments."""
    ahead: Float[np.ndarray, "N K d r"]
    """Products of the next state with the instruments."""
    records: Int[np.ndarray, " K"]
    """The record of each cycle."""


def _moments(data: SectionData, order: int) -> _Moments:
    """Return moments of the `order` combinations of signals that vary most at each section.

    **Raises:** `DefinitionError` for too few cycles, or signals, for so many.
    """
    N, before = (
        data.n_sections,
        3 * _EACH + 1,
    )  # of instruments there is one section more
    size = np.nanstd(np.concatenate([x.y for x in data.records]), axis=0)
    y = [r.y / size for r in data.records]
    if order > _EACH * len(size):
        raise DefinitionError(
            f"`order` must be at most {_EACH * len(size)}, the size of a state."
        )
    rows = np.array(
        [
            (s, (r.first_section + k) // N, (r.first_section + k) % N, k)
            for s, r in enumerate(data.records)
            for k in range(before - 1, len(r.y) - N)
        ]
    ).reshape(-1, 4)
    names, cycle = np.unique(rows[:, :2], axis=0, return_inverse=True)
    K, needed = len(names), 2 * (_EACH * order + 2)
    if K < needed:
        text = f"{K} cycles that are followed by another one are too few for {order} multipliers"
        raise DefinitionError(f"{text}: record {needed} or more.")

    def values(shift: int, count: int) -> Float[np.ndarray, "rows k"]:
        return np.array(
            [y[s][k - shift - np.arange(count)].ravel() for s, _, _, k in rows]
        )

    state, after = values(0, _EACH), values(-N, _EACH)
    instruments = values(2 * _EACH - 1, _EACH + 1)
    finite = np.isfinite(np.concatenate([state, after, instruments], axis=1)).all(
        axis=1
    )
    r = min(_EACH * (order + 1), instruments.shape[1])
    shapes = ((order, order), (order, order), (r, r), (order, r), (order, r))
    parts = [np.zeros((N, K, *shape)) for shape in shapes]
    for n in range(N):
        at = np.flatnonzero(finite & (rows[:, 2] == n))
        if len(at) <= r + 1:
            raise DefinitionError(
                f"section {n} was seen in {len(at)} cycles only: record longer."
            )
        x, z = _principal(state[at], after[at], order)
        q, _ = _principal(instruments[at], instruments[at], r)
        for part, (a, b) in zip(
            parts, ((x, x), (z, x), (q, q), (x, q), (z, q)), strict=True
        ):
            part[n, cycle[at]] = a[:, :, None] * b[:, None, :]
    return _Moments._make([*parts, names[:, 0]])


def _principal(
    x: Float[np.ndarray, "k p"], other: Float[np.ndarray, "k p"], count: int
) -> tuple[Float[np.ndarray, "k d"], Float[np.ndarray, "k d"]]:
    """Return both in the combinations along which the first varies most, with its variance 1."""
    mean = x.mean(axis=0)
    _, s, axes = np.linalg.svd(x - mean, full_matrices=False)
    onto = (
        axes[:count].T / np.maximum(s[:count], 1e-9 * s[0]) * np.sqrt(len(x))
    )  # below: rounding
    return (x - mean) @ onto, (other - other.mean(axis=0)) @ onto


def _multipliers(maps: Float[np.ndarray, "B N d d"]) -> Draws:
    """Return roots of the mean characteristic polynomial over the sections, the largest first."""
    values = np.linalg.eigvals(maps)
    c = np.ones((*values.shape[:2], 1), complex)
    for k in range(values.shape[2]):
        later = np.pad(c, ((0, 0), (0, 0), (1, 0))) * values[..., k, None]
        c = np.pad(c, ((0, 0), (0, 0), (0, 1))) - later
    return _largest_first(
        np.array([np.roots(x) for x in np.real(c).mean(axis=1)], complex)
    )


def _largest_first(z: Draws) -> Draws:
    return np.take_along_axis(z, np.argsort(-np.abs(z), axis=1, kind="stable"), axis=1)


def _corrected(z: Draws, length: float) -> Draws:
    """Remove the bias of first order that the unknown mean of each record, and regression on the
    past, make in records of so many cycles (Pope 1990, for disturbances along the eigenvectors; for
    one multiplier Kendall's (1 + 3 z) / length)."""
    a, b = z[:, :, None], z[:, None, :]
    ab = np.clip(np.abs(a * b), 0, 0.99) * np.exp(1j * np.angle(a * b))
    return _largest_first(
        z + (1 + 2 * z + (b * (1 - a**2) / (1 - ab)).sum(axis=2)) / length
    )


def _resampled(
    records: Int[np.ndarray, " K"], block: int, rng: np.random.Generator
) -> Float[np.ndarray, " K"]:
    """Draw blocks of each record, or whole records, and return how often each cycle was drawn."""
    weights = np.zeros(len(records))
    names, counts = np.unique(records, return_counts=True)
    if block == counts.max():
        return 1.0 * (records[:, None] == rng.choice(names, len(names))).sum(axis=1)
    for record, count in zip(names, counts, strict=True):
        length = min(block, count)
        starts = rng.integers(0, count - length + 1, -(-count // length))
        drawn = (starts[:, None] + np.arange(length)).ravel()[:count]
        np.add.at(weights, np.flatnonzero(records == record)[drawn], 1.0)
    return weights
