"""Sums over experiments, for each line of the spectrum, from which `estimate_htf` estimates HTFs.

Line k is the frequency f = k / P (cycles per period) of a DFT over P periods. `spectral_sums`
returns `SpectralSums`; experiments may come in parts, since the sums of two parts can be added
(`_add`), so that memory does not depend on their number. Lines are selected in `_excited`, and
spectra of outputs are computed in `_outputs`: look there if an estimate lacks lines or is shifted.
An input that is refused because it does not repeat has its cause in `_excited`, too. A new field of
`SpectralSums` must be a sum with the lines first (or a pair of counts), so that `_add` can add it.
"""

from collections.abc import Iterable, Iterator
from typing import Annotated, Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float, Int

from .._core.arguments import require_equal
from .._core.boundary.containers import Stream
from ..errors import DefinitionError
from ..experiments.data import ExperimentData
from ..experiments.design.partition import check_sharing, needs_two_phases, regular
from ..experiments.record import require_deviations
from ..linear.frequency_response import Harmonics, check_harmonics
from .descent import ROUNDING, positive


Experiments = (
    ExperimentData | Annotated[Iterable[ExperimentData], Stream(ExperimentData, "data")]
)
"""Experiments, or an iterable of parts of them."""


# The input repeats if each of its lines changes from window to window by less than this, relative
# to the largest line. Smaller: recorded inputs with noise are refused. Larger: inputs of another
# period pass.
_REPEATS = 1e-2
# By default, a line of an input is excited if it exceeds this part of the largest line. Smaller:
# rounding errors count as lines. Larger: weak lines are missed.
SILENT_LINE = 1e-6
# Largest number of signals whose crest factors are tested; number of redraws of the phases of each;
# and least number of lines of a signal. Fewer signals or redraws: random phases count as optimized
# more often, by chance. Fewer lines: random phases may be as good as optimized ones.
_TESTED = 12
_REDRAWS = 200
_FEWEST_LINES = 8


class Setup(NamedTuple):
    """The names and numbers that all experiments of one estimate share."""

    n_sections: int
    periods: int
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]

    @classmethod
    def of(cls, data: ExperimentData) -> "Setup":
        return cls(data.n_sections, data.periods, data.inputs, data.outputs)


def parts_of(data: Experiments) -> Iterator[ExperimentData]:
    """Iterate over experiments, which may come in parts.

    **Raises:** `DefinitionError` for parts that do not belong together.
    """
    setup = None
    for part in [data] if isinstance(data, ExperimentData) else data:
        found = Setup.of(part)
        setup = setup or found
        require_equal("`data`", "sections, periods or signals", setup, found)
        yield part


class SpectralSums(NamedTuple):
    """Sums over experiments that did not fail, for K lines, ascending.

    The regressors X of a line are its inputs U and their conjugates.
    """

    setup: Setup
    harmonics: tuple[int, ...]
    line: Int[np.ndarray, " K"]
    mirrored: Bool[np.ndarray, " K"]
    """Lines that coincide with their own mirror images: responses to U and conj(U) add there."""
    gram: Complex[np.ndarray, "K 2*nu 2*nu"]
    """Sums of conj(X) X^T."""
    count: Int[np.ndarray, " K"]  # type: ignore[assignment]  # (not the method of tuples)
    """The number of experiments."""
    along: Complex[np.ndarray, "K 2*nu M ny"]
    """Sums of conj(X) Y[k + l P], Y the mean over the repeated windows."""
    energy: Float[np.ndarray, "K M ny"]
    """Sums of |Y[k + l P]|^2."""
    present: Float[np.ndarray, "K nu"]
    """The number of experiments with each input."""
    energies: Float[np.ndarray, "K nu M ny"]
    """Sums of |Y[k + l P]|^2 over the experiments that excite each input."""
    turned: Complex[np.ndarray, "K nu M ny"]
    """Sums of Y[k + l P]^2, with twice the phase of each input subtracted from its phase."""
    noise: Float[np.ndarray, "K M ny"]
    """Sums of the variance of Y[k + l P] between windows; zero for one window."""
    crest_factors: tuple[int, int]
    """Number of signals that were tested, and number of those with a crest factor below all redraws
    of their phases."""
    repeats: int
    """The number of windows that were averaged."""
    experiments: tuple[int, int]
    """The number of experiments, and of those that did not fail."""

    @property
    def f(self) -> Float[np.ndarray, " K"]:
        return self.line / self.setup.periods

    def solvable(self) -> Bool[np.ndarray, " K"]:
        """Test at which lines the responses to all inputs (and mirror images) can be separated."""
        nu = len(self.setup.inputs)
        single = regular(self.gram[:, :nu, :nu])
        return np.where(self.mirrored, single & regular(self.gram), single)


def spectral_sums(
    data: Experiments,
    harmonics: Harmonics | None,
    *,
    threshold: float = SILENT_LINE,
    repeats: int = 1,
) -> SpectralSums:
    """Return the sums over all experiments, which may come in parts.

    **Arguments:** as of `estimate_htf`; no harmonics are `()`.

    **Raises:** `DefinitionError` if nothing is excited, if lines of an experiment disturb each
    other, if records are too short, or if parts do not belong together.
    """
    total = None
    count = 0
    for part in parts_of(data):
        chosen = () if harmonics == () else check_harmonics(harmonics, part.n_sections)
        sums = _sums_of_part(part, chosen, threshold, repeats, count)
        total = sums if total is None else _add(total, sums)
        count += len(part.ok)
    if total is None:
        raise DefinitionError("`data` must be experiments, not an empty list.")
    if len(total.line) == 0:
        raise DefinitionError(
            "the inputs are zero in the window: give the inputs that acted."
        )
    return total


def _sums_of_part(
    data: ExperimentData,
    harmonics: tuple[int, ...],
    threshold: float,
    repeats: int,
    first: int,
) -> SpectralSums:
    """Return the sums over one part of the experiments. `first`: number of its first experiment."""
    windows = data.windows(repeats)
    experiment, line, U = _excited(data, windows, threshold, first)
    lines, index = np.unique(line, return_inverse=True)
    mirrored = needs_two_phases(lines, data.periods, data.n_sections)
    # The limit cycle has power at multiples of f = 1.
    if mirrored.any() and data.ok.any():
        require_deviations(data.records)
    good = data.ok[experiment]

    def total(values):
        """Sums over the entries of each line."""
        shape = (len(lines), *values.shape[1:])
        out = np.zeros(shape, values.dtype)
        np.add.at(out, index[good], values[good])
        return out

    X = np.concatenate([U, U.conj()], axis=1)
    products = X[:, :, None].conj() * X[:, None]
    Y, noise = _outputs(data, windows, experiment, line, harmonics)
    size = np.abs(U)
    none = np.zeros_like(U)
    phase = np.divide(U.conj(), size, out=none, where=size > 0)
    turned = phase[:, :, None, None] * Y[:, None]
    tested = (0, 0)
    if first or len(lines) < len(line):  # lines were measured several times
        tested = _compare_crest_factors(data.u[:, data.window])
    return SpectralSums(
        setup=Setup.of(data),
        harmonics=harmonics,
        line=lines,
        mirrored=mirrored,
        gram=total(products),
        count=total(np.ones(len(U), int)),
        along=total(X.conj()[:, :, None, None] * Y[:, None]),
        energy=total(np.abs(Y) ** 2),
        present=total(1.0 * (size > 0)),
        energies=total(np.abs(turned) ** 2),
        turned=total(turned**2),
        noise=total(noise),
        crest_factors=tested,
        repeats=repeats,
        experiments=(len(data.ok), int(data.ok.sum())),
    )


def _outputs(data: ExperimentData, windows: list[slice], experiment, line, harmonics):
    """Return, for each entry k, the mean of Y over the windows at lines k + m P, and the variance
    of this mean."""
    N = data.n_sections
    P = data.periods
    shifts = P * np.asarray(harmonics, int)
    output = (line[:, None] + shifts) % (N * P)
    spectra = [np.fft.fft(data.y[:, window], axis=1) for window in windows]
    Y = np.stack([x[experiment[:, None], output] for x in spectra])
    mean = Y.sum(axis=0) / len(Y)
    square = (np.abs(Y - mean) ** 2).sum(axis=0)
    degrees = max(len(Y) - 1, 1)
    return mean, square / degrees / len(Y)


def _excited(data: ExperimentData, windows: list[slice], threshold: float, first: int):
    """Return experiment, line and U of every excited line. Raises an error if lines of an
    experiment disturb each other."""
    known = np.isfinite(data.u).all(axis=(1, 2), keepdims=True)
    u = np.where(known, data.u, 0.0)
    in_windows = [np.fft.rfft(u[:, window], axis=1) for window in windows]
    spectra = np.stack(in_windows)
    U = spectra.sum(axis=0) / len(spectra)
    # Inputs have units of their own.
    largest = np.abs(U).max(axis=(0, 1))
    tiny = np.finfo(float).tiny
    unit = np.maximum(largest, tiny)
    size = np.abs(U) / unit
    peak = size.max(axis=(1, 2), keepdims=True)
    change = np.abs(spectra - U) / unit / positive(peak)
    worst = float(np.max(change))
    if worst > max(threshold, _REPEATS):
        raise DefinitionError(
            f"the input does not repeat: its last {len(windows)} windows of P = {data.periods} "
            f"differ by {worst:.2g} of the largest line. Take fewer `repeats`, or another P."
        )
    excited = (size > threshold * peak) & (size > ROUNDING)
    experiment, line = np.nonzero(excited.any(axis=2))
    check_sharing(experiment + first, line, data.periods)
    return experiment, line, U[experiment, line]


def _compare_crest_factors(u: Float[np.ndarray, "S n nu"]) -> tuple[int, int]:
    """Compare crest factors with those of 200 redraws of the phases, for some of the signals.

    The realizations of a random-phase multisine show the distortion that its class of signals
    causes; signals with phases chosen for a low crest factor (the largest value relative to the
    rms, about 3 for random phases) do not. Return the numbers of signals that were tested, and of
    those with crest factors below all redraws.
    """
    places = np.linspace(0, len(u) - 1, _TESTED).round()
    chosen = np.unique(places.astype(int))
    by_input = u[chosen].transpose(0, 2, 1)
    signals = by_input.reshape(-1, u.shape[1])
    rng = np.random.default_rng(0)
    tested = 0
    low = 0
    for signal in signals[np.isfinite(signals).all(axis=1)]:
        size = np.abs(np.fft.rfft(signal))
        lines = np.flatnonzero(size > SILENT_LINE * size.max())
        if not _FEWEST_LINES <= len(lines) <= len(signal) // 4:
            continue
        angle = rng.uniform(0, 2 * np.pi, (_REDRAWS, len(lines)))
        spectra = np.zeros((_REDRAWS, len(size)), complex)
        phasors = np.exp(1j * angle)
        spectra[:, lines] = size[lines] * phasors
        waves = np.fft.irfft(spectra, len(signal), axis=1)
        draws = np.abs(waves).max(axis=1)
        tested += 1
        low += bool(np.abs(signal).max() < draws.min())
    return tested, low


def _add(a: SpectralSums, b: SpectralSums) -> SpectralSums:
    """Return the sums over the experiments of both, at all lines of either."""
    line = np.union1d(a.line, b.line)
    rows_a = np.searchsorted(line, a.line)
    rows_b = np.searchsorted(line, b.line)
    common = ("setup", "harmonics", "line", "repeats")
    both: dict[str, Any] = {}
    for name in set(SpectralSums._fields).difference(common):
        x = getattr(a, name)
        y = getattr(b, name)
        if isinstance(x, tuple):
            first = x[0] + y[0]
            second = x[1] + y[1]
            both[name] = (first, second)
            continue
        shape = (len(line), *x.shape[1:])
        both[name] = np.zeros(shape, x.dtype)
        both[name][rows_a] += x
        both[name][rows_b] += y
    return a._replace(line=line, **both)
