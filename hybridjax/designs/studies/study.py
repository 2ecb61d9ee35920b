"""Experiments one block after the other, until the answer is as precise as was asked."""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..._core.arguments import require_same
from ..._core.blas import one_blas_thread
from ..._core.boundary.checked import checked
from ..._core.boundary.kinds import Count, Order, Positive, Seed
from ..._core.html import card, multiplier_table, table, text
from ..._core.progress import working
from ...errors import DefinitionError
from ...experiments.data import ExperimentData
from ...experiments.design.design import Design
from ...identify.multipliers.structured import StructuredFit
from ..candidates import Candidates
from ..goals import Multipliers
from ..limits.limits import Limit, Limits, require_inputs, without_forbidden
from ..optimal_design import OptimalDesign
from ..optimize import optimal_design
from .estimate import Block, Estimate, block_of, estimate
from .transient import refuse_transient


# A block has at most so many times the strides of all before it. Doubled: fewer blocks, and more
# strides for a design that was made from a poor estimate.
_GROWTH = 2.0
# Part by which a block is made longer than the estimate says, so that one less is needed. Doubled:
# as many strides too many where the estimate was right.
_SPARE = 0.05
# Level of the intervals whose widths are compared with what was asked.
_LEVEL = 0.95


class Found(NamedTuple):
    """What a study has found so far."""

    blocks: tuple[Block, ...]
    strides: Float[np.ndarray, " B"]
    standard_errors: Float[np.ndarray, "B g"]
    estimate: Estimate
    plan: OptimalDesign | None


@checked
class Study(eqx.Module):
    r"""A sequence of experiments that starts from nothing, and ends when multipliers are known.

    ```python
    study = hj.designs.Study(hj.multisine(lines="odd").scaled(0.001), order=2, standard_error=1e-4)
    while not study.done:
        data = hj.run_experiments(cycle, sections, study.design, outputs, start="steady")
        study = study.add(data)     # in a laboratory: hj.identify.remove_transient(data).data
    print(study)
    study.fit.contains(true)         # regions that hold at the time of stopping
    ```

    The first block is applied as it is, whatever `limit` says. Each one after it has the
    `optimal_design` for the model that fits all before it, with the noise that these show, and as
    many experiments as are missing, but at most twice the strides so far. Where the first blocks do
    not carry `order` multipliers, they are repeated with new phases. Nothing is known beforehand
    but the number of multipliers.

    *Why intervals hold.* The estimate at the end is that of maximum likelihood from all blocks.
    Which inputs were applied, and when it was enough, was decided by earlier data only, and
    changes nothing in the likelihood; the estimate, divided by its estimated standard error, is
    normal in the limit of many strides (Wu, Biometrika 72, 1985, for designs that depend on
    estimates; Anscombe, Proc. Camb. Phil. Soc. 48, 1952, and Chow and Robbins, Ann. Math. Stat. 36,
    1965, for stopping as soon as an interval of given width is reached). What spoils it is a
    standard error that happens to be small. Therefore the larger of two is taken, from the scatter
    at the lines that matter and from the level of the noise in all of them, and what is compared
    with the precision asked is the width of the interval by Student's distribution with the degrees
    of freedom that it has, as in Stein's two stages (Ann. Math. Stat. 16, 1945).

    A study is never changed: `add` returns a new one. It depends on its arguments and blocks only,
    so that it can be made again from stored data.

    **Arguments:**

    - `first`: the first block, as one would measure it; its lines, periods and power are those of
      all blocks. One input.
    - `order`: the number of multipliers.
    - `standard_error`: of each multiplier that is asked for, at which to stop (for `"position"`
      the root of the expected squared distance from the true one).
    - `goal`: which multipliers, found by `fit_multipliers`. `limit` and `largest` as for
      `optimal_design`, with `first` for its design.
    - `seed`: of phases and division of all blocks but the first.
    """

    first: Design
    order: Order = eqx.field(static=True)
    standard_error: Positive = eqx.field(static=True)
    goal: Multipliers
    limit: Limit
    largest: Positive | Callable[[np.ndarray], np.ndarray] | None
    seed: Seed = eqx.field(static=True)
    _found: Found | None

    def __init__(
        self,
        first: Design,
        order: Order,
        standard_error: Positive,
        *,
        goal: Multipliers | None = None,
        limit: Limit = "input",
        largest: Positive | Callable[[np.ndarray], np.ndarray] | None = None,
        seed: Seed = 0,
    ):
        if len(first.input_names) > 1:
            raise DefinitionError(
                f"`first` has the inputs {', '.join(first.input_names)}: study one at a time."
            )
        goal = Multipliers() if goal is None else goal
        if goal.weights is not None or goal.estimator == "fit_ldtp":
            raise DefinitionError(
                "a study finds multipliers by fit_multipliers: `goal` may have no weights and no "
                "other estimator."
            )
        if goal.which is not None and goal.which >= order:
            raise DefinitionError(
                f"`goal`: there is no multiplier {goal.which}, the order is {order}."
            )
        if isinstance(limit, Limits) and limit.strides is not None:
            raise DefinitionError(
                "`limit` limits the strides, but a study ends at a precision: end it yourself."
            )
        Candidates.of(without_forbidden(first, largest))
        if isinstance(limit, Limits):
            require_inputs(limit, first.input_names)
        self.first, self.order, self.standard_error = first, order, standard_error
        self.goal = goal
        self.limit, self.largest, self.seed, self._found = limit, largest, seed, None

    @property
    def blocks(self) -> int:
        """How many there are so far."""
        return 0 if self._found is None else len(self._found.blocks)

    @property
    def fit(self) -> StructuredFit | None:
        """The fit to all blocks so far; None before the first."""
        return None if self._found is None else self._found.estimate.fit

    @property
    def plan(self) -> OptimalDesign | None:
        """What the next block is to do; None where that has equal amplitudes."""
        return None if self._found is None else self._found.plan

    @property
    def strides(self) -> Float[np.ndarray, " B"]:
        """After each block: the cycles of all records so far, those that were discarded too."""
        return np.zeros(0) if self._found is None else self._found.strides

    @property
    def standard_errors(self) -> Float[np.ndarray, "B g"]:
        """After each block: of the multipliers that are asked for. NaN where the data did not
        carry as many."""
        return np.zeros((0, 0)) if self._found is None else self._found.standard_errors

    @property
    def noise(self) -> dict[str, float]:
        """Standard deviation of each output's noise (and distortion) in the last block, by name."""
        if self._found is None:
            return {}
        names = self._found.estimate.fit.outputs
        return dict(zip(names, self._found.estimate.noise[-1].tolist(), strict=True))

    @property
    def done(self) -> bool:
        """Whether the precision that was asked is reached."""
        if self._found is None or not np.isfinite(self._found.standard_errors[-1]).all():
            return False
        errors = self._found.standard_errors[-1]
        return bool(errors.max() * _student(self._found.estimate.fit) <= self.standard_error)

    @property
    def design(self) -> Design:
        """The next block: for `run_experiments`, or for hardware
        (`hj.recordings.write_design`)."""
        if self._found is None:
            return self.first
        if self._found.plan is None:
            return self.first.realizations(1, seed=self.seed + self.blocks)
        return self._found.plan.design

    @working("Study.add")
    @one_blas_thread()
    def add(self, data: ExperimentData, *, repeats: Count = 1) -> "Study":
        """The study with one block more, its estimate and its next design.

        **Arguments:** `data`: the responses to `design`, or to anything else of the same kind (of
        recordings: `section_data(...).experiments(periods)`). `repeats`: how many of the last
        windows are averaged.

        **Raises:** `DefinitionError` for data of other inputs, outputs or sections, and of which a
        part larger than `standard_error` is a transient of the start (cycles before the window
        show it); as `estimate_htf`, `fit_multipliers` and `optimal_design`.
        """
        if data.n_sections != self.first.n_sections or len(data.inputs) > 1:
            raise DefinitionError(
                f"`data` have {data.n_sections} sections and {len(data.inputs)} inputs, the study "
                f"{self.first.n_sections} and 1."
            )
        blocks = () if self._found is None else self._found.blocks
        new = block_of(data, self.goal, repeats)
        for known in blocks[:1]:
            require_same("blocks of one study", known, new, ("inputs", "outputs"))
        blocks = (*blocks, new)
        best = estimate(blocks, self.order, self.goal)
        if not best.doubt:
            known = best.fit.multipliers, best.noise[-1], self.standard_error
            refuse_transient(data, repeats, *known)
        errors = _asked(best.fit, self.goal)
        if best.doubt:
            errors = np.full_like(errors, np.nan)
        past = [] if self._found is None else list(self._found.standard_errors)
        width = max(map(len, [*past, errors]))
        history = [np.concatenate([x, np.full(width - len(x), np.nan)]) for x in [*past, errors]]
        strides = np.cumsum([block.strides for block in blocks]).astype(float)
        plan = None if best.doubt else self._next(best, errors, strides[-1], len(blocks))
        found = Found(blocks, strides, np.array(history), best, plan)
        return eqx.tree_at(lambda s: s._found, self, found, is_leaf=lambda x: x is None)

    def _next(
        self, best: Estimate, errors: Float[np.ndarray, " g"], strides: float, blocks: int
    ) -> OptimalDesign:
        """The design for what is missing."""
        about = dict(
            goal=self.goal, limit=self.limit, largest=self.largest, seed=self.seed + blocks,
            noise=dict(zip(best.fit.outputs, best.noise[-1].tolist(), strict=True)),
        )  # fmt: skip
        plan = optimal_design(best.fit, self.first, **about)
        # Precisions of independent blocks add.
        now = (errors**2).sum()
        wanted = now * (self.standard_error / errors.max() / _student(best.fit)) ** 2
        missing = plan.strides * (plan.standard_errors**2).sum() * (1 / wanted - 1 / now)
        most = _GROWTH * strides / self.first.periods
        count = int(np.ceil(min(missing * (1 + _SPARE) / self.first.periods, most)))
        count = min(max(count, self.first.experiments), len(Candidates.of(self.first).f))
        if count == self.first.experiments:
            return plan
        return optimal_design(best.fit, self.first, experiments=count, **about)

    def __repr__(self) -> str:
        return f"Study({self._state()})\n{self._table()}".rstrip()

    def _repr_html_(self) -> str:
        if self.fit is None:
            return card("Study", self._state())
        rows = [
            (f"{n:.0f}", _shown(errors))
            for n, errors in zip(self.strides, self.standard_errors, strict=True)
        ]
        shown = multiplier_table(self.fit.multipliers, self.fit.half_widths())
        return card(
            "Study", self._state(), shown, table(("strides", "standard errors"), rows),
            text(self._next_in_words()),
        )  # fmt: skip

    def _state(self) -> str:
        if self._found is None:
            return f"standard error {self.standard_error:.2g} asked; nothing measured yet"
        state = "reached" if self.done else "not yet reached"
        return f"standard error {self.standard_error:.2g} asked: {state}"

    def _table(self) -> str:
        if self.fit is None:
            return f"  next: {self.design!r}".replace("\n", "\n  ")
        rows = ["  strides  standard errors"]
        for n, errors in zip(self.strides, self.standard_errors, strict=True):
            rows.append(f"  {n:7.0f}  {_shown(errors)}")
        rows.append(f"  multipliers {self.fit.show_multipliers()}")
        return "\n".join([*rows, *(f"  {x}" for x in self._next_in_words().splitlines())])

    def _next_in_words(self) -> str:
        if self._found is None:
            return ""
        if self._found.plan is None:
            return f"next: equal amplitudes again, since {self._found.estimate.doubt}"
        plan = self._found.plan
        usual = (plan.usual_standard_errors**2).sum() * plan.usual.cycles(0)
        equal = usual / (_asked(self._found.estimate.by_level, self.goal) ** 2).sum()
        said = f"with equal amplitudes as much takes about {equal:.3g} strides"
        if self.done:
            return said
        return (
            f"{said}\nnext: {plan.design.experiments} experiments of {plan.design.periods} periods"
        )


def _asked(fit: StructuredFit, goal: Multipliers) -> Float[np.ndarray, " g"]:
    """Standard errors of the multipliers that are asked for, of a conjugate pair once."""
    found = fit.multipliers
    some = np.flatnonzero(found.imag >= 0) if goal.which is None else np.array([goal.which])
    covariance = fit.multiplier_covariances[some]
    if goal.part == "position":
        return np.sqrt(np.trace(covariance, axis1=1, axis2=2))
    direction = np.stack([found[some].real, found[some].imag], axis=1) / np.abs(found[some, None])
    return np.sqrt(np.einsum("gi,gij,gj->g", direction, covariance, direction))


def _student(fit: StructuredFit) -> float:
    """By how much intervals are wider than they were if the standard errors were exact."""
    from scipy import special  # (a fifth of a second)

    if np.isinf(fit.covariance_freedom):
        return 1.0
    tail = (1 + _LEVEL) / 2
    return float(special.stdtrit(fit.covariance_freedom, tail) / special.ndtri(tail))


def _shown(errors: Float[np.ndarray, " g"]) -> str:
    if not np.isfinite(errors).all():
        return "too few data for so many multipliers"
    return ", ".join(f"{x:.2e}" for x in errors)
