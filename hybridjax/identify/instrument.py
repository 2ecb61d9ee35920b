r"""HTFs of a plant in a control loop: an external reference is the instrument.

With a controller at work, $u = r - F y$, noise v of the output goes round the loop into u, and the
ratio of y to u is a mixture of plant and controller. The reference r is independent of v. In each
class of lines f + integers let R, U and Y be the spectra of M experiments, one column for each
experiment. Then

$$P = (Y \hat U^*) (U \hat U^*)^{-1}, \qquad \hat U = (U R^*) (R R^*)^{-1} R,$$

which is $T_{yr} T_{ur}^{-1}$ if there are as many references as inputs. The residual $E = Y - P U$
is independent of R, and the error of P is $E \hat U^* (U \hat U^*)^{-1}$. So the variance of the
entry (a, b) of P is the variance of row a of E times the entry (b, b) of $(\hat U \hat U^*)^{-1}$
(Pintelon and Schoukens 2012, sections 2.6 and 7.2.7, for matrices; Söderström and Stoica 1983).
With the estimated P, the expectation of $E E^*$ is the variance times $M - 2 n + \mathrm{tr}\,
(\hat U \hat U^*)^{-1} U U^*$, where n is the number of rows of U.

`estimate_htf` and `estimate_loop` call this file: `spectral_products` sums the products of spectra
over experiments, and `solve` computes P and its variances (`_solve_classes`).

If the plant is wrong, compare `_solve_classes` with these formulas; if data are refused, look at
`_require_answers` and `require_loop`; if lines are missing, at `excited_classes`.
"""

import dataclasses
import itertools
from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Complex, Float, Int

from .._core.arguments import require_among
from ..errors import DefinitionError
from ..experiments.data import ExperimentData
from ..experiments.record import RecordedData, SectionSeries, uninterrupted_records
from ..linear.algebra import Lines
from ..linear.frequency_response import check_harmonics
from ..linear.htf import HTF, VarianceDof
from .descent import positive
from .spectral_sums import SILENT_LINE, Experiments, Setup, parts_of


# The plant can be identified if the smallest singular value of the response of the inputs to the
# references, relative to the largest, exceeds this. Smaller: noise is divided by noise. Larger:
# plants behind controllers of high gain are refused.
_ANSWERS = 1e-4


class Roles(NamedTuple):
    """The role of each input of the data: columns that are inputs of the plant, and columns that
    are references."""

    inputs: list[int]
    references: list[int]

    @classmethod
    def of(
        cls, names: Sequence[str], reference: Sequence[str], fewest: int | None = None
    ) -> "Roles":
        """**Raises:** `DefinitionError` unless the references are some, but not all, of the inputs,
        and at least `fewest`. Default: as many as the other inputs."""
        require_among("input", reference, names, "`references`: ")
        references = [list(names).index(name) for name in reference]
        inputs = [i for i in range(len(names)) if i not in references]
        if not inputs:
            raise DefinitionError(
                "all inputs are references: name those of the controller, too."
            )
        if len(references) < (len(inputs) if fewest is None else fewest):
            raise DefinitionError(
                f"{len(inputs)} inputs of the plant need as many references, which move each of "
                f"them from outside: there are {len(references)}."
            )
        return cls(inputs, references)


def in_loop(
    data: RecordedData, reference: Sequence[str]
) -> tuple[list[SectionSeries], list[SectionSeries]]:
    """Return records from the plant's inputs to the outputs, and from the references to these
    inputs.

    **Raises:** `DefinitionError` as `Roles.of`, and if a reference is an input.
    """
    records = uninterrupted_records(data)
    names = records[0].inputs
    roles = Roles.of(names, reference)
    require_loop(roles, [record.u for record in records], names)
    inputs = tuple(names[i] for i in roles.inputs)
    references = tuple(names[i] for i in roles.references)
    plant = []
    drive = []
    for record in records:
        u = record.u[:, roles.inputs]
        r = record.u[:, roles.references]
        plant.append(dataclasses.replace(record, u=u, inputs=inputs))
        drive.append(
            dataclasses.replace(record, u=r, y=u, inputs=references, outputs=inputs)
        )
    return plant, drive


def require_loop(
    roles: Roles, signals: Sequence[np.ndarray], names: Sequence[str]
) -> None:
    """**Raises:** `DefinitionError` for an input that equals its reference, so that there is no
    loop."""
    for i, k in itertools.product(roles.inputs, roles.references):
        if all(np.array_equal(x[..., i], x[..., k]) for x in signals):
            raise DefinitionError(
                f"{names[i]} and {names[k]} are equal: there is no loop, leave `references` out."
            )


class Sums(NamedTuple):
    """Products of spectra z of outputs, inputs and references in K classes, over experiments."""

    total: Complex[np.ndarray, "K n n"]
    """Sums of z z*, of the means over windows."""
    between: Complex[np.ndarray, "K n n"]
    """Sums of the covariances of these means, from the differences between windows."""
    experiments: int
    setup: Setup
    unit: Float[np.ndarray, " signals"]
    """Magnitudes of the signals. All sums are in these units, since each signal has its own
    unit."""

    def rows(self, names: Sequence[str]) -> Int[np.ndarray, " a"]:
        """Return the rows of signals, for all components."""
        signals = [*self.setup.outputs, *self.setup.inputs]
        columns = np.array([signals.index(name) for name in names], int)
        components = np.arange(self.setup.n_sections) * len(signals)
        return np.add.outer(components, columns).ravel()

    def plus(self, more: "Sums") -> "Sums":
        """Return the sums over both sets of experiments."""
        return self._replace(
            total=self.total + more.total,
            between=self.between + more.between,
            experiments=self.experiments + more.experiments,
        )


def spectral_products(
    data: ExperimentData, repeats: int, like: Sums | None = None
) -> Sums:
    """Return the products of the spectra of all signals in classes 0 to P/2, over the experiments
    that ran well.

    **Arguments:** `like`: sums of other parts of the data, whose units are taken. Default: the
    units are magnitudes of these signals.
    """
    N = data.n_sections
    P = data.periods
    z = np.concatenate([data.y, data.u], axis=2)[data.ok]
    if like is None:
        size = np.linalg.norm(z, axis=(0, 1))
        unit = positive(size)
    else:
        unit = like.unit
    classes = np.arange(P // 2 + 1)
    harmonics = P * np.arange(N)
    bins = (classes[:, None] + harmonics) % (N * P)
    blocks = data.windows(repeats)
    windows = [np.fft.fft(z[:, w] / unit, axis=1) for w in blocks]
    spectra = np.stack(windows)[:, :, bins]
    # (windows, S, K, N, signals) to (windows, K, N * signals, S), components first
    spectra = np.moveaxis(spectra, 1, 4)
    spectra = spectra.reshape(*spectra.shape[:2], -1, spectra.shape[4])
    mean = spectra.sum(axis=0) / repeats
    apart = spectra - mean
    scatter = (apart @ apart.conj().mT).sum(axis=0)
    return Sums(
        total=mean @ mean.conj().mT,
        between=scatter / max(repeats - 1, 1) / repeats,
        experiments=len(z),
        setup=Setup.of(data),
        unit=unit,
    )


def htf_by_reference(
    data: Experiments,
    reference: Sequence[str],
    repeats: int,
    variance: Literal["auto", "noise", "total"],
    threshold: float,
) -> HTF:
    """Return the HTFs of the plant, with all harmonics; see `estimate_htf`.

    **Raises:** `DefinitionError` as `Roles.of`, and if the references excite no whole class of
    lines, or the inputs do not respond to them.
    """
    total = None
    for part in parts_of(data):
        roles = Roles.of(part.inputs, reference)
        require_loop(roles, [part.u], part.inputs)
        sums = spectral_products(part, repeats, total)
        total = sums if total is None else total.plus(sums)
    if total is None or not total.experiments:
        raise DefinitionError(
            "`data` holds no experiment that ran well: see `data.summary()`."
        )
    names = total.setup.inputs
    inputs = tuple(names[i] for i in roles.inputs)
    references = tuple(names[i] for i in roles.references)
    how = (repeats, variance)
    return solve(total, total.setup.outputs, inputs, references, how, threshold)


def excited_classes(
    sums: Sums, r: Int[np.ndarray, " c"], threshold: float
) -> Int[np.ndarray, " k"]:
    """Return the classes in which all lines of all references, of the rows r, are excited.

    **Raises:** `DefinitionError` if there is none.
    """
    power = sums.total[:, r[:, None], r]
    size = np.sqrt(_diagonal(power))
    strong = size > threshold * size.max()
    scale = np.where(strong, size, 1)
    by_row = power / scale[:, :, None]
    relative = by_row / scale[:, None]
    least = np.linalg.eigvalsh(relative)[:, 0]
    whole = strong.all(axis=1) & (least > SILENT_LINE)
    if whole.any():
        return np.flatnonzero(whole)
    best = int(strong.sum(axis=1).argmax())
    least_size = SILENT_LINE * size.max() ** 2
    apart = int(np.linalg.matrix_rank(power[best], least_size, True))
    raise DefinitionError(
        f"the reference excites too little: at f = {best / sums.setup.periods:g} + integers it "
        f"tells {apart} of {len(r)} components apart. Excite all lines up to N/2, or use "
        "`fit_ldtp(references=)`."
    )


def solve(
    sums: Sums,
    outputs: tuple[str, ...],
    inputs: tuple[str, ...],
    references: Sequence[str],
    how: tuple[int, str],
    threshold: float = SILENT_LINE,
) -> HTF:
    """Return the HTFs from the inputs to the outputs in the classes that the references excite.

    **Raises:** `DefinitionError` if there are no such classes, or if the inputs do not respond to
    the references.
    """
    N = sums.setup.n_sections
    P = sums.setup.periods
    y, u, r = map(sums.rows, (outputs, inputs, references))
    sizes = np.tile(sums.unit, N)
    unit = sizes[y][:, None] / sizes[u]
    classes = excited_classes(sums, r, threshold)
    estimates = _solve_classes(sums, classes, (y, u, r), how)
    every = (classes[:, None] + P * np.arange(N)) / P
    shifted = (every + N / 2) % N
    nearest = np.abs(shifted - N / 2)
    bins = np.round(P * nearest).astype(int)
    f = np.unique(bins) / P
    lines = Lines.of(f, N)

    def entries(x):
        return None if x is None else lines.entries(x * unit**2).real

    variance_dof = None
    if estimates.variance is not None:
        dof = np.zeros(len(f))
        dof[lines.row] = estimates.dof[:, None]
        variance_dof = VarianceDof(dof, shared=True)
    return HTF(
        f,
        lines.entries(estimates.H * unit),
        check_harmonics(None, N),
        N,
        inputs,
        outputs,
        "estimate",
        variance=entries(estimates.variance),
        noise_variance=entries(estimates.noise),
        variance_dof=variance_dof,
    )


class _ClassEstimates(NamedTuple):
    """Harmonic matrices of a plant in K classes, and variances of their entries."""

    H: Complex[np.ndarray, "K y u"]
    variance: Float[np.ndarray, "K y u"] | None
    """Variance from the scatter of experiments, or if there is none, from the scatter of
    windows."""
    noise: Float[np.ndarray, "K y u"] | None
    """Variance from windows, if both are known."""
    dof: Float[np.ndarray, " K"]
    """Complex degrees of freedom of the variance."""


def _solve_classes(
    sums: Sums,
    classes: Int[np.ndarray, " K"],
    rows: tuple[Int[np.ndarray, " _"], ...],
    how: tuple[int, str],
) -> _ClassEstimates:
    """Solve the equations of each class, with the references as instruments.

    **Arguments:** `rows`: those of the outputs, the inputs and the references.

    **Raises:** `DefinitionError` if inputs do not answer the references, or without a scatter that
    is asked for.
    """
    y, u, r = rows
    repeats, kind = how
    G = sums.total[classes]

    def block(rows, columns, G=G):
        return G[:, rows[:, None], columns]

    to_r = np.linalg.solve(block(r, r), block(r, u))  # (R R*)^-1 R U*
    power = block(u, r) @ to_r
    _require_answers(power, block(r, r), classes / sums.setup.periods)
    along = _adjoint(to_r) @ block(r, y)
    H = _adjoint(np.linalg.solve(power, along))
    spread = np.linalg.inv(power)
    by_input = _diagonal(spread)

    def variance(G, rows):
        """Return the variances of H for errors Y - H U, from their products G, for a number of
        rows."""
        adjoint = _adjoint(H)
        cross = block(y, u, G) @ adjoint
        square = block(y, y, G) - cross - _adjoint(cross)
        square = square + H @ block(u, u, G) @ adjoint
        of_outputs = np.maximum(_diagonal(square), 0)
        mean = of_outputs[:, :, None] / rows
        return mean * by_input[:, None]

    noise = None
    if repeats > 1:
        noise = variance(sums.between[classes], sums.experiments)
    dof = np.full(len(classes), float(sums.experiments - len(u)))
    if kind == "total" and dof[0] <= 0:
        raise DefinitionError(
            f"{sums.experiments} experiments with {len(u)} unknowns each leave no scatter: apply "
            "several realizations (`Design.realizations`), or pass variance='noise'."
        )
    if kind == "noise" or dof[0] <= 0:
        dof[:] = sums.experiments * (repeats - 1)
        return _ClassEstimates(
            H=H,
            variance=noise,
            noise=None,
            dof=dof,
        )
    # E contains the error of P times U, and `dof` accounts only for the part of U that the
    # references explain. `left` is the other part, relative to this one: it enlarges E E*, on
    # average by its trace times the variance. The error of the entry itself is assumed at the edge
    # of its 95 % confidence disc, where its square is three times the variance. The scatter of all
    # other entries reduces the degrees of freedom.
    left = spread @ block(u, u) - np.eye(len(u))
    edge = _diagonal(left @ spread) / by_input
    counted = dof + _diagonal(left).sum(axis=1)
    widened = counted[:, None, None] + 2 * edge[:, None]
    total = variance(G, widened)
    taken = _diagonal(left @ left).sum(axis=1) / counted**2
    return _ClassEstimates(
        H=H,
        variance=total,
        noise=noise,
        dof=1 / (1 / dof + taken),
    )


def _require_answers(
    power: Complex[np.ndarray, "k u u"],
    reference: Complex[np.ndarray, "k r r"],
    f: Float[np.ndarray, " k"],
) -> None:
    """**Raises:** `DefinitionError` if the references do not move each input.

    **Arguments:** `power`: power of the inputs' responses. `reference`: power of the references.
    """
    size = np.linalg.svd(power, compute_uv=False)
    drive = np.linalg.svd(reference, compute_uv=False)[:, 0]
    largest = np.maximum(size[:, 0], SILENT_LINE * drive)
    weak = size[:, -1] < _ANSWERS**2 * largest
    if weak.any():
        first = size[weak][0]
        raise DefinitionError(
            f"the references do not move each input: singular values of T_ur at f = "
            f"{f[weak][0]:g} + integers fall to {np.sqrt(first[-1] / first[0]):.1e} of the "
            "largest. Choose others."
        )


def _adjoint(x: Complex[np.ndarray, "k a b"]) -> Complex[np.ndarray, "k b a"]:
    return x.conj().mT


def _diagonal(x: Complex[np.ndarray, "k a a"]) -> Float[np.ndarray, "k a"]:
    return np.real(np.linalg.diagonal(x))
