"""`ExperimentData`: inputs and outputs of experiments on a hybrid system, on a linear model or in a
laboratory.

`run_experiments`, `simulate_experiments` and plants return it, users can make it from arrays, and
all estimates take it. Its conventions are a contract with all of these: signals are sampled at the
sections, outputs are deviations from the cycle and sampled before the input acts, and estimates use
the last P periods. An experiment that failed has a `result` code and NaN; estimates leave it out.

The constructor only checks. If numbers are wrong, look at what made the data (`run.py` for
simulations); if an estimate uses the wrong samples, at `windows`; if pairs with opposite inputs are
refused, at `_OPPOSITE` and `odd_part`.
"""

import dataclasses
from typing import Annotated, Any

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, Int

from .._core.arguments import (
    Numbers,
    input_and_output_names,
    require_among,
    require_axes,
)
from .._core.boundary.checked import checked
from .._core.boundary.kinds import Count, Index, NewNames, PeriodCount, SectionCount
from .._core.boundary.values import Integers, Reals
from .._core.findings import Finding, print_findings
from .._core.results import Result
from .._core.showable import Showable
from .._core.text import fields, folded, how_many, listed
from ..errors import DefinitionError
from .record import SectionSeries


# Two inputs are opposite if their sum is below this part of their peak. Smaller: rounding of
# recorded inputs separates pairs. Larger: even-order distortion is left in the odd part.
_OPPOSITE = 1e-9


@checked
class Simulated(eqx.Module):
    """Results of S simulated experiments that measured experiments do not have.

    **Fields:**

    - `failed_at`: (S,) the sample at which an experiment failed, -1 where it did not.
    - `error`: (S,) estimates of the largest error of the states at any section, relative to their
      sizes (`LimitCycle.scale`), or None.
    - `label`: name of the section family.
    - `late`: (S, n) delays of a plant: the time from a section to the end of the step that found
      it, or None.
    - `causes`: for each experiment on a plant, the cause of its end; "" if it ran to its end.
    - `findings`: reasons to doubt what is estimated from experiments on a plant.
    """

    failed_at: Int[np.ndarray, " S"]
    error: Float[np.ndarray, " S"] | None = None
    label: str = eqx.field(static=True, default="")
    late: Float[np.ndarray, "S n"] | None = None
    causes: tuple[str, ...] = eqx.field(static=True, default=())
    findings: tuple[Finding, ...] = ()

    __repr__ = fields


@checked
class ExperimentData(Showable, eqx.Module):
    """Inputs and outputs of S experiments, sampled at the sections of a limit cycle.

    **Fields**, all on the host:

    - `u`: inputs, (S, n, nu); `u[:, i]` is held from sample i to i + 1. Sample 0 lies on
      section 0, n is a whole number of periods.
    - `y`: outputs at the sections minus those on the limit cycle, (S, n, ny), sampled before
      `u[:, i]` acts. NaN from the failure on where an experiment failed.
    - `result`: (S,) codes of `Result`.
    - `simulated`: results that only a simulation has, or None; also available as `failed_at`,
      `error`, `label` and `findings`.
    - `cycle_outputs`: (N, ny) the outputs on the limit cycle, or None if not known.
    - `n_sections`: N. `periods`: P; estimates use the last P periods (P * N samples).
    - `inputs`, `outputs`: names, or units by name.
    """

    u: Float[np.ndarray, "S n nu"]
    y: Float[np.ndarray, "S n ny"]
    result: Int[np.ndarray, " S"]
    simulated: Simulated | None
    cycle_outputs: Float[np.ndarray, "N ny"] | None
    n_sections: int = eqx.field(static=True)
    periods: int = eqx.field(static=True)
    inputs: tuple[str, ...] = eqx.field(static=True)
    outputs: tuple[str, ...] = eqx.field(static=True)

    def __init__(
        self,
        u: Annotated[
            Numbers, Reals("experiments samples inputs", missing=True, infinite=True)
        ],
        y: Annotated[
            Numbers, Reals("experiments samples outputs", missing=True, infinite=True)
        ],
        *,
        n_sections: SectionCount,
        periods: PeriodCount,
        inputs: NewNames | None = None,
        outputs: NewNames | None = None,
        result: Annotated[Numbers, Integers("experiments")] | None = None,
        simulated: Simulated | None = None,
        cycle_outputs: Annotated[Numbers, Reals("sections outputs")] | None = None,
    ):
        """**Arguments:** the fields. Default of `result`: all OK. Default names: `u` and `y`, or
        `u0`, `u1`, ... for several.

        **Raises:** `DefinitionError` for shapes that do not fit together, for a record that is not
        a whole number of periods or is shorter than the window, and for NaN in an experiment whose
        `result` is OK.
        """
        self.u = np.array(u)
        self.y = np.array(y)
        shapes = self.u.shape, self.y.shape
        if any(0 in s for s in shapes) or shapes[0][:2] != shapes[1][:2]:
            raise DefinitionError(
                f"`u` {shapes[0]} and `y` {shapes[1]} must have the same experiments and samples "
                "(their first two axes)."
            )
        self.result = (
            np.zeros(len(self.u), int) if result is None else np.asarray(result, int)
        )
        if not np.isin(self.result, list(Result)).all():
            raise DefinitionError(
                "`result` must hold codes of `Result`, such as 0 for OK."
            )
        self.simulated = simulated
        self.cycle_outputs = None if cycle_outputs is None else np.array(cycle_outputs)
        self.n_sections = n_sections
        self.periods = periods
        sizes = self.u.shape[2], self.y.shape[2]
        self.inputs, self.outputs = input_and_output_names(inputs, outputs, *sizes)
        S, n, ny = self.y.shape
        N = self.n_sections
        if n % N:
            raise DefinitionError(
                f"records must hold whole periods of N = {N} samples, not {n}."
            )
        self.windows()
        for name in ("result", "failed_at", "error"):
            require_axes(f"`{name}`", getattr(self, name), {"experiments": S})
        if self.cycle_outputs is not None:
            require_axes(
                "`cycle_outputs`", self.cycle_outputs, {"sections": N, "outputs": ny}
            )
        self._require_finite("u", self.u)
        self._require_finite("y", self.y)

    def _require_finite(self, name: str, values: np.ndarray) -> None:
        """**Raises:** `DefinitionError` for NaN in an experiment whose `result` is OK."""
        finite = np.isfinite(values)
        if finite.all():  # (along the last, short axis it takes ten times as long)
            return
        bad = ~finite.all(axis=2) & self.ok[:, None]
        if bad.any():
            s, i = np.argwhere(bad)[0].tolist()
            raise DefinitionError(
                f"experiment {s}: {name} is not finite at sample {i}: repair the record, or mark "
                "the experiment as failed in `result`."
            )

    def __len__(self) -> int:
        """The number of experiments."""
        return len(self.u)

    def __getitem__(self, name: str) -> Float[np.ndarray, "S n"]:
        """An input or output of all experiments: `data["yM"]`.

        **Raises:** `DefinitionError` for a signal that does not exist.
        """
        signals = (*self.inputs, *self.outputs)
        require_among("signal", [name], signals)
        k = signals.index(name)
        nu = len(self.inputs)
        return self.u[:, :, k] if k < nu else self.y[:, :, k - nu]

    @property
    def ok(self) -> Bool[np.ndarray, " S"]:
        """True for experiments that ran to their end."""
        return self.result == Result.OK

    def require_ok(self) -> None:
        """**Raises:** `DefinitionError` if no experiment ran to its end."""
        if not self.ok.any():
            causes = self.summary()
            raise DefinitionError(
                f"no experiment ran to its end ({causes}): lower the inputs."
            )

    @property
    def records(self) -> tuple[SectionSeries, ...]:
        """The experiments that ran to their end, each with all of its cycles."""
        about: Any = {
            "n_sections": self.n_sections,
            "inputs": self.inputs,
            "outputs": self.outputs,
        }
        return tuple(
            SectionSeries(self.u[s], self.y[s], **about)
            for s in np.flatnonzero(self.ok)
        )

    @property
    def failed_at(self) -> Int[np.ndarray, " S"]:
        """The sample at which an experiment failed; -1 if it did not fail, or if the sample is not
        known."""
        return (
            np.full(len(self.u), -1)
            if self.simulated is None
            else self.simulated.failed_at
        )

    @property
    def error(self) -> Float[np.ndarray, " S"]:
        """Estimates of the largest error of a simulation, relative to the sizes of the states
        (`LimitCycle.scale`); NaN if not known."""
        error = None if self.simulated is None else self.simulated.error
        return np.full(len(self.u), np.nan) if error is None else error

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Reasons to doubt what is estimated from a simulation."""
        return () if self.simulated is None else self.simulated.findings

    @property
    def label(self) -> str:
        """Name of the section family of a simulation, else ""."""
        return "" if self.simulated is None else self.simulated.label

    @property
    def window(self) -> slice:
        """The samples that estimates use: the last P periods."""
        return slice(self.u.shape[1] - self.n_sections * self.periods, None)

    def windows(self, repeats: Count = 1) -> list[slice]:
        """Return the last `repeats` windows of P periods each, one after the other.

        **Raises:** `DefinitionError` if the record is too short.
        """
        n = self.u.shape[1]
        length = self.n_sections * self.periods
        if repeats * length > n:
            raise DefinitionError(
                f"{n // self.n_sections} cycles are too few for {repeats} x P = {self.periods} "
                "periods: record more, or lower `periods` or repeats."
            )
        first = n - repeats * length
        return [
            slice(first + r * length, first + (r + 1) * length) for r in range(repeats)
        ]

    def summary(self, limit: Index = 5) -> str:
        """Return `80/80 ok`, or the number of OK experiments with the causes of the first `limit`
        failures."""
        causes = () if self.simulated is None else self.simulated.causes
        return summary(self.result, self.failed_at, self.n_sections, limit, causes)

    def plot(self, index: int = 0, *, ax: object = None) -> Any:
        """Draw inputs and deviations of the outputs of one experiment against time.

        One row per signal. Cycles before the window that estimates use are shaded. A failed
        experiment ends at a mark, and the title gives the reason.

        **Arguments:**

        - `index`: number of the experiment; negative numbers count from the last. Default: 0.
        - `ax`: one Axes per signal, inputs first. Default: a new figure.

        **Returns:** `hj.plot.Plot` with `axes` (nu + ny, 1). Time is in cycles, signals are in
        their units.

        **Raises:** `DefinitionError` for an experiment that does not exist, or if `ax` does not
        hold one Axes per signal.

        **Example:**

        ```python
        data.plot(-1).save("last.png")
        ```
        """
        return super().plot(index, ax=ax)

    def __repr__(self) -> str:
        S, n, _ = self.u.shape
        state = self.summary()
        if self.label:
            state = f"{self.label}, {state}"
        text = folded(
            f"ExperimentData({state}; {how_many(n // self.n_sections, 'cycle', 'cycles')} of "
            f"{how_many(self.n_sections, 'section', 'sections')} each, "
            f"window P = {how_many(self.periods, 'period', 'periods')}; "
            f"{listed(self.inputs)} -> {listed(self.outputs)})"
        )
        return "\n".join(filter(None, [text, print_findings(self.findings, "  ")]))

    def odd_part(self) -> "ExperimentData":
        """Return half the difference of each pair of experiments with opposite inputs.

        Even-order distortion is the same for u and -u and cancels; so do offsets, such as an error
        of the limit cycle. Experiments 2k and 2k + 1 are a pair, as in a design
        `with_negatives()`. A pair with a failed member counts as failed.

        **Raises:** `DefinitionError` for experiments that are no such pairs.
        """
        plus = self.u[::2]
        minus = self.u[1::2]
        if len(self.u) % 2:
            raise DefinitionError(
                f"{len(self.u)} experiments are not pairs: leave one out."
            )
        largest = np.abs(self.u[self.ok]).max(axis=(0, 1), initial=0)
        unit = np.maximum(largest, np.finfo(float).tiny)
        total = np.abs((plus + minus) / unit).max(axis=(1, 2))
        size = np.abs(plus / unit).max(axis=(1, 2))
        # (Inputs of failed experiments may be unknown.)
        both = self.ok[::2] & self.ok[1::2]
        apart = both & ~(total <= _OPPOSITE * size)
        if apart.any():
            k = 2 * int(np.argmax(apart))
            raise DefinitionError(
                f"experiments {k} and {k + 1} are no pair: their inputs are not opposite "
                "(`Design.with_negatives` makes pairs)."
            )
        first = self.result[::2]
        second = self.result[1::2]
        broken = first != Result.OK
        simulated = self.simulated
        if simulated is not None:
            simulated = _of_pairs(simulated, broken)
        return dataclasses.replace(
            self,
            u=plus,
            y=(self.y[::2] - self.y[1::2]) / 2,
            result=np.where(broken, first, second),
            simulated=simulated,
        )


def _of_pairs(simulated: Simulated, broken: Bool[np.ndarray, " P"]) -> Simulated:
    """Return the results of pairs; the first member of those that are `broken` failed.

    Errors and delays are the larger ones of both members.
    """
    first = 2 * np.arange(len(broken))
    member = np.where(broken, first, first + 1)

    def larger(x: Any) -> Any:
        return None if x is None else np.maximum(x[::2], x[1::2])

    return dataclasses.replace(
        simulated,
        failed_at=simulated.failed_at[member],
        error=larger(simulated.error),
        late=larger(simulated.late),
        causes=tuple(simulated.causes[k] for k in member if simulated.causes),
    )


def summary(
    result: Int[np.ndarray, " S"],
    failed_at: Int[np.ndarray, " S"],
    n_sections: int,
    limit: int,
    causes: tuple[str, ...] = (),
) -> str:
    """Return the number of OK experiments, with place and cause of the first `limit` failures."""
    failed = np.flatnonzero(result != Result.OK)
    text = [f"{len(result) - len(failed)}/{len(result)} ok"]
    for s in failed[:limit]:
        cycle, section = divmod(int(failed_at[s]), n_sections)
        cause = causes[s] if causes else Result(int(result[s])).message
        if failed_at[s] >= 0:
            cause = f"section {section}, cycle {cycle}: {cause}"
        text.append(f"#{s}: {cause}")
    if len(failed) > limit:
        text.append(f"and {len(failed) - limit} more")
    return folded("; ".join(text))
