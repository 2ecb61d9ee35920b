"""What a test of several F ratios can see."""

from collections import Counter
from collections.abc import Sequence

import numpy as np
from scipy import optimize, stats


# How often what is called visible is noticed. Doubled: not possible.
_POWER = 0.8
# Draws over which normal deviates are averaged. Doubled: the third digit changes.
_DRAWS = 1000
# Largest misfit looked for, in standard deviations of the noise. Doubled: numbers where next to
# nothing is visible.
_LARGEST = 1e3


def smallest_visible(ratios: Sequence[tuple[int, int]], level: float) -> float:
    """The rms of a misfit, in standard deviations of the noise, that is noticed in 80 % of cases.

    Each F ratio with (a, b) degrees of freedom is one test of a of a + b samples, turned to a
    normal deviate; the sum of all is compared with its quantile. A misfit of rms r times the noise
    makes each ratio noncentral, by (a + b) r^2 (the noncentral F distribution).

    **Arguments:** `ratios`: the degrees of freedom of each. `level`: of the test.
    """
    if not ratios:
        return np.nan
    kinds = Counter(ratios)
    rng = np.random.default_rng(0)
    normal = rng.normal(size=_DRAWS)
    rest = {(a, b): (rng.chisquare(a - 1, _DRAWS) if a > 1 else 0.0, rng.chisquare(b, _DRAWS))
            for a, b in kinds}  # fmt: skip

    def shortfall(log_misfit: float) -> float:
        mean = variance = 0.0
        for (a, b), count in kinds.items():
            above, below = rest[a, b]
            above = above + (normal + np.sqrt(a + b) * np.exp(log_misfit)) ** 2
            p = stats.f.sf((above / a) / (below / b), a, b)
            deviate = stats.norm.isf(np.clip(p, 1e-300, 1 - 1e-16))
            mean, variance = mean + count * deviate.mean(), variance + count * deviate.var()
        needed = stats.norm.isf(level) * np.sqrt(len(ratios))
        return (mean - needed) / np.sqrt(variance) - stats.norm.ppf(_POWER)

    low, high = np.log(1 / _LARGEST), np.log(_LARGEST)
    if not shortfall(high) > 0:
        return np.inf
    return float(np.exp(optimize.brentq(shortfall, low, high, xtol=1e-3)))
