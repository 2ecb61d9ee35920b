r"""HTFs of a plant that is in a loop: an external reference is the instrument.

With a controller at work, $u = r - F y$, noise v of the output goes round the loop into u, and
the ratio of y to u is that of a mixture of plant and controller. The reference r is independent of
v. In each class of lines f + integers let R, U and Y be the spectra of M experiments, one column
for each experiment. Then

$$P = (Y \hat U^*) (U \hat U^*)^{-1}, \qquad \hat U = (U R^*) (R R^*)^{-1} R,$$

which is $T_{yr} T_{ur}^{-1}$ for as many references as inputs. With $E = Y - P U$, which holds no
part of R, the error of P is $E \hat U^* (U \hat U^*)^{-1}$: the variance of its entry (a, b) is
that of row a of E times the entry (b, b) of $(\hat U \hat U^*)^{-1}$ (Pintelon and Schoukens 2012,
sections 2.6 and 7.2.7, for matrices; Söderström and Stoica 1983). With the estimated P, the
expectation of $E E^*$ is this variance times
$M - 2 n + \mathrm{tr}\, (\hat U \hat U^*)^{-1} U U^*$, n the number of rows of U.
"""

import dataclasses
from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Complex, Float, Int

from .._core.arguments import require_among, require_same
from ..errors import DefinitionError
from ..experiments.data import ExperimentData
from ..experiments.record import Record, RecordedData, uninterrupted_records
from ..linear.algebra import Lines
from ..linear.frequency_response import check_harmonics
from ..linear.htf import HTF, Scatter
from .spectral_sums import SILENT_LINE, Experiments, Setup


# Smallest singular value of the inputs' answer to the references, relative to the largest, with
# which the plant is told apart. Smaller: noise is divided by noise. Larger: plants are refused
# behind controllers of high gain.
_ANSWERS = 1e-4


class Roles(NamedTuple):
    """What each input of the data is to the plant: columns of its own inputs, of references."""

    inputs: list[int]
    references: list[int]

    @classmethod
    def of(
        cls, names: Sequence[str], reference: Sequence[str], fewest: int | None = None
    ) -> "Roles":
        """**Raises:** `DefinitionError` unless references are some, not all, of the inputs, and
        `fewest` or more. Default: as many as the others."""
        require_among("input", reference, names, "`reference`: ")
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
) -> tuple[list[Record], list[Record]]:
    """Return records from the plant's inputs to the outputs, and from the references to these
    inputs.

    **Raises:** `DefinitionError` as `Roles.of`, and if a reference is an input.
    """
    records = uninterrupted_records(data)
    names = records[0].inputs
    roles = Roles.of(names, reference)
    require_loop(roles, [r.u for r in records], names)
    inputs, references = (tuple(names[i] for i in columns) for columns in roles)
    plant = []
    drive = []
    for r in records:
        u = r.u[:, roles.inputs]
        ref = r.u[:, roles.references]
        plant.append(dataclasses.replace(r, u=u, inputs=inputs))
        drive.append(
            dataclasses.replace(r, u=ref, y=u, inputs=references, outputs=inputs)
        )
    return plant, drive


def require_loop(
    roles: Roles, signals: Sequence[np.ndarray], names: Sequence[str]
) -> None:
    """**Raises:** `DefinitionError` for an input that is its reference: there is no loop then."""
    for i in roles.inputs:
        for k in roles.references:
            if all(np.array_equal(x[..., i], x[..., k]) for x in signals):
                raise DefinitionError(
                    f"{names[i]} and {names[k]} are equal: there is no loop, leave `reference` out."
                )


class Sums(NamedTuple):
    """Products of spectra z of outputs, inputs and references in K classes, over experiments."""

    total: Complex[np.ndarray, "K n n"]
    """Sums of z z*, of the means over windows."""
    between: Complex[np.ndarray, "K n n"]
    """Sums of the covariances of these means between windows."""
    experiments: int
    setup: Setup
    unit: Float[np.ndarray, " signals"]
    """Sizes of the signals, in which they are measured: each has a unit of its own."""

    def rows(self, names: Sequence[str]) -> Int[np.ndarray, " a"]:
        """Return the rows of signals, for all components."""
        signals = [*self.setup.outputs, *self.setup.inputs]
        columns = np.array([signals.index(x) for x in names], int)
        return np.add.outer(
            np.arange(self.setup.n_sections) * len(signals), columns
        ).ravel()


def spectral_products(
    data: ExperimentData, repeats: int, like: Sums | None = None
) -> Sums:
    N = data.n_sections
    P = data.periods
    z = np.concatenate([data.y, data.u], axis=2)[data.ok]
    size = np.linalg.norm(z, axis=(0, 1))
    unit = like.unit if like else np.where(size > 0, size, 1.0)
    z = z / unit
    bins = (np.arange(P // 2 + 1)[:, None] + P * np.arange(N)) % (N * P)
    spectra = np.stack(
        [np.fft.fft(z[:, w], axis=1)[:, bins] for w in data.windows(repeats)]
    )
    # (windows, S, K, N, signals) to (windows, K, N * signals, S), components first
    spectra = np.moveaxis(spectra, 1, 4)
    spectra = spectra.reshape(*spectra.shape[:2], -1, spectra.shape[4])
    mean = spectra.sum(axis=0) / repeats
    apart = spectra - mean
    between = (
        (apart @ apart.conj().swapaxes(2, 3)).sum(axis=0)
        / max(repeats - 1, 1)
        / repeats
    )
    setup = Setup(N, P, data.inputs, data.outputs)
    return Sums(mean @ mean.conj().swapaxes(1, 2), between, len(z), setup, unit)


def htf_by_reference(
    data: Experiments,
    reference: Sequence[str],
    repeats: int,
    variance: Literal["auto", "noise", "total"],
    threshold: float,
) -> HTF:
    """Return the HTFs of the plant, with all harmonics; see `estimate_htf`.

    **Raises:** `DefinitionError` as `Roles.of`, and if the references excite no whole class of
    lines, or the inputs do not answer them.
    """
    total = None
    for part in [data] if isinstance(data, ExperimentData) else data:
        roles = Roles.of(part.inputs, reference)
        require_loop(roles, [part.u], part.inputs)
        sums = spectral_products(part, repeats, total)
        if total is not None:
            require_same("experiments", total, sums, ("setup",))
            both = (total.total + sums.total, total.between + sums.between)
            sums = Sums(*both, total.experiments + sums.experiments, *sums[3:])
        total = sums
    if total is None or not total.experiments:
        raise DefinitionError(
            "`data` holds no experiment that ran well: see `data.summary()`."
        )
    inputs, references = (tuple(total.setup.inputs[i] for i in part) for part in roles)
    return solve(
        total, total.setup.outputs, inputs, references, (repeats, variance), threshold
    )


def excited_classes(
    sums: Sums, r: Int[np.ndarray, " c"], threshold: float
) -> Int[np.ndarray, " k"]:
    """Return the classes in which all lines of all references, of the rows r, are excited.

    **Raises:** `DefinitionError` if there is none.
    """
    power = sums.total[:, r[:, None], r]
    size = np.sqrt(np.einsum("kii->ki", power).real)
    strong = size > threshold * size.max()
    scale = np.where(strong, size, 1)
    least = np.linalg.eigvalsh(power / scale[:, :, None] / scale[:, None])[:, 0]
    whole = strong.all(axis=1) & (least > SILENT_LINE)
    if whole.any():
        return np.flatnonzero(whole)
    best = int(strong.sum(axis=1).argmax())
    raise DefinitionError(
        f"the reference excites too little: at f = {best / sums.setup.periods:g} + integers it "
        f"tells {int(np.linalg.matrix_rank(power[best], SILENT_LINE * size.max() ** 2, True))} of "
        f"{len(r)} components apart. Excite all lines up to N/2, or use `fit_ldtp(reference=)`."
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

    **Raises:** `DefinitionError` if there are none, or the inputs do not answer the references.
    """
    y, u, r = map(sums.rows, (outputs, inputs, references))
    unit = np.tile(sums.unit, sums.setup.n_sections)
    unit = unit[y][:, None] / unit[u]
    classes = excited_classes(sums, r, threshold)
    (N, P, *_) = sums.setup
    G = sums.total[classes]
    (repeats, kind) = how

    def block(rows, columns, G=G):
        return G[:, rows[:, None], columns]

    to_r = np.linalg.solve(block(r, r), block(r, u))  # (R R*)^-1 R U*
    power = block(u, r) @ to_r
    size = np.linalg.svd(power, compute_uv=False)
    drive = np.linalg.svd(block(r, r), compute_uv=False)[:, 0]
    weak = size[:, -1] < _ANSWERS**2 * np.maximum(size[:, 0], SILENT_LINE * drive)
    if weak.any():
        raise DefinitionError(
            f"the references do not move each input: singular values of T_ur at f = "
            f"{classes[weak][0] / P:g} + integers fall to "
            f"{np.sqrt(size[weak][0, -1] / size[weak][0, 0]):.1e} of the largest. Choose others."
        )
    H = (
        np.linalg.solve(power, to_r.conj().swapaxes(1, 2) @ block(r, y))
        .conj()
        .swapaxes(1, 2)
    )
    spread = np.linalg.inv(power)

    def variance(G, rows):
        cross = block(y, u, G) @ H.conj().swapaxes(1, 2)
        square = block(y, y, G) - cross - cross.conj().swapaxes(1, 2)
        square = square + H @ block(u, u, G) @ H.conj().swapaxes(1, 2)
        mean = np.maximum(np.einsum("kii->ki", square).real, 0)[:, :, None] / rows
        return mean * np.einsum("kii->ki", spread).real[:, None]

    freedom = np.full(len(classes), float(sums.experiments - len(u)))
    total = noise = None
    if kind != "noise" and freedom[0] > 0:
        # The error of P multiplies all of U in E, of which the references explain only a part. The
        # other part adds errors of entries of P to E: of one at the edge of its disc, where they
        # count three times, and of all others, whose scatter takes degrees of freedom.
        left = spread @ block(u, u) - np.eye(len(u))
        edge = (
            np.einsum("kij,kji->ki", left, spread).real
            / np.einsum("kii->ki", spread).real
        )
        rows = freedom + np.einsum("kii->k", left).real
        total = variance(G, rows[:, None, None] + 2 * edge[:, None])
        freedom = 1 / (1 / freedom + np.einsum("kij,kji->k", left, left).real / rows**2)
    if repeats > 1:
        noise = variance(sums.between[classes], sums.experiments)
    if kind == "total" and total is None:
        raise DefinitionError(
            f"{sums.experiments} experiments with {len(u)} unknowns each leave no scatter: apply "
            "several realizations (`Design.realizations`), or pass variance='noise'."
        )
    if total is None:
        total = noise
        noise = None
        freedom[:] = sums.experiments * (repeats - 1)

    f = (classes[:, None] + P * np.arange(N)) / P
    f = np.unique(np.round(P * np.abs((f + N / 2) % N - N / 2)).astype(int)) / P
    lines = Lines.of(f, N)

    def entries(x):
        return None if x is None else lines.entries(x * unit**2).real

    by_line = np.zeros(len(f))
    by_line[lines.row] = freedom[:, None]
    scatter = None if total is None else Scatter(by_line, shared=True)
    return HTF(
        f,
        lines.entries(H * unit),
        check_harmonics(None, N),
        N,
        inputs,
        outputs,
        "estimate",
        variance=entries(total),
        noise_variance=entries(noise),
        scatter=scatter,
    )
