"""The usual designs: multisines over a band, the paper's, single cosines."""

from collections.abc import Sequence
from typing import Literal

import numpy as np

from .._core.errors import DefinitionError
from .design import Design, Number, Numbers, input_names, to_lines
from .partition import (
    assign,
    avoid_second_order,
    fewest_experiments,
    is_half_integer,
    is_real,
    needs_two_phases,
)


def multisine(
    sections: int = 32,
    periods: int = 64,
    f_max: Number = 10.0,
    amplitude: Number = 0.01,
    seed: int = 0,
    *,
    f_min: Number = 0.0,
    experiments: int | None = None,
    half_integers: Literal["skip", "two-phase"] = "skip",
    second_order: Literal["ignore", "avoid"] = "ignore",
    inputs: int | str | Sequence[str] = 1,
) -> Design:
    """Multisines that measure every frequency `j / periods` in `[f_min, f_max]`.

    The frequencies are divided at random among the experiments, under the rules of Sec. V-B
    (see `Design.check`), in sets whose sizes differ by one at most. For N = 32, P = 64 and
    f_max = 10 the 620 frequencies need 20 experiments, the exact minimum; the paper takes 80.

    **Arguments:**

    - `sections`: N. `periods`: P, the periods in one window; the resolution is 1/P.
    - `f_max`, `f_min`: the band in cycles per period, both ends included.
    - `amplitude`: of each cosine. `seed`: of the phases and the division.
    - `experiments`: by default the fewest possible. Any greater number gives weaker signals
      with fewer cosines each, and so less distortion; with the fewest, every second-order
      product falls on a line of the same experiment, so amplitudes must be small.
    - `half_integers`: `"skip"` leaves multiples of 1/2 out, as the paper does; `"two-phase"`
      measures them in two experiments each, with phases 90 degrees apart (0 and N/2 in one).
    - `second_order`: `"avoid"` divides the frequencies so that the products f_i + f_j and
      f_i - f_j of one experiment, where a quadratic distortion answers, miss its own lines.
      This needs many experiments with few lines each, e.g. 80 where 20 suffice.
    - `inputs`: their number or names. Each experiment excites one input; with several inputs,
      `experiments` is their number for all inputs together.

    **Raises:** `DefinitionError` for a band that holds no frequency or exceeds N/2, or for too
    few experiments (the message says the minimum).
    """
    names = input_names(inputs)
    if half_integers not in ("skip", "two-phase"):
        raise DefinitionError(
            f"half_integers must be 'skip' or 'two-phase', not {half_integers!r}."
        )
    if second_order not in ("ignore", "avoid"):
        raise DefinitionError(f"second_order must be 'ignore' or 'avoid', not {second_order!r}.")
    if sections < 1 or periods < 1:
        raise DefinitionError(f"sections ({sections}) and periods ({periods}) must be at least 1.")
    if not 0 <= f_min <= f_max <= sections / 2:
        raise DefinitionError(
            f"the band from f_min = {f_min} to f_max = {f_max} must lie in [0, N/2 = "
            f"{sections / 2}] cycles per period."
        )
    low, high = int(np.ceil(f_min * periods - 1e-9)), int(np.floor(f_max * periods + 1e-9))
    lines = np.arange(low, high + 1)
    if half_integers == "skip":
        lines = lines[~is_half_integer(lines, periods)]
    if len(lines) == 0:
        raise DefinitionError(
            f"no multiple of 1/{periods} other than those of 1/2 lies between f_min = {f_min} "
            f"and f_max = {f_max}: take more periods or a wider band."
        )
    # A frequency that needs two phases stands twice; `second` marks its second appearance.
    lines = np.sort(np.concatenate([lines, lines[needs_two_phases(lines, periods, sections)]]))
    second = np.concatenate([[False], lines[1:] == lines[:-1]])

    fewest = fewest_experiments(lines, periods) * len(names)
    if experiments is None:
        experiments = fewest
    if experiments < fewest:
        raise DefinitionError(
            f"{experiments} experiments are too few: these {len(np.unique(lines))} frequencies "
            f"need at least {fewest}" + (f" for {len(names)} inputs." if len(names) > 1 else ".")
        )
    if experiments > len(lines) * len(names):
        raise DefinitionError(
            f"{experiments} experiments are more than the {len(lines) * len(names)} cosines "
            "that there are to distribute."
        )

    rng = np.random.default_rng(seed)
    shares = [experiments // len(names) + (i < experiments % len(names)) for i in range(len(names))]
    experiment, phase = [], []
    for i, share in enumerate(shares):
        division = assign(lines, periods, share, rng)
        if second_order == "avoid":
            division = avoid_second_order(division, lines, periods, rng)
        experiment.append(sum(shares[:i]) + division)
        random = rng.uniform(0, 2 * np.pi, len(lines))
        random = np.where(second, np.roll(random, 1) + np.pi / 2, random)
        phase.append(np.where(is_real(lines, periods, sections), 0.0, random))
    experiment = np.concatenate(experiment)
    line = np.tile(lines, len(names))
    order = np.lexsort((line, experiment))
    return Design(
        experiment=experiment[order],
        line=line[order],
        channel=np.repeat(np.arange(len(names)), len(lines))[order],
        amplitude=np.full(len(line), float(amplitude)),
        phase=np.concatenate(phase)[order] % (2 * np.pi),
        sections=sections,
        periods=periods,
        experiments=experiments,
        input_names=names,
    )


def paper_design(
    sections: int = 32,
    periods: int = 64,
    f_max: Number = 10.0,
    amplitude: Number = 0.01,
    seed: int = 0,
    *,
    experiments: int = 80,
    second_order: Literal["ignore", "avoid"] = "avoid",
) -> Design:
    """The design of Ankarali & Cowan, Sec. VI-C: 620 frequencies in 80 random subsets.

    The same as `multisine` with four times the experiments that it needs, without multiples of
    1/2. The paper's rules leave room to choose; by default the subsets are also such that
    second-order products miss their own lines, which at the paper's amplitude divides the largest
    error of H_0 by 15 on kinematic sections (`benchmarks/second_order.py`).

    **Raises:** `DefinitionError` as `multisine`.
    """
    return multisine(
        sections, periods, f_max, amplitude, seed,
        experiments=experiments, second_order=second_order,
    )  # fmt: skip


def single_cosine(
    f: Number | Numbers,
    sections: int = 32,
    periods: int = 64,
    amplitude: Number = 0.01,
    phase: Number = 0.0,
    *,
    half_integers: Literal["error", "two-phase"] = "error",
    inputs: int | str | Sequence[str] = 1,
) -> Design:
    """One cosine per experiment (Sec. V-A), at the frequency or each of the frequencies `f`.

    **Arguments:** as for `multisine`; `f` in cycles per period, a multiple of 1/periods;
    `phase` in rad. With several inputs each frequency is applied to one after the other.
    A multiple of 1/2 is an error, or with `half_integers="two-phase"` makes two experiments.

    **Raises:** `DefinitionError` as `Design.check`.
    """
    names = input_names(inputs)
    if half_integers not in ("error", "two-phase"):
        raise DefinitionError(
            f"half_integers must be 'error' or 'two-phase', not {half_integers!r}."
        )
    lines = to_lines(np.atleast_1d(np.asarray(f, float)), periods)
    twice = needs_two_phases(lines, periods, sections) & (half_integers == "two-phase")
    repeats = np.where(twice, 2, 1)
    each = np.repeat(lines, repeats) / periods
    quarter = np.concatenate([np.arange(r) * np.pi / 2 for r in repeats])
    return Design.from_lines(
        [[x] for _ in names for x in each],
        amplitude,
        [[phase + x] for _ in names for x in quarter],
        sections=sections,
        periods=periods,
        channels=[[i] for i in range(len(names)) for _ in each],
        inputs=names,
    )
