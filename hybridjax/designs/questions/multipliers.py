"""Floquet multipliers as functions of the coefficients of their polynomial."""

import dataclasses

import numpy as np
from jaxtyping import Complex, Float

from ...errors import DefinitionError
from ...identify.denominator import multipliers_of
from ..candidates import Candidates
from ..goals import Multipliers
from ..noise import Noise
from ..signals import Model
from .ldtp import ldtp_unknowns
from .measured import measured
from .question import Question, weighted
from .sensitivities import denominator_sensitivities


# Multipliers whose polynomial has a smaller slope than that are not simple. Doubled: of two that
# are twice as far apart no first-order variance is given.
_SIMPLE = 1e-6
# Relative distance up to which a multiplier of a minimal model is that of the whole one. Doubled:
# of two that are twice as far apart the wrong one may be taken.
_SAME = 1e-6
# Harmonics of `fit_multipliers`, where the goal does not say.
FEW = (-2, -1, 0, 1, 2)


def about_multipliers(
    goal: Multipliers,
    model: Model,
    cosines: Candidates,
    noise: Noise,
    power: Float[np.ndarray, " K"],
) -> Question:
    """As `question_of`."""
    if goal.estimator == "fit_ldtp":
        unknowns = ldtp_unknowns(model, cosines, goal.harmonics, noise, power)
        c, slopes = unknowns.characteristic()
        multipliers = multipliers_of(c)
        goal = _of_minimal(goal, np.asarray(model.multipliers), multipliers)
        wanted, names = wanted_parts(goal, multipliers, c)
        wanted, names = weighted(wanted @ slopes, names, goal.weights)
        return unknowns.question(wanted, names, goal.criterion)
    multipliers = np.asarray(model.multipliers)
    c = np.poly(multipliers).real[1:]
    harmonics = FEW if goal.harmonics is None else goal.harmonics
    seen = list(measured(model, cosines, harmonics, noise))
    wanted, names = weighted(*wanted_parts(goal, multipliers, c), goal.weights)
    sensitivities = denominator_sensitivities(seen, c, goal.overhang)
    unknowns = tuple(f"c{k}" for k in range(1, len(c) + 1))
    return Question(sensitivities, wanted, names, unknowns, goal.criterion)


def _of_minimal(
    goal: Multipliers, known: Complex[np.ndarray, " n"], found: Complex[np.ndarray, " d"]
) -> Multipliers:
    """The goal with the number that its multiplier has in a minimal model.

    **Raises:** `DefinitionError` if it is not there.
    """
    if goal.which is None or goal.which >= len(known):
        return goal
    apart = np.abs(found - known[goal.which])
    if not apart.min() < _SAME * np.abs(known).max():
        raise DefinitionError(
            f"no input reaches, or no output that is measured shows, the multiplier "
            f"{known[goal.which]:.4g}."
        )
    return dataclasses.replace(goal, which=int(np.argmin(apart)))


def wanted_parts(
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
