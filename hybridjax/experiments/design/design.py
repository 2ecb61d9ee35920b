"""`Design`: which cosines, with which amplitudes and phases, in which experiment.

`multisine`, `paper_design` and `hj.designs` make designs, and `run_experiments` and `estimate_htf`
use them. A *line* is the integer j of a frequency j / P in cycles per period, with P the number of
periods of an experiment.

`check` has the rules under which HTFs can be estimated, and `_check_...` one rule each: look there
if a design is refused without need. They follow from the theory and are not settings. The
arithmetic of lines is in `partition.py`. If signals are wrong, look at `signals`; if their CSV file
is wrong, at `tables.py`.
"""

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import Annotated

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from ..._core import limits
from ..._core.arguments import Numbers, names, require_equal
from ..._core.boundary import kinds
from ..._core.boundary.checked import checked
from ..._core.boundary.containers import Names
from ..._core.boundary.kinds import (
    Count,
    Index,
    PeriodCount,
    SectionCount,
    SignalNames,
    Vector,
)
from ..._core.boundary.values import Integers
from ..._core.showable import Showable
from ...errors import DefinitionError
from .crest import low_peak_phases
from .partition import SINGULAR, check_sharing, is_real, needs_two_phases, regular
from .tables import write_table


InputNames = Count | SignalNames
"""The number of inputs, or their names."""

# Cycles that are discarded by default after a start on the limit cycle, as in the paper. Fewer: the
# transient biases estimates. More: strides are wasted.
DISCARD = 20
# Frequencies and edges of a band may differ from multiples of 1/P by this part of 1/P. Smaller:
# rounding errors of f are refused. Larger: a wrong frequency is moved without an error.
OFF_LINE = 1e-6


@checked
class Design(Showable, eqx.Module):
    """Sums of cosines for a number of experiments on a system with N sections (eq. 15).

    At section n, counted from its start, an experiment applies `u[n] = sum_k a_k cos(2 pi j_k n /
    (N P) + phi_k)`, a sum over its own cosines k. Their frequencies are `f_k = j_k / P`, in cycles
    per period of the limit cycle, and all signals repeat after P periods. The amplitude is `a` (the
    paper divides it by pi). The constructor enforces the rules of Sec. V (see `check`). The
    functions `multisine` and `paper_design` make the usual designs, `Design.from_lines` any other.

    **Fields:** the first five are flat NumPy arrays, with one entry for each cosine of each
    experiment.

    - `experiment`: the experiment it belongs to, 0..experiments-1, ascending.
    - `line`: j, so that f = j / periods.
    - `channel`: index of the input it is applied to.
    - `amplitude`: in units of the input. `phase`: in rad, at section 0 of the experiment.
    - `n_sections`: N. `periods`: P. `experiments`: their number S. `inputs`: names of the inputs.

    **Example:**

    ```python
    lines = [[0.25, 0.375], [0.75]]
    design = hj.experiments.Design.from_lines(lines, 0.001, n_sections=8, periods=16)
    print(design.signals().shape)
    ```

    **Before:** `hj.multisine` or `hj.optimal_design`. **After:** `hj.run_experiments`.
    """

    experiment: Int[np.ndarray, " K"]
    line: Int[np.ndarray, " K"]
    channel: Int[np.ndarray, " K"]
    amplitude: Float[np.ndarray, " K"]
    phase: Float[np.ndarray, " K"]
    n_sections: SectionCount = eqx.field(static=True)
    periods: PeriodCount = eqx.field(static=True)
    experiments: kinds.ExperimentCount = eqx.field(static=True)
    inputs: Annotated[tuple[str, ...], Names()] = eqx.field(static=True, default=("u",))

    def __check_init__(self):
        self.check()

    @classmethod
    def from_lines(
        cls,
        frequencies: Sequence[Vector],
        amplitudes: float | Sequence[Vector] = 0.01,
        phases: float | Sequence[Vector] = 0.0,
        *,
        n_sections: SectionCount = 32,
        periods: PeriodCount = 64,
        channels: Index | Sequence[Annotated[Numbers, Integers("n")]] = 0,
        inputs: InputNames = 1,
    ) -> "Design":
        """Return a design of given cosines.

        **Arguments:**

        - `frequencies`: for each experiment, its frequencies in cycles per period.
        - `amplitudes`, `phases` (rad), `channels` (index of the input): one number for all
          cosines, or for each experiment one number per frequency.
        - `n_sections`: N. `periods`: P; every frequency must be a multiple of 1/P.
        - `inputs`: the number of inputs, or their names.

        **Raises:** `DefinitionError` in the cases of `check`, and for lists that do not fit
        together.
        """
        sizes = [np.size(f) for f in frequencies]

        def flat(name, values, dtype):
            if np.isscalar(values):
                return np.full(sum(sizes), values, dtype)
            if [np.size(v) for v in values] != sizes:
                raise DefinitionError(
                    f"`{name}` must be one number, or as many as `frequencies`."
                )
            return np.concatenate([[], *map(np.ravel, values)]).astype(dtype)

        cosines = [
            np.repeat(np.arange(len(sizes)), sizes),
            to_lines(flat("frequencies", frequencies, float), periods),
            flat("channels", channels, int),
            flat("amplitudes", amplitudes, float),
            flat("phases", phases, float),
        ]
        return ordered(cosines, n_sections, periods, len(sizes), input_names(inputs))

    def check(self) -> None:
        """Check the rules under which the HTFs follow from the experiments uniquely (Sec. V).

        - every f lies in [0, N/2], amplitudes are positive, phases finite;
        - in one experiment no two frequencies differ by, or add up to, an integer;
        - a frequency that excites several inputs together does so in at least as many experiments
          as inputs, with phases that separate the responses;
        - a frequency on a multiple of 1/2 (eq. 16) is excited in two experiments at least, with
          different phases; 0 and N/2 need only one phase, but not one with cos(phase) = 0.

        **Raises:** `DefinitionError` that names the experiment and the frequencies.
        """
        check_window(self.n_sections, self.periods)
        self._check_cosines()
        self._check_sharing()
        self._check_together()
        self._check_phases()

    def _check_cosines(self) -> None:
        """**Raises:** an error for entries that are out of range, each seen alone, and for
        experiments that are out of order or have no cosine."""
        for name in ("line", "channel", "amplitude", "phase"):
            shapes = self.experiment.shape, getattr(self, name).shape
            require_equal(f"`experiment` and `{name}`", "shapes", *shapes)
        if not np.array_equal(
            np.unique(self.experiment), np.arange(max(1, self.experiments))
        ):
            raise DefinitionError(
                "every experiment needs a frequency: `frequencies` skips some."
            )
        # (`signals` finds the cosines of a part of the experiments by their places.)
        if np.any(np.diff(self.experiment) < 0):
            raise DefinitionError(
                "`experiment` must ascend: `Design.from_lines` puts cosines in order."
            )
        N = self.n_sections
        self._refuse(
            (self.line < 0) | (2 * self.line > N * self.periods),
            f"lies outside [0, N/2 = {N / 2}]",
        )
        good = np.isfinite(self.amplitude) & (self.amplitude > 0)
        self._refuse(~good, "has an amplitude that is not a positive number")
        self._refuse(~np.isfinite(self.phase), "has a phase that is not finite")
        nu = len(self.inputs)
        outside = (self.channel < 0) | (self.channel >= nu)
        self._refuse(outside, f"is applied to an input that is not one of the {nu}")

    def _check_sharing(self) -> None:
        """**Raises:** an error for two cosines of one experiment whose responses fall on the same
        frequencies. Several inputs may share a line, but none may have it twice."""
        cosine = np.stack([self.experiment, self.line, self.channel], axis=1)
        _, place, count = np.unique(
            cosine, axis=0, return_inverse=True, return_counts=True
        )
        twice = count[place.ravel()] > 1
        check_sharing(self.experiment[twice], self.line[twice], self.periods)
        line = np.unique(cosine[:, :2], axis=0)
        check_sharing(line[:, 0], line[:, 1], self.periods)

    def _check_phases(self) -> None:
        """**Raises:** an error for frequencies on multiples of 1/2 without the phases they need."""
        P = self.periods
        N = self.n_sections
        nu = len(self.inputs)
        u = self.amplitude * np.exp(1j * self.phase)
        _, group = np.unique(self.line * nu + self.channel, return_inverse=True)
        # The sum of the squares has the modulus of the power if all phases are equal modulo pi.
        power = np.bincount(group, np.abs(u) ** 2)
        square = u**2
        re = np.bincount(group, np.real(square))
        im = np.bincount(group, np.imag(square))
        has_one_phase = np.hypot(re, im) / power > 1 - SINGULAR
        self._refuse(
            needs_two_phases(self.line, P, N) & has_one_phase[group],
            "lies on a multiple of 1/2, where one phase does not suffice: excite it in two "
            "experiments with phases 90 degrees apart (multisine(lines='two-phase') does so), or "
            "leave it out",
        )
        self._refuse(
            is_real(self.line, P, N) & (np.cos(self.phase) ** 2 < SINGULAR),
            "is zero at every section with this phase: give it the phase 0",
        )

    def _check_together(self) -> None:
        """**Raises:** an error if responses to several inputs cannot be separated."""
        line_of_experiment = np.stack([self.experiment, self.line], axis=1)
        if len(np.unique(line_of_experiment, axis=0)) == len(self.line):
            return
        lines, place = np.unique(self.line, return_inverse=True)
        U = np.zeros((len(lines), self.experiments, len(self.inputs)), complex)
        U[place, self.experiment, self.channel] = self.amplitude * np.exp(
            1j * self.phase
        )
        inputs_at_once = np.sum(np.abs(U) > 0, axis=2).max(axis=1)
        together = inputs_at_once > 1
        gram = np.einsum("kei,kej->kij", U.conj(), U)
        self._refuse(
            (together & ~regular(gram))[place],
            "excites several inputs together, and its experiments cannot tell them apart: excite "
            "it in as many experiments as inputs, with turned phases "
            "(multisine(division='orthogonal'))",
        )

    def _refuse(self, wrong: np.ndarray, reason: str) -> None:
        if wrong.any():
            first = int(np.argmax(wrong))
            f = self.line[first] / self.periods
            raise DefinitionError(
                f"experiment {self.experiment[first]}: f = {f:.10g} {reason}."
            )

    @property
    def frequency(self) -> Float[np.ndarray, " K"]:
        """Frequency of each cosine, cycles per period."""
        return self.line / self.periods

    @property
    def frequencies(self) -> Float[np.ndarray, " F"]:
        """All frequencies that the design measures, ascending, each once."""
        return np.unique(self.line) / self.periods

    def signals(
        self, cycles: PeriodCount | None = None, experiments: slice | None = None
    ) -> Float[np.ndarray, "S n nu"]:
        """Return the signals of all experiments, n = cycles * N samples long. Default: P cycles.

        The signals repeat after P periods, so that the last P periods contain the lines of the
        design for any number of cycles. If `cycles` is not a multiple of P, the phases of these
        lines are shifted; estimates therefore divide by the spectrum of the input in the same
        window.

        **Arguments:** `experiments`: consecutive ones, e.g. `slice(0, 100)`. Default: all.
        """
        cycles = self.periods if cycles is None else cycles
        first, last, step = (experiments or slice(None)).indices(self.experiments)
        if step != 1 or last <= first:
            raise DefinitionError(
                "`experiments` must be a slice of consecutive experiments, such as slice(0, 10), "
                f"not {experiments}."
            )
        k = slice(*np.searchsorted(self.experiment, (first, last)))
        experiment = self.experiment[k]
        line = self.line[k]
        channel = self.channel[k]
        length = self.n_sections * self.periods
        frequencies = length // 2 + 1
        shape = (last - first, frequencies, len(self.inputs))
        spectrum = np.zeros(shape, complex)
        phasor = self.amplitude[k] * np.exp(1j * self.phase[k])
        value = 0.5 * length * phasor
        value = np.where(
            is_real(line, self.periods, self.n_sections), 2 * value.real, value
        )
        spectrum[experiment - first, line, channel] = value
        one = np.fft.irfft(spectrum, n=length, axis=1)
        return one[:, np.arange(cycles * self.n_sections) % length]

    def write(
        self,
        path: kinds.FilePath,
        *,
        cycles: PeriodCount | None = None,
        period: kinds.Positive | None = None,
        rate: kinds.Positive | None = None,
    ) -> None:
        """Write the signals of all experiments to a CSV file, for hardware that plays them.

        - Without `period`, for hardware that triggers on phase: a row for each section, with the
          columns `experiment`, `cycle`, `section`, `phase` and the inputs, which are held until the
          next section (zero-order hold).
        - With `period` and `rate`, for other hardware: a row for each sample, with `experiment`,
          `time` and the inputs.

        **Arguments:** `cycles`: cycles of each experiment. Default: its periods P. `period`: period
        of the cycle in seconds. `rate`: samples per second.

        **Raises:** `DefinitionError` for a period without a rate, a rate with less than one sample
        for each section, and a file that cannot be written.
        """
        u = self.signals(cycles)
        write_table(Path(path), self.inputs, u, self.n_sections, period, rate)

    def scaled(self, rms: kinds.Positive) -> "Design":
        """Return the design with amplitudes multiplied so that every signal has this rms value.

        Each signal (an input in one experiment) is scaled separately; the ratios of its amplitudes
        do not change.
        """
        now = np.sqrt(np.mean(self.signals() ** 2, axis=1))[
            self.experiment, self.channel
        ]
        return eqx.tree_at(lambda d: d.amplitude, self, self.amplitude * rms / now)

    def realizations(self, count: Count, seed: kinds.Seed = 0) -> "Design":
        """Return the design `count` times over, each time with new random phases.

        The sample variance of their responses includes noise and nonlinear distortion, so it gives
        the variance of an estimate. In all experiments of a realization, cosines of the same line
        and input are rotated by the same random angle, so that phase differences between
        experiments are kept.

        **Returns:** a design with `count` times the experiments, one realization after the other.
        """
        rng = np.random.default_rng(seed)
        pair = self.line * len(self.inputs) + self.channel
        pairs, place = np.unique(pair, return_inverse=True)
        angles = rng.uniform(0, 2 * np.pi, (count, len(pairs)))
        real = is_real(pairs // len(self.inputs), self.periods, self.n_sections)
        angles = np.where(real, np.pi * (angles > np.pi), angles)
        phase = (self.phase + angles[:, place]) % (2 * np.pi)
        shift = np.arange(count)[:, None] * self.experiments
        return self._times(count, phase, self.experiment + shift)

    def optimize_phases(self, seed: kinds.Seed = 0) -> "Design":
        r"""Return the design with phases that give each signal a low crest factor max |u| / rms(u).

        The peak is approached by norms $\sum |u|^p$ of growing p, minimized over the phases
        (Guillaume, Schoukens, Pintelon and Kollar, IEEE Trans. Instrum. Meas. 40, 1991). For 31
        lines this cuts the crest factor from 3.6 (random phases) to 2.15, so that the same peak
        carries 2.8 times the power. These phases are not random, so that the sample variance over
        realizations does not contain the distortion. Phases of lines that are measured in several
        experiments together (multiples of 1/2, orthogonal experiments) are kept.

        **Arguments:** `seed`: seed of the random phases at the start of the minimization.
        Default: 0.

        **Raises:** `DefinitionError` if there is no phase to choose.
        """
        return eqx.tree_at(lambda d: d.phase, self, low_peak_phases(self, seed))

    def with_negatives(self) -> "Design":
        """Return every experiment followed by the same with the sign changed.

        All even-order distortion cancels in `ExperimentData.odd_part`.
        """
        phase = np.stack([self.phase, (self.phase + np.pi) % (2 * np.pi)])
        return self._times(2, phase, 2 * self.experiment + np.array([[0], [1]]))

    def _times(self, count: int, phase, experiment) -> "Design":
        """Return the design with its cosines repeated `count` times, with the given phases and
        experiments."""
        same = [np.tile(x, count) for x in (self.line, self.channel, self.amplitude)]
        cosines = [experiment.ravel(), *same, phase.ravel()]
        experiments = count * self.experiments
        return ordered(cosines, self.n_sections, self.periods, experiments, self.inputs)

    def expected_variance(
        self, noise: kinds.NonNegative = 1.0, repeats: Count = 1
    ) -> Float[np.ndarray, "F nu"]:
        """Return the variance of every H_m at `frequencies` for white output noise of this std.

        `4 noise^2 / (N P repeats sum a^2)`, the sum over all experiments that measure the line;
        infinite for an input that lacks the line. At f = 0 and N/2, `2 a cos(phase)` stands for a.
        """
        lines, place = np.unique(self.line, return_inverse=True)
        power = np.zeros((len(lines), len(self.inputs)))
        real = is_real(self.line, self.periods, self.n_sections)
        factor = np.where(real, 2 * np.cos(self.phase), 1)
        np.add.at(power, (place, self.channel), (self.amplitude * factor) ** 2)
        samples = self.n_sections * self.periods * repeats
        with np.errstate(divide="ignore"):
            return 4 * noise**2 / (samples * power)

    def cycles(self, discard: Index = DISCARD) -> int:
        """Return the number of cycles of all experiments, with `discard` more cycles in each."""
        return self.experiments * (self.periods + discard)

    def crest_factors(self) -> Float[np.ndarray, " S"]:
        """Return max |u| / rms(u) of each experiment, the largest over its inputs."""
        u = self.signals()
        rms = np.sqrt(np.mean(u**2, axis=1))
        peak = np.abs(u).max(axis=1)
        return np.max(
            np.where(rms > 0, peak / np.where(rms > 0, rms, 1.0), 0.0), axis=1
        )

    def __repr__(self) -> str:
        f = self.frequencies
        sizes = np.bincount(self.experiment)
        crest = self.crest_factors()
        per = self.expected_variance()
        per = per[np.isfinite(per)]
        rows = [
            f"Design({_count(self.experiments, 'experiment')} of {self.periods} periods, "
            f"{self.n_sections} sections, inputs {', '.join(self.inputs)})",
            f"  frequencies  {len(f)}, {_span(f)} cycles per period{self._steps()}",
            f"  each         {_count(_span(sizes), 'cosine')} of amplitude {_span(self.amplitude)}"
            f", crest factor {_span(crest)}",
            f"  cost         {self.cycles(0)} cycles (plus discarded cycles)",
            f"  errors       standard error of H_m: {_span(np.sqrt(per))} times the output noise",
        ]
        return "\n".join(rows)

    def _steps(self) -> str:
        """The distance of which all distances between frequencies are multiples, for a `repr`."""
        distances = np.diff(np.unique(self.line))
        if not len(distances):
            return ""
        return f" in steps of {Fraction(int(np.gcd.reduce(distances)), self.periods)}"


def ordered(
    cosines: Sequence[np.ndarray],
    n_sections: int,
    periods: int,
    experiments: int,
    names: tuple,
) -> Design:
    """Return the design of cosines in any order: their experiments, lines, channels, amplitudes and
    phases."""
    order = np.lexsort([cosines[k] for k in (2, 1, 0)])
    experiment, line, channel, amplitude, phase = (x[order] for x in cosines)
    waves = experiment, line, channel, amplitude, phase
    return Design(*waves, n_sections, periods, experiments, names)


def _span(values: np.ndarray) -> str:
    low = f"{float(np.min(values)):.4g}"
    high = f"{float(np.max(values)):.4g}"
    return low if low == high else f"{low} to {high}"


def _count(number: int | str, noun: str) -> str:
    return f"{number} {noun}" if str(number) == "1" else f"{number} {noun}s"


def require_inputs(
    design: Design, other: str, n_sections: int, inputs: tuple[str, ...]
) -> None:
    """**Raises:** `DefinitionError` if sections or inputs differ from those of a system, or if the
    inputs have the same names in another order."""
    what = f"design and {other}"
    names = design.inputs
    require_equal(what, "n_sections", design.n_sections, n_sections)
    require_equal(what, "numbers of inputs", len(names), len(inputs))
    if any(x in inputs and x != y for x, y in zip(names, inputs, strict=True)):
        require_equal(what, "orders of inputs", names, inputs)


def check_window(n_sections: int, periods: int) -> None:
    """**Raises:** `DefinitionError` for windows that no memory holds."""
    if n_sections * periods > limits.WINDOW:
        raise DefinitionError(
            f"{n_sections} sections in {periods} periods are more samples than an experiment may "
            f"have ({limits.WINDOW}): take fewer."
        )


def to_lines(
    frequencies: Float[np.ndarray, " K"], periods: int
) -> Int[np.ndarray, " K"]:
    """Return frequencies as integers j with f = j / periods.

    **Raises:** `DefinitionError` for a frequency that is not a multiple of 1/periods.
    """
    exact = np.asarray(frequencies, float) * periods
    lines = np.rint(exact)
    wrong = ~(np.abs(exact - lines) < OFF_LINE)
    if wrong.any():
        f = float(np.asarray(frequencies)[np.argmax(wrong)])
        raise DefinitionError(
            f"f = {f:.10g} is not a multiple of 1/{periods}: move it, or choose other `periods`."
        )
    return lines.astype(int)


def input_names(inputs: InputNames) -> tuple[str, ...]:
    """Return names from names, or from a number: `u`, or `u0`, `u1`, ..."""
    if isinstance(inputs, int):
        return names("inputs", None, inputs)
    return (inputs,) if isinstance(inputs, str) else tuple(inputs)
