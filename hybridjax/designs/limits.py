r"""Limits of experiments: powers p of the cosines with $W p \le 1$ and $p^T Q p \le 1$.

*Nonlinear distortion* (its even part of second order) is a quadratic form $p^T G p$ of the powers p
of many lines. G is not positive semidefinite, so that this limit is not convex. Designs are sought
within a convex bound, $p^T Q p$ with $Q \succeq 0$ and $Q \succeq G$ as small as possible, and then
scaled to the true distortion of their experiments.

`Limits` is what users give. `optimize.py` calls `power_limits` for the matrix W, `products` for G
and Q, and `below_peaks` for the phases.

If a design exceeds a limit, look at `power_limits` (rms values), `below_peaks` (peaks), or at
`Products.rms` (distortion); if it stays far below the limit of distortion, at the bound
(`_convex`).
"""

import dataclasses
from collections.abc import Mapping
from typing import Annotated, Literal, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

from .._core.arguments import require_among, require_same
from .._core.boundary.checked import checked
from .._core.boundary.kinds import Count
from .._core.boundary.values import Number
from ..errors import DefinitionError
from ..experiments.design.design import Design
from ..orbits.cycle import LimitCycle
from ..sections.families import FamilyLike, as_family
from ..sections.second_order import Quadratic, second_order
from .candidates import Candidates, Kept, Model, Powers, Squares


# Lower bound of a cosine's price, relative to the sum of its positive terms. Larger: prices with
# negative terms are wrong. Smaller: powers without a positive price grow without bound.
_LEAST = 1e-3
# A model belongs to a system if their H_0 differ by less than this part. Larger: models at other
# sections pass (two families of the hopper differ by 0.5 and more). Smaller: estimated models are
# rejected.
_DIFFERENT = 0.3

Words = Literal["input", "output"]
# (Squares of larger or smaller levels would be infinite or zero.)
Level = Annotated[
    float, Number("a number from 1e-100 to 1e100", low=1e-100, high=1e100)
]


@checked
class Distortion(eqx.Module):
    """A limit of the nonlinear distortion of outputs: the rms of the part of second order.

    This is the deviation of `(y(u) + y(-u)) / 2` from the cycle, including the mean, up to fourth
    order in the input. It is computed from exact second derivatives, through all events; they
    compile at the first call, for some ten seconds. The inputs of the system must act at all
    sections. If a design has several candidate models, the same distortion is used for all.

    **Arguments:**

    - `cycle`: limit cycle of the known or supposed system; `sections`: the family of sections. A
      design raises an error if its model's H_0 differs from this system's by more than 30 %.
    - `rms`: largest distortion of outputs by name, in their units, over all experiments.

    **Raises:** `DefinitionError` if `rms` is empty.

    **Example:**

    ```python
    small = hj.designs.Distortion(cycle, sections, {"yM": 1e-5})
    limits = hj.designs.Limits(rms={"u": 0.01}, distortion=small)
    ```

    **Before:** `hj.find_limit_cycle`. **After:** `hj.designs.Limits`.
    """

    cycle: LimitCycle
    sections: FamilyLike
    rms: Mapping[str, Level]

    def __check_init__(self):
        as_family(self.sections)
        if not self.rms:
            raise DefinitionError(
                "`rms` is empty: name an output, such as {'y': 1e-3}."
            )
        self.cycle.structure.resolve_outputs(tuple(map(str, self.rms)))


@checked
class Limits(eqx.Module):
    """Limits of experiments, by the names of signals.

    **Arguments:**

    - `rms`: largest rms values of inputs, or of outputs (their deviation from the cycle), over all
      experiments. `"input"` or `"output"` means that none of these may be larger than in the
      `design` that is improved.
    - `rate`: largest rms of the change of an input from one section to the next (not its largest
      value).
    - `peak`: largest modulus of an input, in every experiment. Phases are then optimized for a low
      peak, and experiments that still exceed it are scaled down. (Such phases are not random: the
      scatter of realizations does not show nonlinear distortion.)
    - `cycles`: those of all experiments together, without those that are discarded. Default: as
      many as in `design`.
    - `distortion`: limit of the nonlinear distortion of outputs.

    **Example:**

    ```python
    limits = hj.designs.Limits(rms={"u": 0.01}, peak={"u": 0.02})
    print(hj.optimal_design(model, design, limit=limits).limited)
    ```

    **After:** `hj.optimal_design`.
    """

    rms: Mapping[str, Level] | Words = eqx.field(default_factory=dict)
    rate: Mapping[str, Level] = eqx.field(default_factory=dict)
    peak: Mapping[str, Level] = eqx.field(default_factory=dict)
    cycles: Count | None = eqx.field(static=True, default=None)
    distortion: Distortion | None = None

    def require_inputs(self, inputs: tuple[str, ...]) -> None:
        """**Raises:** `DefinitionError` for rates and peaks of signals that are no inputs."""
        for word, given in (("rate", self.rate), ("peak", self.peak)):
            require_among("input", given, inputs, f"`{word}` of `limit`: ")

    def experiments(self, design: Design, cosines: int) -> int:
        """Return the number of experiments that the cycles allow.

        **Raises:** `DefinitionError` if they do not suffice for one, or there are fewer cosines.
        """
        periods = design.periods
        count = design.experiments if self.cycles is None else self.cycles // periods
        if count == 0:
            raise DefinitionError(
                f"`limit` allows {self.cycles} cycles, fewer than one experiment has, {periods}: "
                "allow more."
            )
        if count > cosines:
            raise DefinitionError(
                f"the `design` has {cosines} cosines: take a `design` with more lines, or fewer "
                f"experiments than {count}."
            )
        return count


Limit = Words | Mapping[str, Level] | Limits


def as_limits(limit: Limit) -> Limits:
    return limit if isinstance(limit, Limits) else Limits(limit)


class PowerLimits(NamedTuple):
    """L limits of sums over cosines, and O of quadratic forms."""

    names: tuple[str, ...]
    """Names of the limited quantities: rms values of signals, rates, peaks, distortions."""
    cost: Float[np.ndarray, "L K"]
    """W: share of each limit that a unit of a cosine's power takes."""
    curved: Float[np.ndarray, "O K K"]
    """Q, positive semidefinite: the root of $p^T Q p$ is the share that is used."""

    def use(self, power: Powers) -> Float[np.ndarray, " shares"]:
        """Return the share of each limit that is used, those of quadratic forms last."""
        return np.append(self.cost @ power, self.use_of_curved(power))

    def use_of_curved(self, power: Powers) -> Float[np.ndarray, " O"]:
        return np.sqrt(np.maximum(self.curved @ power @ power, 0))

    def tangent(
        self, power: Powers, level: Float[np.ndarray, " O"] | float = 1.0
    ) -> "PowerLimits":
        r"""Return linear limits, $p^T Q q \le \sqrt{p^T Q p}$, that all q within the quadratic ones
        obey (Cauchy-Schwarz inequality): at p itself, both have the same value.

        **Arguments:** `level`: factor by which the quadratic forms may exceed 1. Default: 1.
        """
        use = self.use_of_curved(power)
        norm = np.where(use > 0, use * level, 1.0)
        slope = self.curved @ power / norm[:, None]
        cost = np.concatenate([self.cost, slope])
        return PowerLimits(self.names, cost, self.curved[:0])

    def scaled(self, power: Powers) -> Powers:
        """Return the same proportions, as large as the limits allow."""
        return power / self.use(power).max()

    def price(self, prices: Float[np.ndarray, " L"]) -> Powers:
        """Return the price of a unit of each cosine's power. It is positive even if the tangent of
        a quadratic limit has negative coefficients."""
        total = prices @ self.cost
        least = _LEAST * (prices @ np.abs(self.cost))
        return np.maximum(total, least)

    def share(self, power: Powers) -> Powers:
        """Return the average share of the limits that a unit of each cosine's power takes."""
        flat = self.tangent(power)
        number = len(flat.cost)
        return flat.price(np.full(number, 1 / number))

    def only(self, kept: Kept) -> "PowerLimits":
        return self._replace(
            cost=self.cost[:, kept], curved=self.curved[:, kept][:, :, kept]
        )

    def require_limits(self) -> None:
        """**Raises:** `DefinitionError` if some cosine is not limited."""
        alone = np.diagonal(self.curved, axis1=1, axis2=2)
        free = np.concatenate([self.cost, alone]).max(axis=0) == 0
        if free.any():
            raise DefinitionError(
                f"cosine {int(np.argmax(free))} of the design moves no signal of `limit`: limit "
                "the input, too."
            )


def power_limits(
    limits: Limits,
    models: list[Model],
    squares: list[Squares],
    usual: Powers,
) -> PowerLimits:
    """Return the linear limits, which hold for each model. A peak is no smaller than an rms value.

    **Arguments:** `squares` of each model. `usual`: powers of the design that is improved.

    **Raises:** `DefinitionError` for names that do not exist, and limits that nothing satisfies.
    """
    rows = list[Powers]()
    names = list[str]()
    for model, square in zip(models, squares, strict=True):
        for name, level in _levels(limits, model, square, usual).items():
            if level == 0:
                raise DefinitionError(
                    f"the `design` does not move {name}: leave it out of `limit`."
                )
            names.append(name)
            rows.append(square[name.removeprefix("peak of ")] / level**2)
    K = len(usual)
    cost = np.reshape(rows, (-1, K))
    _, first = np.unique(cost, axis=0, return_index=True)
    distinct = np.sort(first)
    return PowerLimits(
        tuple(names[i] for i in distinct), cost[distinct], np.zeros((0, K, K))
    )


def _levels(
    limits: Limits,
    model: Model,
    square: Squares,
    usual: Powers,
) -> dict[str, float]:
    """The largest rms values of signals, of rates and of peaks, by their names."""
    signals = (*model.inputs, *model.outputs)
    if isinstance(limits.rms, str):
        names = model.inputs if limits.rms == "input" else model.outputs
        levels = {name: float(np.sqrt(square[name] @ usual)) for name in names}
    else:
        require_among("signal", limits.rms, signals, "`limit`: ")
        levels = {str(name): float(x) for name, x in limits.rms.items()}
        if not (levels or limits.rate or limits.peak or limits.distortion):
            raise DefinitionError(
                "`limit` is empty: name a signal, such as rms={'u': 0.1}."
            )
    limits.require_inputs(model.inputs)
    levels |= {f"rate of {name}": float(x) for name, x in limits.rate.items()}
    levels |= {f"peak of {name}": float(x) for name, x in limits.peak.items()}
    return levels


def below_peaks(design: Design, peak: Mapping[str, float], seed: int) -> Design:
    """Return the design with phases for low peaks, and with experiments that still exceed a peak
    scaled down."""
    phase = np.array(design.phase)
    for e in range(design.experiments):
        lines = np.flatnonzero(design.experiment == e)
        # (Each experiment alone, so that a line may have different phases in different
        # experiments.)
        single = dataclasses.replace(
            design,
            experiment=0 * lines,
            experiments=1,
            line=design.line[lines],
            channel=design.channel[lines],
            amplitude=design.amplitude[lines],
            phase=design.phase[lines],
        )
        phase[lines] = single.optimize_phases(seed).phase
    design = dataclasses.replace(design, phase=phase)
    highest = np.abs(design.signals()).max(axis=1)
    factor = np.ones_like(highest)
    for name, most in peak.items():
        i = design.inputs.index(name)
        larger = np.maximum(highest[:, i], most)
        factor[:, i] = most / larger
    amplitude = np.asarray(design.amplitude) * factor[design.experiment, design.channel]
    return dataclasses.replace(design, amplitude=amplitude)


class Products(NamedTuple):
    """The distortion of O outputs, as a form of the powers of K cosines."""

    outputs: tuple[str, ...]
    level: Float[np.ndarray, " O"]
    """Largest rms values."""
    quadratic: Quadratic
    cosines: Candidates
    expected: Float[np.ndarray, "O K K"]
    """Mean square of one experiment with random phases: $p^T M p$."""
    bound: Float[np.ndarray, "O K K"]
    """Q in units of the limit."""

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(f"distortion of {name}" for name in self.outputs)

    def require_those_of(self, model: Model) -> None:
        """**Raises:** `DefinitionError` if the model's transfer functions are different."""
        waves = self.quadratic.waves(self.cosines.f, self.cosines.channel)
        H_here = np.mean(self.quadratic.show @ waves, axis=0)
        H_model = self.cosines.responses(model, 0)[:, 0]
        for name, H in zip(self.outputs, H_here, strict=True):
            if name not in model.outputs:
                continue
            expected = H_model[:, model.outputs.index(name)]
            difference = np.linalg.norm(H - expected)
            size = np.linalg.norm(expected)
            if difference > _DIFFERENT * size:
                share = difference / max(size, np.finfo(float).tiny)
                raise DefinitionError(
                    f"the model and the distortion of `limit` differ in H_0 (to {name}, by "
                    f"{share:.0%}): use the same sections."
                )

    def rms(self, design: Design, phases: bool = False) -> Float[np.ndarray, " O"]:
        """Return the distortion in a design: expected with random phases, or with its `phases`."""
        if phases:
            second = self.quadratic.second_order(design.signals())
            return np.sqrt(np.mean(second**2, axis=(0, 1)))
        power = self.cosines.powers_in(design)
        squares = np.einsum("ek,okl,el->o", power, self.expected, power, optimize=True)
        return np.sqrt(np.maximum(squares, 0) / design.experiments)

    def divided(
        self, kept: Kept, share: Float[np.ndarray, "E k"]
    ) -> Float[np.ndarray, "O k k"]:
        """Return the expected mean square of the distortion, in units of the limit, as a quadratic
        form of the mean powers of the cosines. `share`: power of each cosine in each experiment,
        relative to its mean power."""
        expected = self.expected[:, kept][:, :, kept]
        expected = expected / (self.level**2)[:, None, None]
        return expected * (share.T @ share) / len(share)


def products(
    limit: Distortion,
    cosines: Candidates,
    inputs: tuple[str, ...],
    usual: Powers,
) -> Products:
    """Return the distortion as a form of powers.

    **Arguments:** `usual`: powers near which the convex bound is to be tight.

    **Raises:** `DefinitionError` for outputs or inputs that do not exist, and another number of
    sections; `ComputationError` as `place_sections`.
    """
    sections = as_family(limit.sections)
    require_same(
        "the distortion of `limit` and the model", sections, cosines, ("n_sections",)
    )
    outputs = tuple(str(n) for n in limit.rms)
    quadratic = second_order(limit.cycle, sections, outputs, inputs)
    pairs = quadratic.products(cosines.f, cosines.channel)
    level = np.array([float(x) for x in limit.rms.values()])
    bound = np.array([_convex(form, usual) for form in pairs.gaussian()])
    scaled = bound / (level**2)[:, None, None]
    return Products(outputs, level, quadratic, cosines, pairs.cosines(), scaled)


def _convex(form: Float[np.ndarray, "K K"], unit: Powers) -> Float[np.ndarray, "K K"]:
    """Return the nearest positive semidefinite matrix whose difference from the form is positive
    semidefinite, too. Distances are in units of each cosine's power, `unit`. (In units in which all
    cosines distort equally, the hopper's bound would be up to twice as large.)"""
    scaled = form * unit[:, None] * unit
    values, vectors = np.linalg.eigh(scaled)
    positive = (vectors * np.maximum(values, 0)) @ vectors.T
    return positive / unit[:, None] / unit
