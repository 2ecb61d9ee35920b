"""Multipliers from natural variability, with intervals by a block bootstrap."""

from collections.abc import Iterator
from typing import Annotated

import equinox as eqx
import numpy as np
from jaxtyping import Complex, Float
from scipy import stats

from ..._core.boundary.checked import checked, checked_methods
from ..._core.boundary.kinds import Probability, Seed
from ..._core.boundary.values import Whole
from ..._core.html import card, complex_number, table, text
from ..._core.progress import working
from ..data import SectionData
from .moments import Moments, moments_of


# Draws of the bootstrap. Doubled: ends of intervals scatter 0.7 times as much.
_DRAWS = 1000
# Cycles of a block: the third root of their number, and not less than this. Doubled: longer memory
# of what disturbs the rhythm is allowed for, by fewer blocks.
_SHORTEST_BLOCK = 4
# Blocks in a record, below which whole records are drawn, if there are as many. Doubled: longer
# ones are, too.
_BLOCKS = 3
# Share of the states' variance that instruments must explain, below which they are weak. Doubled:
# more is said.
_WEAK = 0.5
# Cycles in a record, below which there are few. Doubled: more is said.
_FEW = 50

MultiplierCount = Annotated[int, Whole(1, 12)]


@checked_methods
class NaturalMultipliers(eqx.Module):
    """Multipliers of a rhythm that nobody perturbed.

    **Fields:**

    - `multipliers` (d,): by instruments, without the bias that measurement noise makes, and with
      that of few cycles corrected.
    - `plain` (d,): by least squares on the return map, as is usual; with both.
    - `draws`, `plain_draws` (B, d): both for B resamplings of blocks of cycles.
    - `strength`: the share of the states' variance that the instruments explain.
    - `cycles`: how many were used, that are followed by another one, of so many `records`.
      `block`: cycles of a block; those of a record, where whole records are drawn.
    """

    multipliers: Complex[np.ndarray, " d"]
    plain: Complex[np.ndarray, " d"]
    draws: Complex[np.ndarray, "B d"]
    plain_draws: Complex[np.ndarray, "B d"]
    strength: float = eqx.field(static=True)
    cycles: int = eqx.field(static=True)
    records: int = eqx.field(static=True)
    block: int = eqx.field(static=True)

    def interval(self, level: Probability = 0.95) -> Float[np.ndarray, "d 2"]:
        """Bounds that hold the modulus of each multiplier with this probability, in the order of
        moduli: percentiles of the bootstrap, further out by what Student's distribution is beyond
        the normal one for so many blocks (Hesterberg, *Am. Stat.* 69, 2015)."""
        return self._interval(self.draws, level)

    def plain_interval(self, level: Probability = 0.95) -> Float[np.ndarray, "d 2"]:
        """The same for least squares."""
        return self._interval(self.plain_draws, level)

    def _interval(self, draws: Complex[np.ndarray, "B d"], level: float):
        n = max(self.cycles / self.block, 2.0)
        reach = np.sqrt(n / (n - 1)) * stats.t.ppf((1 + level) / 2, n - 1)
        return np.quantile(np.abs(draws), stats.norm.cdf([-reach, reach]), axis=0).T

    @property
    def warnings(self) -> tuple[str, ...]:
        """What the data cannot tell, in plain words."""
        return tuple(_about(self))

    def _repr_html_(self) -> str:
        rows = [
            (name, complex_number(z, 3), f"{abs(z):.3f}", f"{low:.3f} to {high:.3f}")
            for name, values, intervals in self._both()
            for z, (low, high) in zip(values, intervals, strict=True)
        ]
        of = f"{self.cycles} cycles, order {len(self.multipliers)}, blocks of {self.block} cycles"
        head = ("", "multiplier", "modulus", "95 % interval")
        return card("NaturalMultipliers", of, table(head, rows), text("\n".join(self.warnings)))

    def _both(self):
        """Either way to estimate them, with moduli's intervals."""
        yield "by instruments", self.multipliers, self.interval()
        yield "least squares", self.plain, self.plain_interval()

    def __repr__(self) -> str:
        lines = [
            f"NaturalMultipliers({self.cycles} cycles, order {len(self.multipliers)}, blocks of "
            f"{self.block} cycles)"
        ]
        for name, values, intervals in self._both():
            for z, (low, high) in zip(values, intervals, strict=True):
                value = f"{z.real:.3f}" if abs(z.imag) < 1e-12 else f"{z:.3f}"
                bounds = f"modulus {abs(z):.3f}, 95 %: {low:.3f} to {high:.3f}"
                lines.append(f"  {name:15s} {value:>15s}   {bounds}")
        return "\n".join([*lines, *(f"  {line}" for line in self.warnings)])


@checked
@working("natural_multipliers")
def natural_multipliers(
    data: SectionData, order: MultiplierCount = 1, *, seed: Seed = 0
) -> NaturalMultipliers:
    r"""Floquet multipliers from variability alone: output-only identification.

    The return map of every section is estimated from how deviations go on into the next cycle, as
    in the Floquet analysis of gait (Hurmuzlu and Basdogan 1994). What disturbs the rhythm is not
    known, and taken as independent from cycle to cycle. The state at a section is made of all
    outputs there and at the section before, in the `order` combinations that vary most. All
    sections have the same multipliers: the coefficients of their characteristic polynomials are
    averaged.

    Few cycles bias it, too, since each record has its own mean: that is corrected to first order in
    their number (Pope 1990). Measurement noise biases a plain regression towards zero (Dingwell and
    Cusumano 2000 say why to be careful with so few cycles and so much noise). Here the states at
    earlier sections of the same cycle serve as instruments: noise that is not correlated over three
    sections or more has no effect on them.

    **Arguments:**

    - `data`: of `section_data(..., inputs=())`; the average cycle of each trial is subtracted.
    - `order`: the number of multipliers. Directions that are not among those that vary most act as
      disturbances: believe what does not change with the order.
    - `seed`: of the bootstrap, which draws blocks of successive cycles with replacement (Künsch
      1989), within each record; whole records where these are short.

    **Raises:** `DefinitionError` for too few cycles or signals.
    """
    moments = moments_of(data, order)
    K = len(moments.records)
    every = np.ones((1, K))
    counts = np.unique(moments.records, return_counts=True)[1]
    length, block = K / len(counts), max(_SHORTEST_BLOCK, round(K ** (1 / 3)))
    if np.median(counts) < _BLOCKS * block and len(counts) >= _BLOCKS:
        block = int(counts.max())
    rng = np.random.default_rng(seed)
    weights = np.stack([_resampled(moments, block, rng) for _ in range(_DRAWS)])
    return NaturalMultipliers(
        multipliers=_corrected(_multipliers(moments.by_instruments(every)), length)[0],
        plain=_multipliers(moments.plain(every))[0],
        draws=_corrected(_multipliers(moments.by_instruments(weights)), length),
        plain_draws=_multipliers(moments.plain(weights)),
        strength=moments.strength(),
        cycles=K,
        records=len(counts),
        block=block,
    )


def _multipliers(maps: Float[np.ndarray, "B N d d"]) -> Complex[np.ndarray, "B d"]:
    """By the mean characteristic polynomial over the sections, the largest first."""
    values = np.linalg.eigvals(maps)
    c = np.ones((*values.shape[:2], 1), complex)
    for k in range(values.shape[2]):
        later = np.pad(c, ((0, 0), (0, 0), (1, 0))) * values[..., k, None]
        c = np.pad(c, ((0, 0), (0, 0), (0, 1))) - later
    c = c.real.mean(axis=1)[:, 1:]
    companion = np.zeros((len(c), c.shape[1], c.shape[1]))
    companion[:, 0] = -c
    companion[:, np.arange(1, c.shape[1]), np.arange(c.shape[1] - 1)] = 1.0
    z = np.linalg.eigvals(companion).astype(complex)
    return np.take_along_axis(z, np.argsort(-np.abs(z), axis=1, kind="stable"), axis=1)


def _corrected(z: Complex[np.ndarray, "B d"], length: float) -> Complex[np.ndarray, "B d"]:
    """Without the bias of first order that the unknown mean of each record, and regression on the
    past, make in records of so many cycles (Pope 1990, for disturbances along the eigenvectors; of
    one multiplier Kendall's (1 + 3 z) / length)."""
    a, b = z[:, :, None], z[:, None, :]
    others = b * (1 - a**2) / (1 - np.clip(np.abs(a * b), 0, 0.99) * np.exp(1j * np.angle(a * b)))
    z = z + (1 + 2 * z + others.sum(axis=2)) / length
    return np.take_along_axis(z, np.argsort(-np.abs(z), axis=1, kind="stable"), axis=1)


def _resampled(moments: Moments, block: int, rng: np.random.Generator) -> Float[np.ndarray, " K"]:
    """How often each cycle was drawn: blocks of each record, or whole records."""
    weights = np.zeros(len(moments.records))
    names, counts = np.unique(moments.records, return_counts=True)
    if block == counts.max():
        for record in rng.choice(names, len(names)):
            weights[moments.records == record] += 1.0
        return weights
    for record, count in zip(names, counts, strict=True):
        own = np.flatnonzero(moments.records == record)
        length = min(block, count)
        starts = rng.integers(0, count - length + 1, -(-count // length))
        drawn = (starts[:, None] + np.arange(length)).ravel()[:count]
        np.add.at(weights, own[drawn], 1.0)
    return weights


def _about(found: NaturalMultipliers) -> Iterator[str]:
    """What the data cannot tell."""
    low, high = found.interval()[0]
    yield (
        f"Width: the largest modulus lies between {low:.2f} and {high:.2f} (95 %), from "
        f"{found.cycles} cycles; four times as many would halve that."
    )
    each = found.cycles / found.records
    if each < _FEW:
        yield (
            f"Few cycles: {each:.3g} in each of {found.records} records, whose own mean was "
            f"subtracted. A bias of about {(1 + 3 * abs(found.multipliers[0])) / each:.2f} was "
            "corrected to first order only."
        )
    if found.strength < _WEAK:
        yield (
            f"Weak instruments: earlier sections explain {100 * found.strength:.0f} % of the "
            "states' variance only; the rest is noise, or too fast to be seen there."
        )
    if high >= 1:
        yield f"Stability: the interval of the largest modulus reaches {high:.2f}, beyond 1."
    shift = abs(found.multipliers[0]) - abs(found.plain[0])
    yield (
        f"Noise: least squares gives {abs(found.plain[0]):.3f} for the largest modulus, "
        f"{abs(shift):.3f} {'less' if shift > 0 else 'more'}."
    )
