r"""What an experiment may cost: powers p of the cosines with $W p \le 1$ and $p^T Q p \le 1$."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Literal, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from ..._core.boundary.checked import checked
from ..._core.boundary.kinds import Count, Positive
from ...errors import DefinitionError
from ...experiments.design.design import Design
from ...experiments.design.partition import line_class
from ..candidates import Candidates
from ..signals import Squares, rate_of
from .distortion import Distortion


# Price of a cosine, relative to what it would be if nothing in it were negative, that is none. Ten
# times more: as little happens.
_LEAST = 1e-3


@checked
class Limits(eqx.Module):
    """What limits experiments, by the names of signals.

    **Arguments:**

    - `rms`: of inputs, of outputs (their deviation from the cycle), or of states by the names that
      `LDTP.coordinates` has, over all experiments.
    - `rate`: rms of the change of an input from one section to the next.
    - `peak`: of an input, in every experiment. Phases are then chosen for a low peak, and what
      still exceeds it is made smaller. (Such phases are not random: realizations of them do not
      show the distortion.)
    - `strides`: cycles of all experiments together, without those that are discarded.
    - `distortion`: what is not linear in outputs.
    """

    rms: Mapping[str, Positive] = eqx.field(default_factory=dict)
    rate: Mapping[str, Positive] = eqx.field(default_factory=dict)
    peak: Mapping[str, Positive] = eqx.field(default_factory=dict)
    strides: Count | None = eqx.field(static=True, default=None)
    distortion: Distortion | None = None


Limit = Literal["input", "output"] | Mapping[str, Positive] | Limits


def require_inputs(limit: Limits, inputs: tuple[str, ...]) -> None:
    """**Raises:** `DefinitionError` for rates and peaks of what is no input."""
    for word, given in (("rate", limit.rate), ("peak", limit.peak)):
        unknown = [n for n in given if n not in inputs]
        if unknown:
            raise DefinitionError(
                f"`limit` limits the {word} of '{unknown[0]}'; the inputs are {', '.join(inputs)}."
            )


def peak_of(name: str) -> str:
    return f"peak of {name}"


class PowerLimits(NamedTuple):
    """L limits of sums over cosines, and O of quadratic forms."""

    names: tuple[str, ...]
    """What is limited, one by one: rms values of signals by their names, rates, peaks, distortions;
    not amplitudes and powers."""
    cost: Float[np.ndarray, "L K"]
    """W: share of each limit that a unit of a cosine's power takes."""
    curved: Float[np.ndarray, "O K K"]
    """Q, positive semidefinite: of each the root of $p^T Q p$ is the share that is used."""

    def use(self, power: Float[np.ndarray, " K"]) -> Float[np.ndarray, " shares"]:
        """Share of each limit that is used, those of quadratic forms last."""
        return np.append(self.cost @ power, self.bent(power))

    def at(
        self, power: Float[np.ndarray, " K"], level: Float[np.ndarray, " O"] | float = 1.0
    ) -> "PowerLimits":
        r"""Linear limits, $p^T Q q \le \sqrt{p^T Q p}$, which all q within these keep (Cauchy and
        Schwarz): those at other powers p are used alike by p itself.

        **Arguments:** `level`, how much more than allowed the quadratic forms may be.
        """
        slope, use = self.curved @ power, self.bent(power)
        slope = slope / np.where(use > 0, use * level, 1.0)[:, None]
        return PowerLimits(self.names, np.concatenate([self.cost, slope]), self.curved[:0])

    def bent(self, power: Float[np.ndarray, " K"]) -> Float[np.ndarray, " O"]:
        """Share of the quadratic forms that is used."""
        return np.sqrt(np.maximum(self.curved @ power @ power, 0))

    def within(self, power: Float[np.ndarray, " K"]) -> Float[np.ndarray, " K"]:
        """The same proportions, as large as the limits allow."""
        return power / self.use(power).max()

    def price(self, prices: Float[np.ndarray, " L"]) -> Float[np.ndarray, " K"]:
        """What a unit of each cosine's power costs; never nothing, though linear limits of a
        quadratic form may say so of a few."""
        least = _LEAST * (prices @ np.abs(self.cost))
        return np.maximum(prices @ self.cost, least)

    def share(self, power: Float[np.ndarray, " K"]) -> Float[np.ndarray, " K"]:
        """What a unit of each cosine's power takes of the limits, on the average."""
        flat = self.at(power)
        return flat.price(np.full(len(flat.cost), 1 / len(flat.cost)))

    def only(self, some: Int[np.ndarray, " k"]) -> "PowerLimits":
        """Where only these cosines are applied."""
        return self._replace(cost=self.cost[:, some], curved=self.curved[:, some][:, :, some])

    def and_of_distortion(
        self, names: tuple[str, ...], curved: Float[np.ndarray, "O K K"]
    ) -> "PowerLimits":
        """These, and limits of quadratic forms."""
        return PowerLimits((*self.names, *names), self.cost, curved)

    def and_of_amplitudes(
        self, largest: Float[np.ndarray, " K"], cosines: Candidates
    ) -> "PowerLimits":
        r"""These, and limits of the cosines' amplitudes in every experiment.

        A cosine of power p (on the average over all experiments) that has its largest amplitude a
        takes a share $2p / a^2$ of them, and each experiment has place for one of each class.
        """
        classes = line_class(cosines.line, cosines.periods)
        limited = np.unique(classes[np.isfinite(largest)])
        share = (classes == limited[:, None]) * 2 / largest**2
        return self._replace(cost=np.concatenate([self.cost, share]))

    def and_of_powers(self, largest: Float[np.ndarray, " K"]) -> "PowerLimits":
        """These, and the largest power of each cosine."""
        return self._replace(cost=np.concatenate([self.cost, np.diag(1 / largest)]))

    def require_limits(self) -> None:
        """**Raises:** `DefinitionError` if some cosine is not limited."""
        alone = np.diagonal(self.curved, axis1=1, axis2=2)
        free = np.concatenate([self.cost, alone]).max(axis=0) == 0
        if free.any():
            raise DefinitionError(
                f"no limit reaches cosine {int(np.argmax(free))} of the design (of a distortion, "
                "where nothing is distorted): limit the input, too."
            )


def power_limits(
    limit: Limit,
    squares: list[Squares],
    ports: dict[Literal["input", "output"], tuple[str, ...]],
    usual: Float[np.ndarray, " K"],
) -> PowerLimits:
    """They hold for each of the models. A peak is no smaller than an rms value.

    **Arguments:**

    - `squares`: of each model. `ports`: names of inputs and of outputs.
    - `usual`: powers with which nothing is to be larger, where `limit` is a word.

    **Raises:** `DefinitionError` for names that do not exist, and limits that nothing satisfies.
    """
    if isinstance(limit, str):
        levels = [{n: float(np.sqrt(one[n] @ usual)) for n in ports[limit]} for one in squares]
    else:
        given = limit if isinstance(limit, Limits) else Limits(limit)
        level = _levels(given, ports["input"], squares[0])
        levels = [level for _ in squares]
    silent = [n for level in levels for n, rms in level.items() if rms == 0]
    if silent:
        raise DefinitionError(f"the `design` does not move {silent[0]}, so it cannot be limited.")
    names = [n for level in levels for n in level]
    rows = [
        one[n.removeprefix(peak_of(""))] / rms**2
        for one, level in zip(squares, levels, strict=True)
        for n, rms in level.items()
    ]
    K = len(usual)
    cost = np.reshape(rows, (-1, K))
    some = np.sort(np.unique(cost, axis=0, return_index=True)[1])
    return PowerLimits(tuple(names[i] for i in some), cost[some], np.zeros((0, K, K)))


def _levels(limit: Limits, inputs: tuple[str, ...], squares: Squares) -> dict[str, float]:
    """The rms values that are allowed, by the names of `squares`."""
    rates = {rate_of(n) for n in inputs}
    unknown = [n for n in limit.rms if n not in squares or n in rates]
    if unknown or not (limit.rms or limit.rate or limit.peak or limit.distortion):
        what = f"limits '{unknown[0]}'" if unknown else "limits nothing"
        known = ", ".join(n for n in squares if n not in rates)
        raise DefinitionError(f"`limit` {what}; what can be limited is the rms value of {known}.")
    require_inputs(limit, inputs)
    level = {str(n): float(x) for n, x in limit.rms.items()}
    level |= {rate_of(n): float(x) for n, x in limit.rate.items()}
    return level | {peak_of(n): float(x) for n, x in limit.peak.items()}


Largest = float | Callable[[np.ndarray], np.ndarray] | None
"""Amplitude that a cosine may have in an experiment, as a function of its frequency."""


def largest_amplitudes(largest: Largest, f: Float[np.ndarray, " K"]) -> Float[np.ndarray, " K"]:
    """Infinite where there is no limit.

    **Raises:** `DefinitionError` for anything but numbers that are not negative.
    """
    if largest is None:
        return np.full(len(f), np.inf)
    given = np.asarray(largest(f) if callable(largest) else largest)
    if given.dtype.kind not in "fiu" or given.shape not in ((), f.shape):
        raise DefinitionError("`largest` must give a real number for each frequency.")
    amplitude = np.broadcast_to(given, f.shape)
    if not (amplitude >= 0).all():
        raise DefinitionError("`largest` must give amplitudes that are not negative.")
    return amplitude


def without_forbidden(design: Design, largest: Largest) -> Design:
    """The lines of a design that may be applied, none of them larger than it may be; experiments
    without any are left out.

    **Raises:** `DefinitionError` as `largest_amplitudes`, and if none is left.
    """
    most = largest_amplitudes(largest, design.line / design.periods)
    kept = most > 0
    if not kept.any():
        raise DefinitionError("`largest` is zero at all frequencies: no cosine may be applied.")
    used, experiment = np.unique(design.experiment[kept], return_inverse=True)
    parts = {n: getattr(design, n)[kept] for n in ("line", "channel", "phase")}
    parts["amplitude"] = np.minimum(design.amplitude, most)[kept]
    return dataclasses.replace(design, experiment=experiment, experiments=len(used), **parts)


def experiments_within(
    limit: Limit, experiments: int | None, usual: int, periods: int, cosines: int
) -> int:
    """How many experiments there are to be: `experiments`, or as many as `strides` allow.

    **Raises:** `DefinitionError` if the strides do not suffice, or there are fewer cosines.
    """
    strides = limit.strides if isinstance(limit, Limits) else None
    if strides is None:
        count = usual if experiments is None else experiments
    else:
        count = strides // periods if experiments is None else experiments
        if count * periods > strides or count == 0:
            raise DefinitionError(
                f"`limit` allows {strides} strides, but {max(count, 1)} experiments of {periods} "
                f"periods are {max(count, 1) * periods}: allow more, or take fewer or shorter ones."
            )
    if count > cosines:
        raise DefinitionError(
            f"{count} experiments are more than the {cosines} cosines that there are."
        )
    return count
