"""`SequentialDesign`: experiments block after block, until the estimate is as precise as requested.

A study has no model at first: `design` is the next block, and `add(data)` returns the study with
the estimate from all blocks (`study_estimate.py`) and the optimal design for the missing cycles
(`_next`). Studies are immutable, and must depend on their arguments and blocks only. A study that
never ends has its cause in `_suffices` or `_refuse_surplus`, a block that is too long or too short
in `_next`. Data that are refused: see `_with_block`, `_require_supported` and `refuse_transient`.
"""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

from .._core.arguments import require_among, require_equal, require_index, require_same
from .._core.boundary.checked import checked
from .._core.boundary.kinds import Count, OptionalNames, Order, Positive, Seed
from .._core.execution import one_blas_thread
from .._core.executor import is_traced
from .._core.html import card, multiplier_table, table, text
from .._core.progress import working
from .._core.showable import Showable
from .._core.text import folded, how_many
from ..errors import DefinitionError
from ..experiments.data import ExperimentData
from ..experiments.design.design import Design
from ..identify.multiplier_estimate import shown_multipliers
from ..identify.multipliers import StructuredFit
from ..identify.weights import are_alike
from .candidates import Candidates
from .goals import MultiplierGoal
from .limits import Limit, as_limits
from .optimize import OptimalDesign, optimal_design
from .study_estimate import Block, Estimate, block_of, estimate, refuse_transient


# A block has at most this many times the cycles of all blocks before it. Larger: more cycles for a
# design from a poor estimate. Smaller: more blocks.
_GROWTH = 2.0
# A block is longer than predicted by this part. Larger: too many cycles if the prediction is right.
# Smaller: another block if the prediction is a little too low.
_SPARE = 0.05
# Level of the confidence intervals whose widths are compared with the requested precision.
_LEVEL = 0.95


class History(NamedTuple):
    """The blocks of a study, and the results after each."""

    blocks: tuple[Block, ...] = ()
    standard_errors: Float[np.ndarray, "B g"] = np.zeros((0, 0))
    estimate: Estimate | None = None
    plan: OptimalDesign | None = None


@checked
class SequentialDesign(Showable, eqx.Module):
    r"""A sequence of experiments that starts without a model, and ends at a requested precision.

    The first block is applied unchanged, also if it exceeds `limit`. Each later block has the
    `optimal_design` for a model and a noise level that are estimated from all blocks before it. It
    has as many experiments as the standard error still requires, but at most twice as many cycles
    as all blocks before it. While the data do not support `order` multipliers, or the estimate is
    unstable, the first block is repeated with new phases. No prior knowledge is used except the
    number of multipliers.

    *Why intervals are valid.* The final estimate is the maximum-likelihood estimate
    from all blocks. Inputs and the time of stopping depend on earlier data only, and
    therefore do not change the likelihood. The estimation error, divided by the
    estimated standard error, is Gaussian in the limit of many cycles. Wu (Biometrika
    72, 1985) shows this for designs that depend on estimates. Anscombe (Proc. Camb.
    Phil. Soc. 48, 1952) and Chow and Robbins (Ann. Math. Stat. 36, 1965) show it for
    studies that stop as soon as an interval of given width is reached. If a standard
    error were too small by chance, the study would stop too early. Therefore the larger
    of two standard errors is used: one from the scatter at the lines that determine the
    multipliers, the other from the mean noise level of all lines. The study stops when
    the interval by Student's distribution is as narrow as requested, similar to the
    two-stage method of Stein (Ann. Math. Stat. 16, 1945).

    A study is immutable: `add` returns a new one. It depends on its arguments and blocks only, so
    that it can be reconstructed from stored data.

    **Arguments:**

    - `first`: the first block, with one input. All blocks have its lines, periods and power.
    - `order`: the number of multipliers.
    - `standard_error`: the study stops when each multiplier of `goal` has this standard error. For
      `"position"`, it is the root of the expected squared distance from the true multiplier.
    - `goal`: the multipliers of interest, estimated by `fit_multipliers`. Default: all.
    - `limit`: as in `optimal_design`, relative to `first`. Default: rms of the input as in `first`.
    - `outputs`: names of outputs that will be recorded and that `limit` names. Default: none.
    - `seed`: seed of the phases, and of the division of lines among experiments, in all blocks but
      the first. Default: 0.

    **Raises:** `DefinitionError` for several inputs, other estimators, and a limit of cycles.

    **Example:**

    ```python
    study = hj.designs.SequentialDesign(design, order=2, standard_error=5e-4)
    while not study.done:
        clean = hj.experiments.simulate_experiments(model, study.design, start="periodic")
        data = hj.experiments.add_noise(clean, std=1e-5, seed=study.blocks)
        study = study.add(data)  # in a laboratory: hj.identify.remove_transient(data).data
    print(study, study.fit.contains(model.multipliers))
    ```

    **Before:** `hj.multisine`. **After:** `hj.run_experiments`, `hj.identify.remove_transient`.
    """

    first: Design
    order: Order = eqx.field(static=True)
    standard_error: Positive = eqx.field(static=True)
    goal: MultiplierGoal = eqx.field(default_factory=MultiplierGoal, kw_only=True)
    limit: Limit = eqx.field(default="input", kw_only=True)
    outputs: OptionalNames = eqx.field(static=True, default=(), kw_only=True)
    seed: Seed = eqx.field(static=True, default=0, kw_only=True)
    _history: History = eqx.field(default_factory=History, kw_only=True)

    def __check_init__(self):
        first = self.first
        goal = self.goal
        if len(first.inputs) > 1:
            raise DefinitionError(
                "`first` must have a single input: study one at a time."
            )
        if goal.estimator == "fit_ldtp":
            raise DefinitionError(
                "`goal` of a study needs estimator='fit_multipliers'."
            )
        require_index("multiplier", goal.which or 0, self.order)
        limits = as_limits(self.limit)
        if limits.cycles is not None:
            raise DefinitionError(
                "a study ends at `standard_error`: leave `cycles` out of `limit`."
            )
        limits.require_inputs(first.inputs)
        named = limits.rms
        signals = (*first.inputs, *self.outputs)
        if not isinstance(named, str):
            require_among(
                "signal", named, signals, "`limit` (`outputs` names those to come): "
            )
        if not is_traced(first):
            Candidates.of(first)

    @property
    def blocks(self) -> int:
        """Number of blocks so far."""
        return len(self._history.blocks)

    @property
    def fit(self) -> StructuredFit | None:
        """The fit to all blocks so far; None before the first."""
        estimate = self._history.estimate
        return None if estimate is None else estimate.fit

    @property
    def plan(self) -> OptimalDesign | None:
        """The optimal design for the next block, or None if the next block is like the first."""
        return self._history.plan

    @property
    def cycles(self) -> Float[np.ndarray, " B"]:
        """Cycles of all records up to each block, with those that were discarded."""
        return np.cumsum([block.cycles for block in self._history.blocks]).astype(float)

    @property
    def standard_errors(self) -> Float[np.ndarray, "B g"]:
        """Standard errors of the multipliers of `goal` after each block. NaN where an estimate was
        rejected."""
        return self._history.standard_errors

    @property
    def noise(self) -> dict[str, float]:
        """Standard deviation of each output's noise (and distortion) in the last block, by name."""
        estimate = self._history.estimate
        return {} if estimate is None else estimate.last_noise

    @property
    def done(self) -> bool:
        """True if the requested precision is reached."""
        if self.fit is None or not np.isfinite(self.standard_errors[-1]).all():
            return False
        return self._suffices(self.fit, self.standard_errors[-1])

    @property
    def design(self) -> Design:
        """The next block: for `run_experiments`, or for hardware
        (`Design.write`)."""
        if self.fit is None:
            return self.first
        if self.plan is None:
            return self.first.realizations(1, seed=self.seed + self.blocks)
        return self.plan.design

    @working("SequentialDesign.add")
    @one_blas_thread()
    def add(self, data: ExperimentData, *, repeats: Count = 1) -> "SequentialDesign":
        """Return the study with one more block, its estimate and its next design.

        **Arguments:** `data`: the responses to `design`, or to other inputs of the same lines (from
        recordings: `sample_sections(...).experiments(periods)`). `repeats`: number of last windows
        that are averaged. Default: 1.

        **Raises:** `DefinitionError` for data of other inputs, outputs or sections, if the data
        show more than `order` multipliers, if they show fewer and determine these to
        `standard_error`, and if the initial transient, relative to the response, exceeds
        `standard_error` (tested if there are cycles before the window). `DefinitionError` in the
        cases of `estimate_htf`, `fit_multipliers` and `optimal_design`.
        """
        blocks = self._with_block(data, repeats)
        best = estimate(blocks, self.order, self.goal)
        self._require_supported(best, blocks)
        errors = _standard_errors(best.fit, self.goal)
        if best.objection:
            errors = np.full_like(errors, np.nan)
            plan = None
        else:
            multipliers = best.fit.multipliers
            noise = best.noise[-1]
            refuse_transient(data, repeats, multipliers, noise, self.standard_error)
            plan = self._next(best, errors, blocks)
        history = History(
            blocks=blocks,
            standard_errors=_with_row(self.standard_errors, errors),
            estimate=best,
            plan=plan,
        )
        return eqx.tree_at(
            lambda s: s._history, self, history, is_leaf=lambda x: x is None
        )

    def _with_block(self, data: ExperimentData, repeats: int) -> tuple[Block, ...]:
        """Return the blocks with one more.

        **Raises:** `DefinitionError` for data of other inputs, outputs or sections.
        """
        require_equal(
            "data and study", "n_sections", data.n_sections, self.first.n_sections
        )
        require_equal("data and study", "numbers of inputs", len(data.inputs), 1)
        block = block_of(data, self.goal, repeats)
        for earlier in self._history.blocks[:1]:
            require_same(
                "blocks of one study", earlier.htf, block.htf, ("inputs", "outputs")
            )
        return *self._history.blocks, block

    def _require_supported(self, best: Estimate, blocks: tuple[Block, ...]) -> None:
        """**Raises:** `DefinitionError` if the data show more multipliers than `order`, or support
        fewer, which are as precise as requested already."""
        if are_alike(best.fit.correlation, best.fit.dof):
            raise DefinitionError(
                f"the data show more than {self.order} multipliers: add the blocks to a study with "
                "a larger `order`."
            )
        if 0 < best.supported < self.order:
            self._refuse_surplus(blocks, best.supported)

    def _suffices(self, fit: StructuredFit, errors: Float[np.ndarray, " g"]) -> bool:
        """Return whether these standard errors are as small as requested."""
        return bool(errors.max() * _student(fit) <= self.standard_error)

    def _refuse_surplus(self, blocks: tuple[Block, ...], supported: int) -> None:
        """**Raises:** `DefinitionError` if the multipliers that the data support are as precise as
        requested already: the study would repeat its first block for ever."""
        if (self.goal.which or 0) >= supported:
            return
        fewer = estimate(blocks, supported, self.goal)
        errors = _standard_errors(fewer.fit, self.goal)
        if not fewer.objection and self._suffices(fewer.fit, errors):
            raise DefinitionError(
                f"the data support {how_many(supported, 'multiplier', 'multipliers')}, not "
                f"{self.order}, and determine these to a standard error of "
                f"{errors.max():.2g}: add the blocks to a study with order={supported}, or "
                "with a smaller `standard_error`."
            )

    def _next(
        self,
        best: Estimate,
        errors: Float[np.ndarray, " g"],
        blocks: tuple[Block, ...],
    ) -> OptimalDesign:
        """Return the design for the missing cycles."""

        def planned(limit: Limit) -> OptimalDesign:
            return optimal_design(
                best.fit,
                self.first,
                goal=self.goal,
                limit=limit,
                noise=best.last_noise,
                seed=self.seed + len(blocks),
            )

        plan = planned(self.limit)
        periods = self.first.periods
        # (Inverse variances of independent blocks add.)
        now = (errors**2).sum()
        wanted = now * (self.standard_error / errors.max() / _student(best.fit)) ** 2
        squares = (plan.standard_errors**2).sum()
        missing = plan.cycles * squares * (1 / wanted - 1 / now)
        at_most = _GROWTH * sum(block.cycles for block in blocks)
        cycles_more = min(missing * (1 + _SPARE), at_most)
        count = int(np.ceil(cycles_more / periods))
        count = min(
            max(count, self.first.experiments), len(Candidates.of(self.first).f)
        )
        if count == self.first.experiments:
            return plan
        return planned(
            dataclasses.replace(as_limits(self.limit), cycles=count * periods)
        )

    def __repr__(self) -> str:
        if self.fit is None:
            rows = [f"  next: {self.design!r}".replace("\n", "\n  ")]
        else:
            rows = ["   cycles  standard errors"]
            rows += [f"  {n:>7}  {errors}" for n, errors in self._rows()]
            rows.append(f"  {folded(shown_multipliers(self.fit))}")
            rows += [f"  {x}" for x in self._outlook().splitlines()]
        return "\n".join([f"SequentialDesign({self._state()})", *rows])

    def _repr_html_(self) -> str:
        if self.fit is None:
            return card("SequentialDesign", self._state())
        multipliers = multiplier_table(self.fit.multipliers, self.fit.standard_errors)
        cycles = table(("cycles", "standard errors"), self._rows())
        return card(
            "SequentialDesign",
            self._state(),
            multipliers,
            cycles,
            text(self._outlook()),
        )

    def _state(self) -> str:
        wanted = f"standard error {self.standard_error:.2g} requested"
        if self.fit is None:
            return f"{wanted}; nothing measured yet"
        return f"{wanted}: {'reached' if self.done else 'not yet reached'}"

    def _rows(self) -> list[tuple[str, str]]:
        rows = []
        for n, errors in zip(self.cycles, self.standard_errors, strict=True):
            numbers = ", ".join(f"{x:.2e}" for x in errors)
            rows.append(
                (
                    f"{n:.0f}",
                    numbers if np.isfinite(errors).all() else "estimate rejected",
                )
            )
        return rows

    def _outlook(self) -> str:
        best = self._history.estimate
        plan = self.plan
        if plan is None or best is None:
            return (
                f"next: the first design again, since {best.objection if best else ''}"
            )
        usual = (plan.usual_standard_errors**2).sum() * plan.usual.cycles(0)
        equal = usual / (_standard_errors(best.by_level, self.goal) ** 2).sum()
        usual_name = plan.usual_name.capitalize()
        cycles = f"{float(f'{equal:.3g}'):.0f}" if equal >= 10 else f"{equal:.2g}"
        need = f"would need about {cycles} cycles for the same standard errors"
        comparison = f"{usual_name} {need}."
        if self.done:
            return comparison
        design = plan.design
        experiments = how_many(design.experiments, "experiment", "experiments")
        periods = how_many(design.periods, "period", "periods")
        return f"{comparison}\nnext: {experiments} of {periods}"


def _with_row(
    rows: Float[np.ndarray, "B g"], row: Float[np.ndarray, " h"]
) -> Float[np.ndarray, "B1 w"]:
    """Return a table with one more row. Rows that are shorter than others end with NaN. (Estimates
    may have pairs in place of real multipliers, so that their numbers of errors differ.)"""
    width = max(rows.shape[1], len(row))

    def padded(x):
        return np.append(x, np.full(width - len(x), np.nan))

    return np.array([padded(x) for x in (*rows, row)])


def _standard_errors(
    fit: StructuredFit, goal: MultiplierGoal
) -> Float[np.ndarray, " g"]:
    """Return standard errors of the multipliers of a goal, those of a conjugate pair once."""
    z = np.asarray(fit.multipliers)
    if goal.which is None:
        wanted = np.flatnonzero(np.imag(z) >= 0)
    else:
        wanted = np.array([goal.which])
    covariance = fit.multiplier_covariances[wanted]
    if goal.part == "position":
        return np.sqrt(np.trace(covariance, axis1=1, axis2=2))
    direction = np.stack([np.real(z[wanted]), np.imag(z[wanted])], axis=1) / np.abs(
        z[wanted, None]
    )
    return np.sqrt(np.einsum("gi,gij,gj->g", direction, covariance, direction))


def _student(fit: StructuredFit) -> float:
    """Return the ratio of Student's to Gaussian intervals of the fit."""
    from scipy import special  # (a fifth of a second)

    tail = (1 + _LEVEL) / 2
    return float(special.stdtrit(fit.covariance_dof, tail) / special.ndtri(tail))
