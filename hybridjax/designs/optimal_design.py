"""The result of `optimal_design`."""

import equinox as eqx
import numpy as np
from jaxtyping import Float

from .._core.boundary.checked import checked_methods
from .._core.boundary.kinds import Positive
from ..experiments.design.design import Design
from .candidates import Powers


# Ratio of strides from which on `advice` recommends the design. Larger: designs that save a third
# are called nearly optimal. Smaller: savings within the uncertainty of the model are advertised.
_WORTH_IT = 1.5


@checked_methods
class OptimalDesign(eqx.Module):
    """A design that needs the fewest strides, and the design that it improves.

    Standard errors are Cramer-Rao bounds: a fit that uses all of the data reaches them where noise
    is white and responses are linear.

    **Fields:**

    - `design`: the experiments, for `run_experiments`, or `inputs()` for hardware.
    - `usual`: the design that it improves, scaled to the same limits.
    - `names` (g,) of the quantities of interest; `variances` (g,) with `design`, `usual_variances`
      with `usual`.
    - `criterion` and `usual_criterion`: the minimized function, in units of a variance.
    - `certificate`: e, the largest sum of sensitivities of any design within the limits, relative
      to that of this one; with one limit the largest sensitivity of a line per unit of the limit.
      No design needs fewer strides than 1/e of this one's. It is 1 at the optimum, except with
      peaks, which are treated as no larger than rms values. With limited distortion it compares
      with designs whose convex bound of the distortion is no larger than the limit, or this one's.
    - `frequencies` (K,) and `channels` (K,) of all cosines; `power` and `usual_power` (K,),
      the mean square of each over all experiments; `sensitivity` (K,), the decrease of the
      criterion by more power in a cosine, divided by its price: 1 where the optimum has power, less
      elsewhere.
    - `limited`: names of the limits that are reached: of rms values by their signals, of rates,
      peaks and distortions.
    - `rms`, `usual_rms`: predicted rms values of all signals, by name; of `distortion of y` where
      it is limited, expected for random phases (with a limited peak, for the optimized phases).
    """

    design: Design
    usual: Design
    names: tuple[str, ...] = eqx.field(static=True)
    variances: Float[np.ndarray, " g"]
    usual_variances: Float[np.ndarray, " g"]
    criterion: float
    usual_criterion: float
    certificate: float
    frequencies: Powers
    channels: np.ndarray
    power: Powers
    usual_power: Powers
    sensitivity: Powers
    limited: tuple[str, ...] = eqx.field(static=True)
    rms: dict[str, float]
    usual_rms: dict[str, float]

    @property
    def standard_errors(self) -> Float[np.ndarray, " g"]:
        """Standard errors of the quantities of interest, with one run of `design`."""
        return np.sqrt(self.variances)

    @property
    def usual_standard_errors(self) -> Float[np.ndarray, " g"]:
        """Standard errors with one run of `usual`."""
        return np.sqrt(self.usual_variances)

    @property
    def strides(self) -> int:
        """Cycles of all experiments, without those that are discarded."""
        return self.design.cycles(0)

    @property
    def saved(self) -> float:
        """Number of strides of `usual` that one stride of `design` replaces."""
        ratio = self.usual.cycles(0) / self.strides
        return self.usual_criterion / self.criterion * ratio

    def strides_for(self, standard_error: Positive) -> int:
        """Return the strides, with repeats of `design`, after which no quantity has a larger
        standard error."""
        return int(np.ceil(self.strides * (self.standard_errors.max() / standard_error) ** 2))

    @property
    def advice(self) -> str:
        """The worth of this design, in a sentence."""
        prefixes = ("rate of ", "peak of ", "distortion of ")
        special = [n for n in self.limited if n.startswith(prefixes)]
        rms = " and ".join(n for n in self.limited if n not in special)
        limits = " and ".join([f"rms of {rms}"] * bool(rms) + special)
        if self.saved > _WORTH_IT:
            return (
                f"With the {limits} limited it matters where the power is: one stride does "
                f"the work of {self.saved:.3g}."
            )
        return (
            f"With the {limits} limited the usual design is nearly optimal (one stride does "
            f"the work of {self.saved:.3g}): only a better estimator would gain more."
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
        rows += [
            f"  rms of {name}: {self.rms[name]:.3g} ({self.rms[name] / old:.3g} times the usual)"
            for name, old in self.usual_rms.items()
            if old > 0
        ]
        return "\n".join([*rows, f"  {self.design!r}".replace("\n", "\n  ")])
