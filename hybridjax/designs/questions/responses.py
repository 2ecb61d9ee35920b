"""Transfer functions and impulse responses of the model that `fit_ldtp` would find."""

import numpy as np
from jaxtyping import Float

from ...errors import DefinitionError
from ...identify.joint.coordinates import LocalCoordinates
from ...identify.joint.frequency import transfer, transfer_slopes
from ...linear.frequency_response import check_harmonics
from ..candidates import Candidates
from ..goals import FrequencyResponse, ImpulseResponse
from ..noise import Noise
from ..signals import Model
from .ldtp import LDTPUnknowns, ldtp_unknowns
from .question import Question, fewer_rows


# Frequencies of a band at which its mean is taken. Doubled: the mean of a curve that turns between
# them is closer to its integral.
_POINTS = 64
# Length of the imaginary steps by which derivatives are taken. Doubled: the same, up to rounding.
_STEP = 1e-30


def about_frequencies(
    goal: FrequencyResponse,
    model: Model,
    cosines: Candidates,
    noise: Noise,
    power: Float[np.ndarray, " K"],
) -> Question:
    """As `question_of`."""
    N, band = cosines.n_sections, goal.band
    if band[1] > N / 2:
        raise DefinitionError(f"`band` must lie within 0 and {N / 2:g}, not {band}.")
    harmonics = check_harmonics(goal.wanted, N)
    unknowns = ldtp_unknowns(model, cosines, goal.harmonics, noise, power)
    f = band[0] + (band[1] - band[0]) * (np.arange(_POINTS) + 0.5) / _POINTS
    H = transfer(unknowns.coordinates.model, f, harmonics)
    slopes = np.concatenate(
        [part for _, part in transfer_slopes(unknowns.coordinates, f, harmonics)], axis=2
    )
    size = np.sqrt((np.abs(H) ** 2).mean(axis=1).sum(axis=0))  # (ny, nu)
    slopes = np.stack([slopes.real, slopes.imag], axis=3) / size / np.sqrt(_POINTS)
    each = slopes.transpose(1, 4, 5, 0, 2, 3)  # (M, ny, nu, P, F, 2)
    names = [
        f"H_{m} of {y}{_from(model, u)}"
        for m in harmonics
        for y in _outputs(model, noise)
        for u in model.inputs
    ]
    return _question(unknowns, each.reshape(len(names), len(slopes), -1), names)


def about_impulses(
    goal: ImpulseResponse,
    model: Model,
    cosines: Candidates,
    noise: Noise,
    power: Float[np.ndarray, " K"],
) -> Question:
    """As `question_of`."""
    unknowns = ldtp_unknowns(model, cosines, goal.harmonics, noise, power)
    response, slopes = _impulses(unknowns.coordinates, goal.lags)
    square = (response**2).sum(axis=(0, 1))
    slopes = slopes / np.sqrt(np.where(square > 0, square, np.inf))
    each = slopes.transpose(3, 4, 0, 1, 2)
    names = [
        f"response of {y}{_from(model, u)}" for y in _outputs(model, noise) for u in model.inputs
    ]
    return _question(unknowns, each.reshape(len(names), len(slopes), -1), names)


def _outputs(model: Model, noise: Noise) -> list[str]:
    return [model.outputs[i] for i in noise.seen]


def _from(model: Model, name: str) -> str:
    return f" from {name}" if len(model.inputs) > 1 else ""


def _question(
    unknowns: LDTPUnknowns, each: Float[np.ndarray, "g P n"], names: list[str]
) -> Question:
    part = np.repeat(np.arange(len(each)), each.shape[2])
    rows = each.swapaxes(1, 2).reshape(len(part), -1)
    return fewer_rows(unknowns.question(rows, tuple(names), "A", part))


def _impulses(
    coordinates: LocalCoordinates, lags: int
) -> tuple[Float[np.ndarray, "N lags ny nu"], Float[np.ndarray, "P N lags ny nu"]]:
    """Responses at section n to a push r sections earlier, and their derivatives."""
    P, places = coordinates.size, coordinates.places
    A, B, C, D = ([x.astype(complex)[None] for x in blocks] for blocks in coordinates.model[:4])
    N, (ny, nu) = coordinates.model.n_sections, coordinates.model.D[0].shape
    found = np.zeros((P, N, lags, ny, nu), complex)

    def changed(n):
        """The matrices of a section, with an imaginary step of each coordinate."""
        step = np.zeros((P, P), complex)
        at = [i for part in places[n].values() for i in range(part.start, part.stop)]
        step[at, at] = 1j * _STEP
        change = {
            name: step[:, places[n][name]].reshape(P, *shape)
            for name, shape in coordinates.blocks(n)
        }
        return (
            A[n] + coordinates.to_A[n] @ change["Y"],
            B[n] + change["B"],
            C[n] + coordinates.to_C[n] @ change["Y"],
            D[n] + change.get("D", 0.0),
        )

    sections = [changed(n) for n in range(N)]
    for first, (_, entering, _, direct) in enumerate(sections):
        found[:, first, 0] = direct
        x = entering
        for r in range(1, lags):
            n = (first + r) % N
            found[:, n, r] = sections[n][2] @ x
            x = sections[n][0] @ x
    exact = found[0].real
    return exact, found.imag / _STEP
