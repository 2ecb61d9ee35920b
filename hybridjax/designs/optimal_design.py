"""What an optimal design is, and what it is worth."""

from typing import Literal

import equinox as eqx
import numpy as np
from jaxtyping import Float

from .._core.boundary.checked import checked_methods
from .._core.boundary.kinds import PeriodCount, Positive, Seed
from .._core.html import card, table, text
from ..errors import DefinitionError
from ..experiments.design.design import Design
from .sequences import RandomInput, random_sequence


# Strides saved by a factor above this are worth another design. Doubled: more designs are said to
# be nearly optimal already.
_WORTH_IT = 1.5


@checked_methods
class OptimalDesign(eqx.Module):
    """A design that answers a question in the fewest strides, beside the one it was made from.

    Standard errors are Cramer-Rao bounds: a fit that uses all of the data reaches them where noise
    is white and responses are linear.

    **Fields:**

    - `design`: the experiments, for `run_experiments`, or `inputs()` for hardware.
    - `usual`: the design with which it is compared, scaled to the same limits.
    - `names` (g,) of the wanted quantities; `variances` (g,) with `design`, `usual_variances` with
      `usual`.
    - `criterion` and `usual_criterion`: what was made small, in units of a variance.
    - `certificate`: e, the largest sum of sensitivities of any design within the limits, relative
      to that of this one; with one limit the largest sensitivity of a line per unit of what is
      limited. No design needs fewer strides than 1/e of this one's. 1 at the optimum, but for
      peaks, which are taken as no larger than rms values. Where distortion is limited, it compares
      with designs whose convex bound of the distortion is no larger than the limit, or this one's.
    - `for_peaks`: how many times the strides limits of peaks cost, beside the same limits of the
      rms; 1 where no peak is limited.
    - `frequencies` (K,) and `channels` (K,) of all cosines that were allowed; `power` and
      `usual_power` (K,), the mean square of each over all experiments; `sensitivity` (K,), by
      which more power in a cosine makes the criterion smaller, divided by what it costs: 1 where
      power belongs, less elsewhere.
    - `limited`: names of the limits that are reached: of rms values by their signals, of rates,
      peaks and distortions.
    - `rms`, `usual_rms`: of all signals, by name, as the model predicts them; of `distortion of y`
      where it is limited, expected for random phases (of the phases that were chosen for a peak).
    """

    design: Design
    usual: Design
    names: tuple[str, ...] = eqx.field(static=True)
    variances: Float[np.ndarray, " g"]
    usual_variances: Float[np.ndarray, " g"]
    criterion: float
    usual_criterion: float
    certificate: float
    for_peaks: float
    frequencies: Float[np.ndarray, " K"]
    channels: np.ndarray
    power: Float[np.ndarray, " K"]
    usual_power: Float[np.ndarray, " K"]
    sensitivity: Float[np.ndarray, " K"]
    limited: tuple[str, ...] = eqx.field(static=True)
    rms: dict[str, float]
    usual_rms: dict[str, float]

    @property
    def standard_errors(self) -> Float[np.ndarray, " g"]:
        """Of the wanted quantities, with one run of `design`."""
        return np.sqrt(self.variances)

    @property
    def usual_standard_errors(self) -> Float[np.ndarray, " g"]:
        """The same with one run of `usual`."""
        return np.sqrt(self.usual_variances)

    @property
    def strides(self) -> int:
        """Cycles of all experiments, without those that are discarded."""
        return self.design.cycles(0)

    @property
    def saved(self) -> float:
        """How many strides of `usual` one stride of `design` replaces."""
        ratio = self.usual.cycles(0) / self.strides
        return self.usual_criterion / self.criterion * ratio

    def strides_for(self, standard_error: Positive) -> int:
        """Strides after which no wanted quantity has a larger standard error, with repeats of
        `design`."""
        return int(np.ceil(self.strides * (self.standard_errors.max() / standard_error) ** 2))

    def sequence(
        self,
        cycles: PeriodCount,
        kind: Literal["gaussian", "binary"] = "gaussian",
        seed: Seed = 0,
    ) -> RandomInput:
        """A random input with the spectrum of `design`, for a recording (`fit_series`).

        **Arguments:** `cycles`, its length; `kind`: normal values, or two values of the same
        size, whose spectrum is close to that of the design at best: `RandomInput.power` says which.

        **Raises:** `DefinitionError` for an odd number of samples, and for fewer cycles than the
        periods of the design, which do not tell its lines apart.
        """
        N, P = self.design.n_sections, self.design.periods
        if cycles < P:
            raise DefinitionError(
                f"{cycles} cycles do not tell lines apart that differ by 1/{P}: take {P} or more."
            )
        if N * cycles % 2:
            raise DefinitionError(f"{cycles} cycles of {N} sections are an odd number of samples.")
        lines = np.rint(self.frequencies * P).astype(int)
        shape = N, P, cycles, len(self.design.input_names)
        return random_sequence(lines, self.channels, self.power, shape, kind, seed)

    @property
    def advice(self) -> str:
        """Which case this is, in a sentence."""
        rest = [n for n in self.limited if n.startswith(("rate of ", "peak of ", "distortion of "))]
        rms = " and ".join(n for n in self.limited if n not in rest)
        what = " and ".join([f"rms of {rms}"] * bool(rms) + rest)
        if self.saved > _WORTH_IT:
            return (
                f"With the {what} limited it matters where the power is: one stride does "
                f"the work of {self.saved:.3g}."
            )
        return (
            f"With the {what} limited the usual design is nearly optimal (one stride does "
            f"the work of {self.saved:.3g}): what is left to gain lies in the estimator."
        )

    def __repr__(self) -> str:
        width = max(map(len, self.names))
        errors = zip(self.names, self.usual_standard_errors, self.standard_errors, strict=True)
        rows = [f"OptimalDesign({', '.join(self.names)})"]
        rows.append(f"  {'standard error':>{width + 2}}  usual     optimal")
        rows += [f"    {name:<{width}}  {a:.2e}  {b:.2e}" for name, a, b in errors]
        rows.append(f"  {self.advice}")
        bounded = any(n.startswith("distortion of ") for n in self.rms)
        rows.append(
            f"  certificate {self.certificate:.3f} (1 at the optimum): no design within the limits "
            f"{'(the convex bound of distortions) ' * bounded}"
            f"needs less than {1 / self.certificate:.1%} of these strides"
        )
        if self.for_peaks > 1:
            rows.append(f"  peaks cost {self.for_peaks:.3g} times the strides of such rms values")
        rows += [
            f"  rms of {name}: {self.rms[name]:.3g} ({self.rms[name] / old:.3g} times the usual)"
            for name, old in self.usual_rms.items()
            if old > 0
        ]
        return "\n".join([*rows, f"  {self.design!r}".replace("\n", "\n  ")])

    def _repr_html_(self) -> str:
        errors = zip(self.names, self.usual_standard_errors, self.standard_errors, strict=True)
        shown = [(name, f"{a:.2e}", f"{b:.2e}") for name, a, b in errors]
        head = ("standard error", "usual", "optimal")
        about = f"{self.advice}\ncertificate {self.certificate:.3f} (1 at the optimum)"
        return card("OptimalDesign", "", table(head, shown), text(about))
