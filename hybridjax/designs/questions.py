"""Goals as questions to the data: unknowns, what cosines say of them, and what is wanted."""

import numpy as np
from jaxtyping import Complex, Float, Int

from ..errors import DefinitionError
from ..fitting.fit import identifiability
from ..fitting.observations import ObservedHTF
from ..identify.multipliers.structured import StructuredFit
from ..linear.frequency_response import Harmonics
from ..linear.htf import HTF
from ..linear.ldtp import LDTP
from .allocation import Question
from .candidates import Candidates
from .goals import Goal, Multipliers, Parameters
from .sensitivities import DirectSensitivities, denominator_sensitivities


Model = LDTP | StructuredFit

# Multipliers whose polynomial has a smaller slope than that are not simple. Doubled: of two that
# are twice as far apart no first-order variance is given.
_SIMPLE = 1e-6


def question_of(
    goal: Goal, model: Model, cosines: Candidates, noise: Float[np.ndarray, " ny"]
) -> Question:
    """**Arguments:** `noise`, the standard deviation at the sections, infinite for outputs that
    are not measured.

    **Raises:** `DefinitionError` for multipliers that do not exist or are not simple, parameters
    that do not exist, and combinations that the data cannot see, which are named.
    """
    if isinstance(goal, Multipliers):
        return _about_multipliers(goal, model, cosines, noise)
    return _about_parameters(goal, model, cosines, noise)


def _about_multipliers(
    goal: Multipliers, model: Model, cosines: Candidates, noise: Float[np.ndarray, " ny"]
) -> Question:
    multipliers = np.asarray(model.multipliers)
    c = np.poly(multipliers).real[1:]
    channels = _by_channel(cosines)
    htfs = [_measured(model, cosines, here, goal.harmonics, noise, i) for i, here in channels]
    members = [here for _, here in channels]
    sensitivities = denominator_sensitivities(htfs, members, c, goal.overhang)
    wanted, names = _wanted(goal, multipliers, c)
    unknowns = tuple(f"c{k}" for k in range(1, len(c) + 1))
    return Question(sensitivities, wanted, names, unknowns, goal.criterion)


def _wanted(
    goal: Multipliers, multipliers: Complex[np.ndarray, " d"], c: Float[np.ndarray, " d"]
) -> tuple[Float[np.ndarray, "g d"], tuple[str, ...]]:
    """Derivatives of real and imaginary parts, or moduli, by c, and their names."""
    d = len(c)
    if d == 0:
        raise DefinitionError("the model has no multipliers but zero: there is nothing to ask for.")
    if goal.which is not None and goal.which >= d:
        raise DefinitionError(f"`goal`: there is no multiplier {goal.which}, the model has {d}.")
    slope = np.polyval(np.polyder([1.0, *c]), multipliers)
    wanted, names = [], []
    for k in range(d) if goal.which is None else [goal.which]:
        z = multipliers[k]
        if goal.which is None and z.imag < 0:
            continue
        if abs(slope[k]) < _SIMPLE:
            raise DefinitionError(
                f"the multiplier {z:.4g} is not simple: its variance is infinite to first "
                "order, so no design can be made for it."
            )
        gradient = -(z ** np.arange(d - 1, -1, -1)) / slope[k]
        name = f"{z.real:.4g}" if z.imag == 0 else f"{z.real:.4g}{z.imag:+.4g}i"
        if goal.part == "modulus":
            wanted.append((z.conj() * gradient).real / abs(z))
            names.append(f"|{name}|")
        elif z.imag == 0:
            wanted.append(gradient.real)
            names.append(name)
        else:
            wanted += [gradient.real, gradient.imag]
            names += [f"Re({name})", f"Im({name})"]
    return np.array(wanted), tuple(names)


def _about_parameters(
    goal: Parameters, model: Model, cosines: Candidates, noise: Float[np.ndarray, " ny"]
) -> Question:
    free = tuple(goal.free)
    wanted = free if goal.wanted is None else tuple(goal.wanted)
    strange = [name for name in wanted if name not in free]
    if strange:
        raise DefinitionError(f"`goal`: '{strange[0]}' is wanted, but not one of `free`, {free}.")
    slopes, candidate = [], []
    for i, here in _by_channel(cosines):
        htf = _measured(model, cosines, here, goal.harmonics, noise, i)
        observed = ObservedHTF(htf, goal.sections)
        seen = identifiability(goal.cycle.system, observed, free, guess=goal.cycle)
        if not seen.complete:
            lost = "; ".join(seen.descriptions())
            raise DefinitionError(f"the data cannot see {lost}: leave it out of `free`.")
        slopes.append(seen.sensitivity.T)
        shape = 2, len(htf.harmonics), len(here), htf.H[0, 0].size
        candidate.append(np.broadcast_to(here[:, None], shape).ravel())
    sensitivities = DirectSensitivities(np.concatenate(candidate), np.concatenate(slopes, axis=1))
    rows = np.eye(len(free))[[free.index(name) for name in wanted]]
    return Question(sensitivities, rows, wanted, free, goal.criterion)


def _by_channel(cosines: Candidates) -> list[tuple[int, Int[np.ndarray, " k"]]]:
    """Each input that is used, and its cosines."""
    return [(int(i), np.flatnonzero(cosines.channel == i)) for i in np.unique(cosines.channel)]


def _measured(
    model: Model,
    cosines: Candidates,
    here: np.ndarray,
    harmonics: Harmonics,
    noise: Float[np.ndarray, " ny"],
    channel: int,
) -> HTF:
    r"""The HTFs of one input and the measured outputs, with the variance that power 1 gives.

    $v = 4 \sigma^2 / (N P \sum a^2)$ (`Design.expected_variance`), where the sum of a^2/2 over all
    experiments is the power times their number.
    """
    seen = np.flatnonzero(np.isfinite(noise))
    htf = model.htf(cosines.f[here], harmonics)
    H = np.asarray(htf.H)[:, :, seen, channel : channel + 1]
    variance = 2 * noise[seen] ** 2 / (cosines.n_sections * cosines.strides)
    return HTF(
        htf.f, H, htf.harmonics, htf.n_sections, (model.inputs[channel],),
        tuple(model.outputs[i] for i in seen),
        variance=np.broadcast_to(variance[:, None], H.shape),
    )  # fmt: skip
