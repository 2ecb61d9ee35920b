"""Multisines that measure all frequencies of a band (`multisine`), and the design of the paper
(`paper_design`).

Both divide the lines of a band among experiments (`partition.py`), give them random phases, and
return a `Design`. A *line* is the integer j of a frequency j / P in cycles per period. If a
frequency is missing, look at `_lines`; if the number of experiments is wrong, at `_number`; if
inputs cannot be told apart, at `_orthogonal`. A further choice of lines or division is a word in
its type, a case in the function that uses it, and a rule in `_check_choices`. Random numbers must
be drawn in the same order as now: otherwise a seed gives another design than before.
"""

from collections.abc import Callable
from typing import Literal

import numpy as np

from ..._core.boundary import kinds
from ..._core.boundary.checked import checked
from ..._core.boundary.kinds import (
    ExperimentCount,
    NonNegative,
    PeriodCount,
    SectionCount,
    Seed,
)
from ...errors import DefinitionError
from . import partition
from .design import OFF_LINE, Design, InputNames, check_window, input_names, ordered
from .partition import (
    assign,
    avoid_second_order,
    fewest_experiments,
    is_real,
    needs_two_phases,
)


Band = tuple[NonNegative, NonNegative]
Lines = Literal["all", "odd", "two-phase"]
Division = Literal["random", "sum-free", "disjoint", "orthogonal"]


@checked
def multisine(
    n_sections: SectionCount = 32,
    periods: PeriodCount = 64,
    frequencies: Band | None = None,
    amplitude: kinds.Positive | Callable[[np.ndarray], np.ndarray] = 0.01,
    seed: Seed = 0,
    *,
    lines: Lines = "all",
    division: Division = "random",
    experiments: ExperimentCount | None = None,
    inputs: InputNames = 1,
) -> Design:
    """Return a design of multisines that measure every frequency `j / periods` in a band.

    The frequencies are divided at random among the experiments, under the rules of Sec. V-B
    (see `Design.check`), in sets whose sizes differ by at most one. For N = 32, P = 64 and
    frequencies up to 10 the 620 frequencies need 20 experiments, the exact minimum; the paper takes
    80. `design.optimize_phases()` gives the signals low crest factors.

    **Arguments:**

    - `n_sections`: N. Default: 32. `periods`: P, the periods in one window; the resolution is 1/P.
      Default: 64.
    - `frequencies`: the lowest and the highest frequency in cycles per period, both included.
      Default: 0 to 10 as in the paper, or to N/2 if that is less.
    - `amplitude`: amplitude of each cosine, or a function that returns it for an array of f.
      `Design.scaled` sets the rms value of the signals. Default: 0.01.
    - `seed`: seed of the phases and of the division. Default: 0.
    - `lines`: the excited frequencies. `"all"` are all but multiples of 1/2, as in the paper.
      `"odd"` are those with odd j (P must be even). Distortion of even order, which dominates at
      small amplitudes, then falls between the excited frequencies. This halves the number of
      frequencies, and reduces the error by a factor of 10 to 100. `"two-phase"` adds the multiples
      of 1/2, each in two experiments with phases 90 degrees apart (0 and N/2 in one). Default:
      "all".
    - `division`: the division of frequencies among experiments. `"random"` has no further rule.
      `"sum-free"` keeps the products f_i + f_j and f_i - f_j of an experiment, where quadratic
      distortion falls, off its own frequencies; this needs many experiments with few frequencies
      each, for example 80 instead of 20. With `"random"` and `"sum-free"`, an experiment excites a
      single input. `"disjoint"` excites all inputs, on different frequencies. `"orthogonal"`
      excites all inputs on all frequencies, with phases such that nu experiments separate nu
      inputs, with nu times the power per frequency. Default: "random".
    - `experiments`: number of experiments for all inputs together. With more than the fewest,
      signals are weaker, have fewer cosines, and cause less distortion. With the fewest for all
      frequencies, every second-order product falls on a frequency of the same experiment, so
      amplitudes must be small. Default: the fewest possible.
    - `inputs`: number or names of the inputs. Default: 1.

    **Returns:** a `Design`: `frequency` (K,) of each cosine in cycles per period, `amplitude` (K,)
    in units of the input, and `signals()`, the samples (S, n, nu) for hardware.

    **Raises:** `DefinitionError` for a band that holds no frequency or exceeds N/2, for too few
    experiments (the message has the minimum), and for choices that exclude each other.

    **Example:**

    ```python
    design = hj.multisine(8, 16, (0, 3), amplitude=0.001, lines="odd")
    print(design.cycles, design.crest_factors())
    ```

    **After:** `hj.run_experiments`, `hj.experiments.simulate_experiments`,
    `design.optimize_phases()`, `hj.optimal_design`.
    """
    names = input_names(inputs)
    check_window(n_sections, periods)
    _check_choices(lines, division, periods)
    j = _lines(
        n_sections, periods, frequencies or (0.0, min(10.0, n_sections / 2)), lines
    )
    # A frequency that needs two phases is listed twice; `second` marks the repetition.
    j = np.sort(np.concatenate([j, j[needs_two_phases(j, periods, n_sections)]]))
    second = np.concatenate([[False], j[1:] == j[:-1]])
    nu = len(names)
    rng = np.random.default_rng(seed)
    total = _number(j, periods, nu, experiments)
    shares = [total // nu + (i < total % nu) for i in range(nu)]
    sets = []
    phases = []
    for i in range(nu):
        sets.append(assign(j, periods, shares[i], rng))
        if division == "sum-free":
            sets[i] = avoid_second_order(sets[i], j, periods, rng)
        phase = rng.uniform(0, 2 * np.pi, len(j))
        phase = np.where(second, np.roll(phase, 1) + np.pi / 2, phase)
        phases.append(np.where(is_real(j, periods, n_sections), 0.0, phase))
    parts = [sum(shares[:i]) + x for i, x in enumerate(sets)]
    experiment = np.concatenate(parts)
    line = np.tile(j, nu)
    channel = np.repeat(np.arange(nu), len(j))
    phase = np.concatenate(phases)
    if division == "disjoint" and nu > 1:
        experiment = assign(line, periods, total, rng)
    elif division == "orthogonal" and nu > 1:
        experiment, line, channel, phase = _orthogonal(sets[0], j, np.array(phases))
    sizes = _amplitudes(amplitude, line / periods)
    cosines = experiment, line, channel, sizes, phase % (2 * np.pi)
    return ordered(cosines, n_sections, periods, int(experiment.max()) + 1, names)


def _amplitudes(
    amplitude: float | Callable[[np.ndarray], np.ndarray], frequencies: np.ndarray
) -> np.ndarray:
    """Return the amplitude of each cosine.

    **Raises:** `DefinitionError` if the function returns something else than real numbers.
    """
    sizes = np.asarray(amplitude(frequencies) if callable(amplitude) else amplitude)
    if sizes.dtype.kind not in "fiu":
        raise DefinitionError(
            f"`amplitude` must return real numbers, not {sizes.dtype}."
        )
    if sizes.shape not in ((), frequencies.shape):
        raise DefinitionError(
            f"`amplitude` must return a number for each of {len(frequencies)} frequencies, not an "
            f"array of the shape {sizes.shape}."
        )
    return np.full(frequencies.shape, sizes, float)


def _number(j: np.ndarray, periods: int, nu: int, experiments: int | None) -> int:
    """Return the number of experiments for all inputs together. Default: the fewest possible."""
    fewest = fewest_experiments(j, periods) * nu
    if experiments is None:
        return fewest
    if not fewest <= experiments <= len(j) * nu:
        raise DefinitionError(
            f"`experiments` must be {fewest} to {len(j) * nu} for these lines, not {experiments}."
        )
    return experiments


def _check_choices(lines, division, periods) -> None:
    if lines == "two-phase" and division not in ("random", "sum-free"):
        raise DefinitionError(
            "lines='two-phase' goes with division='random' or 'sum-free' only."
        )
    if lines == "odd" and periods % 2:
        raise DefinitionError(
            f"lines='odd' needs an even number of periods, not {periods}."
        )


def _lines(n_sections: int, periods: int, band: Band, lines: Lines) -> np.ndarray:
    """Return the lines j of a band."""
    f_min, f_max = band
    if not f_min <= f_max <= n_sections / 2:
        raise DefinitionError(
            f"`frequencies` {band} must increase in [0, N/2 = {n_sections / 2}]."
        )
    low = int(np.ceil(f_min * periods - OFF_LINE))
    high = int(np.floor(f_max * periods + OFF_LINE))
    j = np.arange(low, high + 1)
    if lines != "two-phase":
        j = j[~partition.is_half_integer(j, periods)]
    if lines == "odd":
        j = j[j % 2 == 1]
    if len(j) == 0:
        raise DefinitionError(
            f"lines='{lines}' excites nothing in `frequencies` {band}: take more periods or "
            "a wider band."
        )
    return j


def _orthogonal(division, j, phase):
    """Return every set of lines in nu experiments. From one of these to the next, phases of the
    inputs change by multiples of 2 pi / nu, which separates the responses to the inputs.

    **Arguments:** `division` (K,): the set of each line j (K,). `phase` (nu, K): of each input.

    **Returns:** experiment, line, input and phase of each of nu * nu * K cosines.
    """
    nu, K = phase.shape
    block, k, channel = np.indices((nu, K, nu)).reshape(3, -1)
    turned = phase[channel, k] + 2 * np.pi / nu * block * channel
    return block * (division.max() + 1) + division[k], j[k], channel, turned


@checked
def paper_design(
    n_sections: SectionCount = 32,
    periods: PeriodCount = 64,
    seed: Seed = 0,
    *,
    division: Literal["random", "sum-free"] = "sum-free",
    experiments: ExperimentCount = 80,
) -> Design:
    """Return the design of Ankarali & Cowan, Sec. VI-C: 620 frequencies in 80 random subsets.

    The design is a `multisine` without multiples of 1/2, in four times as many
    experiments as necessary. The paper's rules do not determine the subsets. By default
    they are also sum-free: the second-order products of a subset do not fall on its own
    lines. This reduces the largest error of H_0 at the paper's amplitude and on
    kinematic sections (24 seeds, `benchmarks/second_order.py`). Its median over the
    seeds is divided by 6 for yM and by 18 for vM, its maximum by 21 and 40.

    **Arguments:**

    - `n_sections`: N. Default: 32. `periods`: P, the periods in one window. Default: 64.
    - `seed`: seed of the phases and of the division. Default: 0.
    - `division`: the division of frequencies among experiments, as in `multisine`. Default:
      "sum-free".
    - `experiments`: number of experiments. Default: 80.

    **Raises:** `DefinitionError` in the cases of `multisine`.

    **Example:**

    ```python
    paper = hj.experiments.paper_design()
    print(paper)
    ```

    **After:** `hj.run_experiments`.
    """
    return multisine(
        n_sections,
        periods,
        (0.0, 10.0),
        seed=seed,
        division=division,
        experiments=experiments,
    )
