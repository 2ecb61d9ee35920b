r"""Transients subtracted from records whose initial condition could not be chosen.

Sampled once a period, at one section, the response to an input of P periods is a sum of the few
sinusoids $e^{2 \pi i c p / P}$, c the classes that are excited, and the response to the initial
condition decays like $\sum_i a_i \lambda_i^p$. The multipliers $\lambda$ are the same at every
section, in every output and every experiment (after the first period, in which the part of the
state with zero multipliers vanishes). All amplitudes are linear unknowns, which are eliminated, so
that d multipliers are left (variable projection: Golub and Pereyra 1973).

`remove_transient` returns the data without the transient. `_decays` finds the multipliers and the
transients, from rows of the data in which the sinusoids cancel (`_free`): a wrong decay has its
cause there, and so has a record of which too few rows are left; an input that is refused has it in
`_require_repetition`. The first period must be cut off, since zero multipliers act in it.
"""

import dataclasses

import equinox as eqx
import numpy as np
from jaxtyping import Complex, Float, Int
from scipy import linalg, optimize

from .._core.boundary.checked import checked
from .._core.boundary.kinds import Order
from .._core.showable import Showable
from .._core.text import folded, number
from ..errors import DefinitionError
from ..experiments.data import ExperimentData
from ..experiments.design.partition import line_class
from .denominator import multipliers_of
from .descent import Coefficients, positive, without
from .series.records import start_responses
from .spectral_sums import SILENT_LINE


# Largest number of multipliers that is tried. Larger: for each further one, records need 8 more
# cycles to separate the decay from everything that repeats. Smaller: slow modes of larger systems
# are missed.
_LARGEST_ORDER = 4


class TransientFit(Showable, eqx.Module):
    """Records without their transients.

    **Fields:**

    - `data`: the records from the second period on, less the transient.
    - `multipliers` (d,): those of the decay, by decreasing modulus. A by-product: fits to all of
      the data are more accurate.
    - `removed` (S, ny): rms of the transient in the window, per experiment and output; NaN
      where an experiment failed.
    """

    data: ExperimentData
    multipliers: Complex[np.ndarray, " d"]
    removed: Float[np.ndarray, "S ny"]

    def __repr__(self) -> str:
        shown = ", ".join(number(z, 4) for z in self.multipliers)
        sizes = np.nanmax(self.removed, axis=0)
        size = ", ".join(number(x, 2) for x in sizes)
        return folded(
            f"TransientFit(multipliers {shown}; removed rms up to {size}; {self.data!r})"
        )


@checked
def remove_transient(data: ExperimentData, order: Order | None = None) -> TransientFit:
    """Fit the decay of the initial condition's response, and subtract it.

    No model is needed. The input must repeat after P periods in the whole record. The record must
    be at least one period longer than P, because the first period, in which zero multipliers
    vanish, is cut off. If the record is several periods longer than P (such as 20), the decay is
    separated from everything that repeats after P periods, including distortion, and any design can
    be used. If it is shorter, the decay is separated only from the response at excited lines, so
    that the design must leave out half of the lines (`multisine(lines="odd")`).

    **Arguments:**

    - `data`: experiments, S records of at least P + 1 cycles.
    - `order`: d, the number of non-zero multipliers. Default: the one of 1 to 4 with the
      shortest description (Rissanen 1978).

    **Returns:** `hj.identify.TransientFit`: `data`, the argument of `estimate_htf`; `multipliers`
    (d,) of the decay; `removed` (S, ny), rms in units of the outputs.

    **Raises:** `DefinitionError` for an input that does not repeat, for records that are too short,
    and if no experiment ran well.

    **Example:**

    ```python
    free = hj.identify.remove_transient(data, order=2)
    htf = hj.estimate_htf(free.data)
    ```

    **Before:** `hj.run_experiments`. **After:** `hj.estimate_htf`.
    """
    N = data.n_sections
    P = data.periods
    cycles = data.y.shape[1] // N - 1
    if order is not None and order > cycles // 2:
        raise DefinitionError(
            f"`order` must be at most half of the {cycles} cycles, not {order}."
        )
    if cycles < P:
        raise DefinitionError(
            f"the record has {cycles + 1} cycles, but to remove a transient it must hold the "
            f"window of P = {P} and the one before it, which is cut off: record some more."
        )
    data.require_ok()
    # Inputs have units of their own.
    u = data.u[data.ok]
    largest = np.abs(u).max(axis=(0, 1))
    u = u / np.maximum(largest, np.finfo(float).tiny)
    _require_repetition(data, u)
    everything = cycles - P >= 2 * (order or _LARGEST_ORDER)
    if everything:
        classes = [np.arange(P // 2 + 1)] * len(u)
    else:
        classes = _excited_classes(data, u)
    c, transients = _decays(data, classes, everything, order)
    clean = data.y[:, N:].copy()
    clean[data.ok] -= transients
    removed = np.full((len(clean), clean.shape[2]), np.nan)
    window = transients[:, -N * P :]
    removed[data.ok] = np.sqrt(np.mean(window**2, axis=1))
    simulated = None
    if data.simulated is not None:
        late = data.simulated.late
        later = np.maximum(data.failed_at - N, 0)
        failed_at = np.where(data.failed_at >= 0, later, -1)
        simulated = dataclasses.replace(
            data.simulated,
            failed_at=failed_at,
            late=None if late is None else late[:, N:],
        )
    data = dataclasses.replace(data, u=data.u[:, N:], y=clean, simulated=simulated)
    return TransientFit(data, multipliers_of(c), removed)


def _decays(
    data: ExperimentData,
    classes: list[Int[np.ndarray, " k"]],
    everything: bool,
    order: int | None,
) -> tuple[Coefficients, Float[np.ndarray, "S n ny"]]:
    """Return the coefficients of the multipliers, and the transients of all experiments that ran.

    **Arguments:** `classes`: classes that are excited in each experiment. `everything`: whether all
    classes count as excited.

    **Raises:** `DefinitionError` if the transient cannot be told from the response.
    """
    N = data.n_sections
    y = data.y[data.ok]
    size = np.sqrt(np.mean(y**2, axis=(0, 1)))
    later = y[:, N:] / positive(size)
    cycles = later.shape[1] // N
    records = later.reshape(len(y), cycles, -1)
    free = [_free(excited, data.periods, cycles) for excited in classes]
    left = [Q @ record for Q, record in zip(free, records, strict=True)]
    least = min(map(len, free))
    if least <= (order or 1):
        raise DefinitionError(
            f"{cycles} cycles with {cycles - least} lines per section do not tell the transient "
            "from the response: record more, or excite half of the lines (`lines='odd'`)."
        )
    # (With `everything`, all experiments have the same Q.)
    whole = [np.concatenate(left, axis=1)] if everything else left
    blocks = [(Q, _condensed(z)) for Q, z in zip(free, whole, strict=False)]
    numbers = sum(z.size for z in left)
    series = records[:, 0].size
    if order is None:
        most = min(_LARGEST_ORDER, least - 1)
        tried = range(1, most + 1)
    else:
        tried = range(order, order + 1)
    fits = []
    for d in tried:
        c, cost = _fit(blocks, _start(records, free, d))
        parameters = d * (series + 1)
        mean = max(cost, 1e-300) / numbers
        length = numbers * np.log(mean) + parameters * np.log(numbers)
        fits.append((length, c))
    _, c = min(fits, key=lambda fit: fit[0])
    basis = _decay(c, cycles)
    transients = []
    for Q, z in zip(free, left, strict=True):
        amplitudes = np.linalg.lstsq(Q @ basis, z)[0]
        transients.append(basis @ amplitudes)
    return c, np.reshape(transients, later.shape) * size


def _require_repetition(data: ExperimentData, u: Float[np.ndarray, "S n nu"]) -> None:
    """**Raises:** `DefinitionError` for an input that does not repeat after P periods."""
    length = data.n_sections * data.periods
    later = u[:, length:]
    earlier = u[:, :-length]
    change = np.abs(later - earlier).max(axis=(1, 2))
    worst = int(np.argmax(change))
    if change[worst] > SILENT_LINE * np.abs(u[worst]).max():
        raise DefinitionError(
            f"the input of experiment {np.flatnonzero(data.ok)[worst]} does not repeat after P = "
            f"{data.periods} periods over all of the record: cut off the part in which it does not."
        )


def _excited_classes(
    data: ExperimentData, u: Float[np.ndarray, "S n nu"]
) -> list[Int[np.ndarray, " k"]]:
    """Return the classes of the lines that each experiment excites, and class 0."""
    spectrum = np.fft.rfft(u[:, data.window], axis=1)
    size = np.abs(spectrum).max(axis=2)
    excited = size > SILENT_LINE * size.max(axis=1, keepdims=True)
    lines = map(np.flatnonzero, excited)
    return [np.unique(np.append(line_class(x, data.periods), 0)) for x in lines]


def _condensed(z: Float[np.ndarray, "rows _"]) -> Float[np.ndarray, "rows _"]:
    """Return a matrix with no more columns than rows that gives the same residuals in
    regressions."""
    if z.shape[1] <= len(z):
        return z
    return np.asarray(np.linalg.qr(z.T, mode="r")).T


def _decay(c: Coefficients, cycles: int) -> Float[np.ndarray, "cycles d"]:
    """Return a basis of all decays with these multipliers."""
    return start_responses(c, np.zeros(1, int), cycles, len(c))[0]


def _free(classes: np.ndarray, P: int, cycles: int) -> Float[np.ndarray, "rows cycles"]:
    """Return rows that are orthogonal to the sinusoids of these classes at one section."""
    products = np.outer(np.arange(cycles), classes)
    angle = 2 * np.pi / P * products
    inner = (classes > 0) & (2 * classes < P)
    cosines = np.cos(angle)
    sines = np.sin(angle[:, inner])
    signals = np.concatenate([cosines, sines], axis=1)
    return linalg.null_space(signals.T).T


def _start(records, free, d: int) -> Coefficients:
    """Solve the difference equation of the decay by least squares. (Records obey it except for the
    sinusoids.)"""
    normal = np.zeros((d, d))
    right = np.zeros(d)
    cycles = records.shape[1]
    for Q, record in zip(free, records, strict=True):
        # The same sinusoids over d periods fewer.
        sinusoids = linalg.null_space(Q)[d:]
        keep = linalg.null_space(sinusoids.T).T
        delayed = [keep @ record[d - i : cycles - i] for i in range(d + 1)]
        now, *earlier = delayed
        earlier = np.stack(earlier)
        normal += np.tensordot(earlier, earlier, ((1, 2), (1, 2)))
        right -= np.tensordot(earlier, now, 2)
    return np.linalg.lstsq(normal, right)[0]


def _fit(blocks, start: Coefficients) -> tuple[Coefficients, float]:
    """Return the coefficients that leave the smallest sum of squares, and this sum."""
    cycles = blocks[0][0].shape[1]

    def residual(c):
        basis = _decay(c, cycles)
        left = []
        for Q, z in blocks:
            q, _ = np.linalg.qr(Q @ basis)
            left.append(without(q, z).ravel())
        return np.concatenate(left)

    fit = optimize.least_squares(residual, start, x_scale="jac")
    return fit.x, 2 * fit.cost
