"""What experiments return, whoever made them: a hybrid system, a linear model, a laboratory."""

from collections.abc import Sequence
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._core.arguments import names
from .._core.results import Result
from ..errors import DefinitionError
from ..linear.ldtp import LDTP
from .design.design import Design
from .noise import draw_process_noise
from .record import Record


class ExperimentData(eqx.Module):
    """Inputs and outputs of S experiments, sampled at the sections of a limit cycle.

    **Fields**, all on the host:

    - `u`: inputs, (S, n, nu); `u[:, i]` is held from sample i to i + 1. Sample 0 lies on
      section 0, n is a whole number of periods.
    - `y`: outputs at the sections minus those on the limit cycle, (S, n, ny), sampled before
      `u[:, i]` acts. NaN from the failure on where an experiment failed.
    - `result`: (S,) codes of `Result`. `failed_at`: (S,) the sample at which an experiment
      failed, -1 where it did not.
    - `error`: (S,) estimates of the largest error of a simulation, relative to the sizes of the
      states on the cycle, or None if not known.
    - `cycle_outputs`: (N, ny) the outputs on the limit cycle, or None if not known.
    - `n_sections`: N. `periods`: P; estimates use the last P periods (P * N samples).
    - `inputs`, `outputs`: names. `family`: name of the section family, for labels.
    """

    u: Float[np.ndarray, "S n nu"]
    y: Float[np.ndarray, "S n ny"]
    result: Int[np.ndarray, " S"]
    failed_at: Int[np.ndarray, " S"]
    error: Float[np.ndarray, " S"] | None
    cycle_outputs: Float[np.ndarray, "N ny"] | None
    n_sections: int = eqx.field(static=True)
    periods: int = eqx.field(static=True)
    inputs: tuple[str, ...] = eqx.field(static=True)
    outputs: tuple[str, ...] = eqx.field(static=True)
    family: str = eqx.field(static=True)

    def __init__(
        self,
        u: Any,
        y: Any,
        *,
        n_sections: int,
        periods: int,
        inputs: str | Sequence[str] | None = None,
        outputs: str | Sequence[str] | None = None,
        result: Any = None,
        failed_at: Any = None,
        error: Any = None,
        cycle_outputs: Any = None,
        family: str = "",
    ):
        """**Arguments:** the fields. Without `result` every experiment counts as good; names
        default to `u` and `y`, or `u0`, `u1`, ... where there are several.

        **Raises:** `DefinitionError` for shapes that do not fit together, a record that is not a
        whole number of periods or shorter than the window, and for NaN in a good experiment.
        """
        self.u, self.y = _real("u", u), _real("y", y)
        shapes = self.u.shape, self.y.shape
        if any(len(s) != 3 or 0 in s for s in shapes) or shapes[0][:2] != shapes[1][:2]:
            raise DefinitionError(
                "u must have the shape (experiments, samples, inputs) and y (experiments, "
                f"samples, outputs), not {shapes[0]} and {shapes[1]}."
            )
        S = len(self.u)
        self.result = np.zeros(S, int) if result is None else np.asarray(result, int)
        self.failed_at = np.full(S, -1) if failed_at is None else np.asarray(failed_at, int)
        self.error = None if error is None else np.asarray(error, float)
        self.cycle_outputs = (
            None if cycle_outputs is None else _real("cycle_outputs", cycle_outputs)
        )
        self.n_sections, self.periods, self.family = n_sections, periods, family
        self.inputs = names("inputs", inputs, self.u.shape[2])
        self.outputs = names("outputs", outputs, self.y.shape[2])

        self._check()

    def _check(self) -> None:
        S, n, _ = self.u.shape
        N, P, ny = self.n_sections, self.periods, self.y.shape[2]
        if N < 1 or P < 1:
            raise DefinitionError(f"sections ({N}) and periods ({P}) must be at least 1.")
        if n % N:
            raise DefinitionError(
                f"the record has {n} samples, not a multiple of N = {N} sections: cut it to whole "
                "periods, beginning at section 0."
            )
        if n < N * P:
            raise DefinitionError(
                f"the window of P = {P} periods is longer than the record, {n // N} periods of "
                f"{N} sections."
            )
        each = (self.result, self.failed_at) + (() if self.error is None else (self.error,))
        if any(x.shape != (S,) for x in each):
            raise DefinitionError(
                f"result, failed_at and error must have one entry for each of {S} experiments."
            )
        if self.cycle_outputs is not None and self.cycle_outputs.shape != (N, ny):
            raise DefinitionError(
                f"cycle_outputs must have the shape (sections, outputs) = ({N}, {ny}), not "
                f"{self.cycle_outputs.shape}."
            )
        for name, values in (("u", self.u), ("y", self.y)):
            finite = np.isfinite(values)
            if finite.all():  # (along the last, short axis it takes ten times as long)
                continue
            bad = ~finite.all(axis=2) & self.ok[:, None]
            if bad.any():
                s, i = (int(x) for x in np.argwhere(bad)[0])
                raise DefinitionError(
                    f"experiment {s}: {name} is NaN or infinite at sample {i}; repair the record, "
                    "or mark the experiment as failed in `result`."
                )

    @property
    def ok(self) -> Bool[np.ndarray, " S"]:
        """Which experiments ran to their end."""
        return self.result == Result.OK

    @property
    def records(self) -> tuple[Record, ...]:
        """The experiments that ran to their end, each with all of its cycles."""
        about = {"n_sections": self.n_sections, "inputs": self.inputs, "outputs": self.outputs}
        return tuple(Record(self.u[s], self.y[s], **about) for s in np.flatnonzero(self.ok))

    @property
    def window(self) -> slice:
        """The samples that estimates use: the last P periods."""
        return slice(self.u.shape[1] - self.n_sections * self.periods, None)

    def windows(self, repeats: int = 1) -> list[slice]:
        """The last `repeats` windows of P periods each, one after the other.

        **Raises:** `DefinitionError` if the record is too short.
        """
        n, length = self.u.shape[1], self.n_sections * self.periods
        if repeats < 1 or repeats * length > n:
            raise DefinitionError(
                f"{repeats} windows of P = {self.periods} periods need {repeats * self.periods} "
                f"cycles (and repeats >= 1), but the record has {n // self.n_sections}: record "
                "more cycles, or take fewer repeats."
            )
        first = n - repeats * length
        return [slice(first + r * length, first + (r + 1) * length) for r in range(repeats)]

    def summary(self, limit: int = 5) -> str:
        """`80/80 ok`, or how many ran and why the first `limit` of the others did not."""
        return summary(self.result, self.failed_at, self.n_sections, limit)

    def __repr__(self) -> str:
        S, n, _ = self.u.shape
        family = f"{self.family}, " if self.family else ""
        return (
            f"ExperimentData({family}{self.summary()}; {n // self.n_sections} cycles of "
            f"{self.n_sections} sections each, window P = {self.periods} periods; "
            f"{', '.join(self.inputs)} -> {', '.join(self.outputs)})"
        )


def summary(
    result: Int[np.ndarray, " S"], failed_at: Int[np.ndarray, " S"], n_sections: int, limit: int
) -> str:
    """What became of experiments, and where and why the first `limit` that failed did so."""
    failed = np.flatnonzero(result != Result.OK)
    text = [f"{len(result) - len(failed)}/{len(result)} ok"]
    for s in failed[:limit]:
        cycle, section = divmod(int(failed_at[s]), n_sections)
        where = f"section {section}, cycle {cycle}: " if failed_at[s] >= 0 else ""
        text.append(f"#{s}: {where}{Result(int(result[s])).message}")
    if len(failed) > limit:
        text.append(f"and {len(failed) - limit} more")
    return "; ".join(text)


def _real(name: str, values: Any) -> np.ndarray:
    try:
        values = np.asarray(values)
    except ValueError as error:
        raise DefinitionError(f"{name} is not a rectangular array: {error}.") from error
    if values.dtype.kind not in "fiu":
        raise DefinitionError(f"{name} must hold real numbers, not {values.dtype}.")
    return values.astype(float)


def simulate_experiments(
    ldtp: LDTP,
    design: Design,
    *,
    discard: int | None = None,
    start: Literal["rest", "periodic"] = "rest",
    process_noise: int | float = 0.0,
    seed: int = 0,
) -> ExperimentData:
    """Run a design on a linear periodic model, from section 0.

    **Arguments:**

    - `ldtp`: the model. `design`: for the same N and number of inputs.
    - `start`: `"rest"` starts at zero, so a transient decays during the first cycles;
      `"periodic"` starts on the periodic response, without a transient.
    - `discard`: cycles run before the window of P periods; by default 20 from rest (as in the
      paper), 0 from the periodic start.
    - `process_noise`: standard deviation of a random input, held from section to section, that
      acts beside the excitation and is not recorded. `seed`: of it.

    **Returns:** `ExperimentData` with `discard + P` cycles.

    **Raises:** `DefinitionError` if N or the number of inputs differ, or if a periodic response
    does not exist (a multiplier that is a P-th root of one).
    """
    if start not in ("rest", "periodic"):
        raise DefinitionError(f"start must be 'rest' or 'periodic', not {start!r}.")
    if ldtp.n_sections != design.n_sections or len(ldtp.inputs) != len(design.input_names):
        raise DefinitionError(
            f"the design is for N = {design.n_sections} and {len(design.input_names)} inputs, the "
            f"model has N = {ldtp.n_sections} and {len(ldtp.inputs)}."
        )
    if discard is None:
        discard = 20 if start == "rest" else 0
    if discard < 0:
        raise DefinitionError(f"discard must not be negative, but is {discard}.")
    u = design.inputs(design.periods + discard)
    x0 = None
    if start == "periodic":
        # Outside of jit, where the model can tell that no periodic response exists.
        x0 = jax.vmap(lambda u: ldtp.periodic_state(u, design.periods))(design.inputs())
    kicks = draw_process_noise(u.shape, process_noise, seed)
    y = _respond(ldtp, jnp.asarray(u + kicks), x0)
    return ExperimentData(
        u,
        y,
        n_sections=design.n_sections,
        periods=design.periods,
        inputs=ldtp.inputs,
        outputs=ldtp.outputs,
        family="linear model",
    )


@eqx.filter_jit
def _respond(
    ldtp: LDTP, u: Float[Array, "S n nu"], x0: Float[Array, "S d"] | None
) -> Float[Array, "S n ny"]:
    return jax.vmap(ldtp.simulate)(u, x0)
