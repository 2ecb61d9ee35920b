r"""Multipliers from natural variability, with intervals by a block bootstrap.

With $x_k$ the state at a section in cycle k, $x_{k+1} = J x_k + w_k$, and $z_k = x_k + v_k$ is
measured. Least squares on $z_k$ gives $J \Sigma_x (\Sigma_x + \Sigma_v)^{-1}$: noise of measurement
biases towards fast decay. States $q_k$ at earlier sections of the same cycle are correlated with
$x_k$, but not with the noise $v_k$ and the later disturbance $w_k$; so

$$J = E[z_{k+1} q_k^T] \, E[z_k q_k^T]^{+}$$

has no such bias (instrumental variables, two-stage least squares: Söderström and Stoica 1983).

`natural_multipliers` calls `_estimate`: `_moments` computes the products for each cycle and
section, these are summed with weights (all cycles first, then the draws of the bootstrap,
`_resampled`), and `_multipliers` gives the result. `_corrected` removes the bias of short records.
Two things must stay: the order of the fields of `_Moments`, which `_estimate` takes by their place,
and the row of ones in front of all draws, which gives the estimate itself.

Wrong multipliers have their cause in `_moments` or `_corrected`, wrong intervals in `_resampled`.
"""

import dataclasses
from collections.abc import Iterator
from typing import Annotated, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Complex, Float, Int
from scipy import stats

from .._core.boundary.checked import checked, checked_methods
from .._core.boundary.kinds import Probability, Seed
from .._core.boundary.values import Whole
from .._core.findings import Finding, print_findings
from .._core.progress import working
from .._core.showable import WithMultipliers
from .._core.text import columns, rounded, standard_error
from ..errors import DefinitionError
from ..identify.denominator import coefficients_of
from ..identify.multiplier_estimate import (
    MultiplierComparison,
    Truth,
    compare_multipliers,
)
from ..linear.multipliers import conjugate_of, largest_first
from .data import SectionData
from .fit_warnings import about_natural_multipliers
from .inspection.differences import alternating_cycles


# Draws of the bootstrap. More: time. Fewer: the ends of intervals scatter.
_DRAWS = 1000
# Number of cycles of a block, in units of the third root of the number of all cycles. More: there
# are few blocks. Fewer: successive cycles, whose errors are correlated, fall into different blocks,
# and intervals are too narrow.
_BLOCK = 2.0
# Least number of cycles of a block, and of blocks in a record; with fewer blocks, whole records are
# drawn. More: there are few blocks. Fewer: blocks are shorter than correlations of disturbances
# last.
_SHORTEST_BLOCK = 4
# Three numbers are equal to this: of sections in a state, of sections between a state and its
# instruments, and of combinations of instruments per dimension of the state. More: weak
# instruments, and a first stage that follows noise. Fewer: smoothing correlates the noise of state
# and instruments, and directions are missed.
_EACH = 2
# Largest modulus of multipliers for which a bias is computed; larger ones get the bias of this
# modulus. Larger: infinite bias. Smaller: a part of the bias is left in slow multipliers.
_STABLE = 0.99
# Variances of combinations of states are at least this part of the largest one. Larger: small
# variances are overstated. Smaller: noise of covariances is amplified.
_LEAST_VARIANCE = 1e-3

Draws = Complex[np.ndarray, "B d"]
MultiplierCount = Annotated[int, Whole(1, 12)]


@checked_methods
class NaturalMultipliers(WithMultipliers, eqx.Module):
    """Multipliers of a rhythm that nobody perturbed.

    **Fields:**

    - `multipliers` (d,): estimated by instruments, which removes the bias of
      measurement noise. The bias of few cycles is corrected.
    - `plain` (d,): estimated by least squares on the return map, as is usual. It has both biases.
    - `draws`, `plain_draws` (B, d): both for B resamplings of blocks of cycles. The values of a
      draw are matched with the nearest of `multipliers` or `plain`.
    - `strength`: fraction of the states' variance that the instruments explain.
    - `cycles`: number of used cycles; each is followed by another cycle. `records`: number of
      records. `block`: number of cycles in a block, or in a record if whole records are drawn.
    - `findings`: reasons to doubt the multipliers. There is one if a further multiplier, such as
      one for slow drift of the outputs, changes the largest modulus.
    """

    multipliers: Complex[np.ndarray, " d"]
    plain: Complex[np.ndarray, " d"]
    draws: Draws
    plain_draws: Draws
    strength: float = eqx.field(static=True)
    cycles: int = eqx.field(static=True)
    records: int = eqx.field(static=True)
    block: int = eqx.field(static=True)
    findings: tuple[Finding, ...] = ()

    @property
    def standard_errors(self) -> Float[np.ndarray, " d"]:
        """Root of the expected squared distance of each multiplier from the true value, over the
        resamplings."""
        return np.sqrt(np.trace(self.multiplier_covariances, axis1=1, axis2=2))

    @property
    def multiplier_covariances(self) -> Float[np.ndarray, "d 2 2"]:
        """Covariance of (Re, Im) of each multiplier over the resamplings. The imaginary part of a
        real multiplier has no variance."""
        return _covariances(self.multipliers, self.draws)

    @property
    def coefficients(self) -> Float[np.ndarray, " d"]:
        """Coefficients of the polynomial of the multipliers, without the leading 1."""
        return coefficients_of(self.multipliers)

    @property
    def covariance(self) -> Float[np.ndarray, "d d"]:
        """Covariance of the coefficients, over the resamplings."""
        polynomials = [coefficients_of(x) for x in self.draws]
        d = len(self.multipliers)
        return np.cov(polynomials, rowvar=False).reshape(d, d)

    @property
    def covariance_dof(self) -> float:
        """Degrees of freedom of the covariances: the number of blocks less one."""
        return self._blocks - 1

    @property
    def _blocks(self) -> float:
        """Number of blocks that are drawn."""
        return max(self.cycles / self.block, 2.0)

    def contains(
        self, true: Truth, level: Probability = 0.95
    ) -> Bool[np.ndarray, " d"]:
        """Test whether the modulus of each true multiplier, paired with these, lies in its
        interval.

        **Example:**

        ```python
        found = hj.recordings.natural_multipliers(result.data)
        print(found.contains(0.9))
        ```
        """
        paired = self.compare(true)
        order = [int(np.argmin(abs(self.multipliers - z))) for z in paired.estimated]
        low, high = self.interval(level)[order].T
        modulus = np.abs(paired.true)
        return (low <= modulus) & (modulus <= high)

    def compare(self, other: Truth) -> MultiplierComparison:
        """Pair the multipliers with true multipliers, or with the multipliers of another fit. There
        is no test: see `interval`.

        **Example:**

        ```python
        found = hj.recordings.natural_multipliers(result.data)
        print(found.compare(cycle))
        ```
        """
        return compare_multipliers(self.multipliers, other)

    def interval(
        self,
        level: Probability = 0.95,
        *,
        plain: bool = False,
    ) -> Float[np.ndarray, "d 2"]:
        """Return bounds that hold the modulus of each multiplier with this probability,
        in the order of moduli. A complex pair has one modulus, and one interval. With
        `plain`, the bounds are those of least squares.

        They are the estimate plus and minus the standard error of the bootstrap, times
        the quantile of Student's distribution for so many blocks. Percentiles of the
        bootstrap would lie on the wrong side: estimates of slow multipliers scatter
        towards zero, so that the true value lies above. A real multiplier whose
        interval contains 0 has moduli from 0 on.

        **Example:**

        ```python
        found = hj.recordings.natural_multipliers(result.data)
        (low, high), *_ = found.interval(0.9)
        ```
        """
        blocks = self._blocks
        wider = np.sqrt(blocks / (blocks - 1))
        quantile = stats.t.ppf((1 + level) / 2, blocks - 1)
        reach = wider * quantile
        values = self.plain if plain else self.multipliers
        draws = self.plain_draws if plain else self.draws
        is_real = np.imag(values) == 0
        center = np.where(is_real, np.real(values), np.abs(values))
        drawn = np.where(is_real, np.real(draws), _moduli(values, draws))
        half = reach * drawn.std(axis=0)
        pair = np.stack([center - half, center + half], axis=1)
        ends = np.abs(pair)
        excludes_zero = half < np.abs(center)
        low = np.where(excludes_zero, ends.min(axis=1), 0.0)
        return np.stack([low, ends.max(axis=1)], axis=1)

    def __repr__(self) -> str:
        rows = [
            *_rows_of("by instruments", self.multipliers, self.draws, self.interval()),
            *_rows_of(
                "least squares",
                self.plain,
                self.plain_draws,
                self.interval(plain=True),
            ),
        ]
        head = (
            f"NaturalMultipliers({self.cycles} cycles, order {len(self.multipliers)}, blocks of "
            f"{self.block} cycles)"
        )
        findings = print_findings(self.findings, "  ")
        return f"{head}{columns(rows)}\n{findings}".rstrip()


def _covariances(
    values: Complex[np.ndarray, " d"], draws: Draws
) -> Float[np.ndarray, "d 2 2"]:
    """Return the covariance of (Re, Im) of each multiplier over draws. A real multiplier has no
    imaginary part; those of a pair mirror each other."""
    covariances = np.zeros((len(values), 2, 2))
    for k, z in enumerate(values):
        drawn = draws[:, k]
        if z.imag:
            mirrored = draws[:, conjugate_of(values, k)].conj()
            both = np.concatenate([drawn, mirrored])
            covariances[k] = np.cov(np.real(both), np.imag(both))
        else:
            covariances[k, 0, 0] = np.real(drawn).var()
    return covariances


def _moduli(
    values: Complex[np.ndarray, " d"], draws: Draws
) -> Float[np.ndarray, "B d"]:
    """Return the moduli of draws. If the estimates are a complex pair, both get the square root of
    the product of the two draws, since these may be two real numbers, one larger and one smaller
    than the modulus."""
    moduli = np.abs(draws)
    for k in np.flatnonzero(np.imag(values) > 0).tolist():
        twin = conjugate_of(values, k)
        square = moduli[:, k] * moduli[:, twin]
        common = np.sqrt(square)
        moduli[:, [k, twin]] = common[:, None]
    return moduli


def _beside(values: Complex[np.ndarray, " d"], draws: Draws) -> Draws:
    """Return draws in the order in which the sum of their distances from the values is smallest."""
    from scipy.optimize import linear_sum_assignment  # (a third of a second)

    if len(values) == 1:
        return draws
    ordered = np.empty_like(draws)
    for row, drawn in enumerate(draws):
        distances = np.abs(values[:, None] - drawn)
        _, columns = linear_sum_assignment(distances)
        ordered[row] = drawn[columns]
    return ordered


def _rows_of(
    name: str,
    multipliers: Complex[np.ndarray, " d"],
    draws: Draws,
    bounds: Float[np.ndarray, "d 2"],
) -> Iterator[tuple[str, ...]]:
    """Yield rows of multipliers with their standard errors, and the modulus of a pair once."""
    variances = np.linalg.trace(_covariances(multipliers, draws))
    for z, error, (low, high) in zip(
        multipliers, np.sqrt(variances), bounds, strict=True
    ):
        value = f"{rounded(z, error)} ± {standard_error(error)}"
        modulus = f"modulus {abs(z):.3f}, 95 %: {low:.3f} to {high:.3f}"
        yield name, value, modulus if z.imag >= 0 else ""


@checked
@working("natural_multipliers")
def natural_multipliers(
    data: SectionData,
    order: MultiplierCount = 1,
    *,
    seed: Seed = 0,
) -> NaturalMultipliers:
    r"""Estimate Floquet multipliers from variability alone: output-only identification.

    The return map of every section is estimated from the deviations in successive
    cycles, as in the Floquet analysis of gait (Hurmuzlu and Basdogan 1994).
    Disturbances of the rhythm are unknown, and are assumed to be independent from cycle
    to cycle. The state at a section consists of combinations of all outputs at this
    section and the one before. It has the `order` combinations with the largest
    variance. All sections have the same multipliers: the coefficients of their
    characteristic polynomials are averaged.

    The mean of each record is estimated, which biases the multipliers if there are few cycles. This
    bias is corrected to first order in the inverse number of cycles (Nicholls and Pope 1988).
    Measurement noise
    biases a plain regression towards zero (Dingwell and Cusumano 2000 show why to be careful with
    so few cycles and so much noise). Here the states at earlier sections of the same cycle serve as
    instruments: noise that is not correlated over three sections or more has no effect on them.

    **Arguments:**

    - `data`: result of `sample_sections(..., inputs=())`; the average cycle of each trial is
      subtracted.
    - `order`: the number of multipliers. Combinations that vary less than these count as
      disturbances. If one multiplier more contradicts the largest modulus, `findings` say so.
      Default: 1.
    - `seed`: seed of the bootstrap, which draws blocks of successive cycles with
      replacement (Künsch 1989), within each record. If records are short, it draws
      whole records. Default: 0.

    **Returns:** `hj.recordings.NaturalMultipliers`: `multipliers` (d,), complex, without unit;
    `draws` (B, d) of the bootstrap, from which `interval` follows; `plain` (d,), those of a plain
    regression; `findings`.

    **Raises:** `DefinitionError` for too few cycles or signals.

    **Example:**

    ```python
    names = {"inputs": (), "outputs": ("yM", "vM")}
    strides = hj.recordings.sample_sections(recording, apex, n_sections=8, **names)
    natural = hj.recordings.natural_multipliers(strides, order=2)
    print(natural.multipliers, natural.interval())
    ```

    **Before:** `hj.recordings.sample_sections(..., inputs=())`. **After:** `natural.interval`.
    """
    result = _estimate(data, order, seed)
    findings = [*alternating_cycles(data), *about_natural_multipliers(result)]
    try:
        larger = _estimate(data, order + 1, seed)
    except DefinitionError:
        larger = None
    if larger is not None and not (
        _contains(result, larger) or _contains(larger, result)
    ):
        findings.append(
            Finding(
                "order",
                f"{order + 1} multipliers give {abs(larger.multipliers[0]):.3f} for the largest "
                "modulus: raise `order`, or, if outputs drift, take them `without_drift`.",
            )
        )
    return dataclasses.replace(result, findings=tuple(findings))


def _contains(result: NaturalMultipliers, other: NaturalMultipliers) -> bool:
    """Return whether the interval of the largest modulus contains that of another result."""
    low, high = result.interval()[0]
    return bool(low <= abs(other.multipliers[0]) <= high)


def _estimate(data: SectionData, order: int, seed: int) -> NaturalMultipliers:
    """Estimate `order` multipliers. (Another order is not tried.)"""
    moments = _moments(data, order)
    K = len(moments.records)
    _, counts = np.unique(moments.records, return_counts=True)
    by_length = round(_BLOCK * K ** (1 / 3))
    block = max(_SHORTEST_BLOCK, by_length)
    are_short = np.median(counts) < _SHORTEST_BLOCK * block
    if are_short and len(counts) >= _SHORTEST_BLOCK:
        # (Many short records: whole records are drawn.)
        block = int(counts.max())
    rng = np.random.default_rng(seed)
    # The first row of weights is that of the estimate (all cycles once), the others are draws.
    weights = np.vstack([np.ones(K), _resampled(moments.records, block, rng)])
    state, forward, square, cross, ahead = (
        np.tensordot(weights, products, (1, 1)) for products in moments[:5]
    )
    # Two stages: states from instruments, then the next states from these.
    first_stage = np.linalg.pinv(square, hermitian=True) @ cross.mT
    second_stage = np.linalg.pinv(cross @ first_stage)
    by_instruments = ahead @ first_stage @ second_stage
    # (The covariance includes the noise of the states: without it, weak instruments give variances
    # near zero.)
    mean_length = K / len(counts)
    maps = _corrected(by_instruments, state / K, mean_length)
    multipliers = _multipliers(maps)
    plain_maps = forward @ np.linalg.inv(state)
    plain = _multipliers(plain_maps)
    by_instrument = np.linalg.solve(square[0], cross[0].mT)
    explained = cross[0] @ by_instrument
    whole = np.trace(state[0], axis1=1, axis2=2)
    shares = np.trace(explained, axis1=1, axis2=2) / whole
    return NaturalMultipliers(
        multipliers=multipliers[0],
        plain=plain[0],
        draws=_beside(multipliers[0], multipliers[1:]),
        plain_draws=_beside(plain[0], plain[1:]),
        strength=float(shares.mean()),
        cycles=K,
        records=len(counts),
        block=block,
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
    N = data.n_sections
    outputs = np.concatenate([x.y for x in data.records])
    size = np.nanstd(outputs, axis=0)
    if order > _EACH * len(size):
        raise DefinitionError(
            f"`order` must be at most {_EACH * len(size)}, the size of a state."
        )
    rows = _rows(data)
    pairs = rows[:, :2]
    names, cycle = np.unique(pairs, axis=0, return_inverse=True)
    K = len(names)
    needed = 2 * (_EACH * order + 2)
    if K < needed:
        raise DefinitionError(
            f"{K} cycles that are followed by another one are too few for {order} multipliers: "
            f"record {needed} or more."
        )

    def values(shift: int, count: int) -> Float[np.ndarray, "rows k"]:
        """Return the outputs at `count` sections, the last of which is `shift` sections before the
        state."""
        return np.array(
            [
                (data.records[s].y[k - shift - np.arange(count)] / size).ravel()
                for s, _, _, k in rows
            ]
        )

    state = values(0, _EACH)
    after = values(-N, _EACH)
    instruments = values(2 * _EACH - 1, _EACH + 1)
    columns = np.hstack([state, after, instruments])
    known = np.isfinite(columns).all(axis=1)
    most = min(_EACH * (order + 1), instruments.shape[1])
    moments = _Moments(
        state=np.zeros((N, K, order, order)),
        forward=np.zeros((N, K, order, order)),
        square=np.zeros((N, K, most, most)),
        cross=np.zeros((N, K, order, most)),
        ahead=np.zeros((N, K, order, most)),
        records=names[:, 0],
    )
    for n in range(N):
        in_section = rows[:, 2] == n
        at = np.flatnonzero(known & in_section)
        if len(at) <= most + 1:
            raise DefinitionError(
                f"section {n} was seen in {len(at)} cycles only: record longer."
            )
        x, z = _principal(state[at], after[at], order)
        q, _ = _principal(instruments[at], instruments[at], most)
        place = (n, cycle[at])
        moments.state[place] = _products(x, x)
        moments.forward[place] = _products(z, x)
        moments.square[place] = _products(q, q)
        moments.cross[place] = _products(x, q)
        moments.ahead[place] = _products(z, q)
    return moments


def _rows(data: SectionData) -> Int[np.ndarray, "rows 4"]:
    """Return record, cycle, section and sample of all states that have instruments before them and
    a next state."""
    N = data.n_sections
    before = 3 * _EACH  # (instruments need one section more)
    rows = [np.zeros((0, 4), int)]
    for s, record in enumerate(data.records):
        sample = np.arange(before, len(record.y) - N)
        cycle, section = np.divmod(record.first_section + sample, N)
        numbers = np.full_like(sample, s)
        rows.append(np.stack([numbers, cycle, section, sample], axis=1))
    return np.concatenate(rows)


def _products(
    a: Float[np.ndarray, "k d"],
    b: Float[np.ndarray, "k r"],
) -> Float[np.ndarray, "k d r"]:
    return a[:, :, None] * b[:, None, :]


def _principal(
    x: Float[np.ndarray, "k p"],
    other: Float[np.ndarray, "k p"],
    count: int,
) -> tuple[Float[np.ndarray, "k d"], Float[np.ndarray, "k d"]]:
    """Return both arguments in the combinations of columns along which the first one varies most,
    scaled to variance 1."""
    mean = x.mean(axis=0)
    _, s, axes = np.linalg.svd(x - mean, full_matrices=False)
    rounding = 1e-9 * s[0]
    size = np.maximum(s[:count], rounding)  # below: rounding
    scaled = axes[:count].T / size
    onto = scaled * np.sqrt(len(x))
    other_deviation = other - other.mean(axis=0)
    return (x - mean) @ onto, other_deviation @ onto


def _multipliers(maps: Float[np.ndarray, "B N d d"]) -> Draws:
    """Return roots of the mean characteristic polynomial over the sections, the largest first."""
    values = np.linalg.eigvals(maps)
    draws, sections, d = values.shape
    # The coefficients of (z - values[0]) (z - values[1]) ..., the highest power first.
    polynomial = np.ones((draws, sections, 1), complex)
    behind = ((0, 0), (0, 0), (0, 1))
    ahead = ((0, 0), (0, 0), (1, 0))
    for k in range(d):
        times_z = np.pad(polynomial, behind)
        shifted = np.pad(polynomial, ahead)
        times_value = values[..., k, None] * shifted
        polynomial = times_z - times_value
    mean = np.real(polynomial).mean(axis=1)
    # (Roots are eigenvalues of companion matrices, of all draws at once.)
    companion = np.zeros((draws, d, d))
    companion[:, 0] = -mean[:, 1:]
    companion[:, 1:, :-1] = np.eye(d - 1)
    roots = np.linalg.eigvals(companion).astype(complex)
    return np.take_along_axis(roots, largest_first(roots), axis=1)


def _corrected(
    maps: Float[np.ndarray, "B N d d"],
    covariance: Float[np.ndarray, "B N d d"],
    length: float,
) -> Float[np.ndarray, "B N d d"]:
    r"""Return maps without the bias of first order by the unknown mean of each record and by
    regression on the past (Nicholls and Pope 1988). In records of a given length, the bias is

    $$-G \left[(I - J^T)^{-1} + J^T (I - J^T J^T)^{-1}
    + \sum_i \lambda_i (I - \lambda_i J^T)^{-1}\right] \Sigma^{-1}$$

    divided by the length, with $G = \Sigma - J \Sigma J^T$ the covariance of the disturbances. For
    one multiplier this is Kendall's (1 + 3 z) / length.
    """
    d = maps.shape[-1]
    eye = np.eye(d)
    state = _positive(covariance)
    carried = maps @ state @ maps.mT
    disturbances = _positive(state - carried)
    values = np.linalg.eigvals(maps)
    # (Unstable draws get the bias at the edge of stability.)
    largest = np.abs(values).max(axis=-1)
    inside = np.minimum(1.0, _STABLE / np.maximum(largest, _STABLE))
    values = values * inside[..., None]
    back = maps.mT * inside[..., None, None]
    # The three terms of the formula.
    by_mean = np.linalg.inv(eye - back)
    by_past = back @ np.linalg.inv(eye - back @ back)
    sums = by_mean + by_past
    for k in range(d):
        value = values[..., k, None, None]
        by_value = value * np.linalg.inv(eye - value * back)
        sums = sums + by_value.real
    change = disturbances @ sums @ np.linalg.inv(state) / length
    # (For d equal multipliers, the change is at most 3 + d; for maps far from normal, it could be
    # arbitrarily large.)
    largest_change = (3 + d) / length
    norm = np.linalg.norm(change, 2, axis=(-2, -1))
    size = norm[..., None, None]
    kept = np.minimum(1.0, largest_change / np.maximum(size, largest_change))
    return maps + change * kept


def _positive(covariance: Float[np.ndarray, "B N d d"]) -> Float[np.ndarray, "B N d d"]:
    """Return the nearest covariances of full rank: estimates may have negative variances."""
    symmetric = (covariance + covariance.mT) / 2
    values, axes = np.linalg.eigh(symmetric)
    largest = np.abs(values[..., -1:])
    least = _LEAST_VARIANCE * largest
    positive_values = np.maximum(values, least)[..., None, :]
    return (axes * positive_values) @ axes.mT


def _resampled(
    records: Int[np.ndarray, " K"],
    block: int,
    rng: np.random.Generator,
) -> Float[np.ndarray, "B K"]:
    """Draw blocks of each record (or whole records) with replacement. Return how often each cycle
    occurs in each draw."""
    names, place, counts = np.unique(records, return_inverse=True, return_counts=True)
    weights = np.zeros((_DRAWS, len(records)))
    if block == counts.max():
        for row in weights:
            chosen = rng.choice(len(names), len(names))
            row[:] = np.bincount(chosen, minlength=len(names))[place]
        return weights
    cycles = [np.flatnonzero(records == name) for name in names]
    for row in weights:
        for own in cycles:
            count = len(own)
            length = min(block, count)
            number = -(-count // length)
            starts = rng.integers(0, count - length + 1, number)
            places = starts[:, None] + np.arange(length)
            drawn = places.ravel()[:count]
            row[own] += np.bincount(drawn, minlength=count)
    return weights
