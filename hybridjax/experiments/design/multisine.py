"""The usual designs: multisines over a band, the paper's, single cosines."""

from collections.abc import Callable, Sequence
from typing import Literal

import numpy as np

from ...errors import DefinitionError
from .crest import optimize_phases
from .design import Design, Number, Numbers, input_names, to_lines
from .partition import (
    assign,
    assign_apart,
    avoid_second_order,
    fewest_experiments,
    is_half_integer,
    is_real,
    needs_two_phases,
    two_adic,
)


def multisine(
    n_sections: int = 32,
    periods: int = 64,
    f_max: Number | None = None,
    amplitude: Number | Callable = 0.01,
    seed: int = 0,
    *,
    f_min: Number = 0.0,
    lines: Literal["all", "odd", "2-adic"] = "all",
    experiments: int | None = None,
    highest_harmonic: int | None = None,
    phases: Literal["random", "optimized"] = "random",
    half_integers: Literal["skip", "two-phase"] = "skip",
    second_order: Literal["ignore", "avoid"] = "ignore",
    inputs: int | str | Sequence[str] = 1,
    excite: Literal["alone", "disjoint", "orthogonal"] = "alone",
) -> Design:
    """Multisines that measure every frequency `j / periods` in `[f_min, f_max]`.

    The frequencies are divided at random among the experiments, under the rules of Sec. V-B
    (see `Design.check`), in sets whose sizes differ by one at most. For N = 32, P = 64 and
    f_max = 10 the 620 frequencies need 20 experiments, the exact minimum; the paper takes 80.

    **Arguments:**

    - `n_sections`: N. `periods`: P, the periods in one window; the resolution is 1/P.
    - `f_max`, `f_min`: the band in cycles per period, both ends included; by default up to 10 as in
      the paper, or to N/2 where that is less.
    - `amplitude`: of each cosine, or a function of an array of f that gives it. `Design.scaled`
      sets the rms value of the signals. `seed`: of the phases and the division.
    - `lines`: `"odd"` takes odd j only (P must be even). A distortion of even order then answers
      between the lines and spoils none; at small amplitudes, where it is the largest, this costs
      half of the lines and gains one to two digits. `"2-adic"` takes all j, in sets that have the
      same power of two, for which the same holds; these are many experiments (100 for P = 64).
    - `experiments`: by default the fewest possible. Any greater number gives weaker signals
      with fewer cosines each, and so less distortion; with the fewest of all lines, every
      second-order product falls on a line of the same experiment, so amplitudes must be small.
    - `highest_harmonic`: M, beyond which harmonics are taken as zero. Then 2 M + 1 experiments may
      do instead of 20; what they assume is said by `predict_leakage`, if a model is at hand. The
      estimate needs to know: `estimate_htf(data, highest=M)`.
    - `phases`: `"optimized"` for a low crest factor (`optimize_phases`).
    - `half_integers`: `"skip"` leaves multiples of 1/2 out, as the paper does; `"two-phase"`
      measures them in two experiments each, with phases 90 degrees apart (0 and N/2 in one).
    - `second_order`: `"avoid"` divides the frequencies so that the products f_i + f_j and
      f_i - f_j of one experiment, where a quadratic distortion answers, miss its own lines.
      This needs many experiments with few lines each, e.g. 80 where 20 suffice.
    - `inputs`: their number or names; `experiments` is the number for all inputs together.
    - `excite`: with several inputs, `"alone"` excites one of them per experiment, `"disjoint"` all
      of them on different lines, and `"orthogonal"` all of them on all lines, with phases that turn
      from one experiment to the next, so that nu experiments tell nu inputs apart at nu times the
      power per line.

    **Raises:** `DefinitionError` for a band that holds no frequency or exceeds N/2, for too
    few experiments (the message says the minimum), and for choices that exclude each other.
    """
    names = input_names(inputs)
    _check_choices(
        half_integers, second_order, lines, phases, excite, periods, highest_harmonic, experiments
    )
    f_max = min(10.0, n_sections / 2) if f_max is None else f_max
    j = _band(n_sections, periods, f_min, f_max, half_integers, lines)
    # A frequency that needs two phases stands twice; `second` marks its second appearance.
    j = np.sort(np.concatenate([j, j[needs_two_phases(j, periods, n_sections)]]))
    second = np.concatenate([[False], j[1:] == j[:-1]])
    nu = len(names)
    rng = np.random.default_rng(seed)
    if lines == "2-adic":
        division = _by_power(j, periods, rng)
        experiment = [i * (division.max() + 1) + division for i in range(nu)]
    elif highest_harmonic is not None:
        each = None if experiments is None else experiments // nu
        division = [
            assign_apart(j, periods, n_sections, highest_harmonic, rng, each) for _ in range(nu)
        ]
        experiment = [i * (division[0].max() + 1) + division[i] for i in range(nu)]
    else:
        fewest = fewest_experiments(j, periods) * nu
        experiments = fewest if experiments is None else experiments
        if experiments < fewest:
            raise DefinitionError(
                f"{experiments} experiments are too few: these {len(np.unique(j))} frequencies "
                f"need at least {fewest}" + (f" for {nu} inputs." if nu > 1 else ".")
            )
        if experiments > len(j) * nu:
            raise DefinitionError(
                f"{experiments} experiments are more than the {len(j) * nu} cosines "
                "that there are to distribute."
            )
        experiment = None
    shares = [(experiments or 0) // nu + (i < (experiments or 0) % nu) for i in range(nu)]
    phase = []
    found = [] if experiment is None else experiment
    for i in range(nu):
        if experiment is None:
            division = assign(j, periods, shares[i], rng)
            if second_order == "avoid":
                division = avoid_second_order(division, j, periods, rng)
            found.append(sum(shares[:i]) + division)
        random = rng.uniform(0, 2 * np.pi, len(j))
        random = np.where(second, np.roll(random, 1) + np.pi / 2, random)
        phase.append(np.where(is_real(j, periods, n_sections), 0.0, random))
    experiment, phase = np.concatenate(found), np.concatenate(phase)
    line, channel = np.tile(j, nu), np.repeat(np.arange(nu), len(j))
    if excite == "disjoint" and nu > 1:
        experiment = assign(line, periods, experiments, rng)
    elif excite == "orthogonal" and nu > 1:
        experiment, line, channel, phase = _orthogonal(found[0], j, phase.reshape(nu, -1))
    order = np.lexsort((channel, line, experiment))
    line = line[order]
    size = amplitude(line / periods) if callable(amplitude) else float(amplitude)
    design = Design(
        experiment=experiment[order],
        line=line,
        channel=channel[order],
        amplitude=np.array(np.broadcast_to(np.asarray(size, float), line.shape)),
        phase=phase[order] % (2 * np.pi),
        n_sections=n_sections,
        periods=periods,
        experiments=int(experiment.max()) + 1,
        input_names=names,
        highest_harmonic=highest_harmonic,
    )
    return optimize_phases(design, seed) if phases == "optimized" else design


def _check_choices(
    half_integers, second_order, lines, phases, excite, periods, highest_harmonic, experiments
) -> None:
    choices = {
        "half_integers": (half_integers, ("skip", "two-phase")),
        "second_order": (second_order, ("ignore", "avoid")),
        "lines": (lines, ("all", "odd", "2-adic")),
        "phases": (phases, ("random", "optimized")),
        "excite": (excite, ("alone", "disjoint", "orthogonal")),
    }
    for name, (given, known) in choices.items():
        if given not in known:
            shown = ", ".join(map(repr, known[:-1])) + f" or {known[-1]!r}"
            raise DefinitionError(f"{name} must be {shown}, not {given!r}.")
    special = lines == "2-adic" or highest_harmonic is not None or excite != "alone"
    if special and (second_order == "avoid" or half_integers == "two-phase"):
        raise DefinitionError(
            "second_order='avoid' and half_integers='two-phase' do not go together with "
            "lines='2-adic', highest_harmonic or several inputs at once."
        )
    if (lines == "2-adic") + (highest_harmonic is not None) + (excite != "alone") > 1:
        raise DefinitionError(
            "lines='2-adic', highest_harmonic and several inputs at once exclude each other."
        )
    if lines == "2-adic" and experiments is not None:
        raise DefinitionError(
            "leave out `experiments` with lines='2-adic': their number follows from the lines."
        )
    if lines != "all" and periods % 2:
        raise DefinitionError(
            f"lines={lines!r} needs an even number of periods, not {periods}: else the even-order "
            "products fall on the lines themselves."
        )
    if highest_harmonic is not None and highest_harmonic < 0:
        raise DefinitionError(f"highest_harmonic must not be negative, but is {highest_harmonic}.")


def _band(n_sections: int, periods: int, f_min, f_max, half_integers: str, lines: str):
    """The lines j of a band."""
    if n_sections < 1 or periods < 1:
        raise DefinitionError(
            f"sections ({n_sections}) and periods ({periods}) must be at least 1."
        )
    if not 0 <= f_min <= f_max <= n_sections / 2:
        raise DefinitionError(
            f"the band from f_min = {f_min} to f_max = {f_max} must lie in [0, N/2 = "
            f"{n_sections / 2}] cycles per period."
        )
    low, high = int(np.ceil(f_min * periods - 1e-9)), int(np.floor(f_max * periods + 1e-9))
    j = np.arange(low, high + 1)
    if half_integers == "skip":
        j = j[~is_half_integer(j, periods)]
    if lines == "odd":
        j = j[j % 2 == 1]
    if len(j) == 0:
        raise DefinitionError(
            f"no multiple of 1/{periods} other than those of 1/2 lies between f_min = {f_min} "
            f"and f_max = {f_max}: take more periods or a wider band."
        )
    return j


def _by_power(j, periods: int, rng: np.random.Generator):
    """Experiments whose lines have the same power of two."""
    power, experiment, first = two_adic(j, periods), np.empty(len(j), int), 0
    for p in np.unique(power):
        here = power == p
        count = fewest_experiments(j[here], periods)
        experiment[here] = first + assign(j[here], periods, count, rng)
        first += count
    return experiment


def _orthogonal(division, j, phase):
    """Every set of lines in nu experiments, with phases that turn from one to the next."""
    nu, K = phase.shape
    count = division.max() + 1
    _, first, _ = np.meshgrid(np.arange(nu), division, np.arange(nu), indexing="ij")
    block, _, channel = np.meshgrid(np.arange(nu), np.arange(K), np.arange(nu), indexing="ij")
    turned = phase.T[None] + 2 * np.pi / nu * block * channel
    experiment, line = block * count + first, np.broadcast_to(j[None, :, None], (nu, K, nu))
    return experiment.ravel(), line.ravel(), channel.ravel(), turned.ravel()


def paper_design(
    n_sections: int = 32,
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
        n_sections, periods, f_max, amplitude, seed,
        experiments=experiments, second_order=second_order,
    )  # fmt: skip


def single_cosine(
    f: Number | Numbers,
    n_sections: int = 32,
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
    twice = needs_two_phases(lines, periods, n_sections) & (half_integers == "two-phase")
    repeats = np.where(twice, 2, 1)
    each = np.repeat(lines, repeats) / periods
    quarter = np.concatenate([np.arange(r) * np.pi / 2 for r in repeats])
    return Design.from_lines(
        [[x] for _ in names for x in each],
        amplitude,
        [[phase + x] for _ in names for x in quarter],
        n_sections=n_sections,
        periods=periods,
        channels=[[i] for i in range(len(names)) for _ in each],
        inputs=names,
    )
