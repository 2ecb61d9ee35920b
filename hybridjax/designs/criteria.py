"""The criterion of each goal: which variance does a design minimize?

`optimize.py` calls `criterion_of` with a goal (multipliers, parameters, responses) and models, and
gets a `Criterion` (`criterion.py`). Each goal has a function, here or in `matrices.py`, that
computes the derivatives of measurements by the unknowns (`Channel`), and those of the wanted
quantities. A further kind of goal is added in `criterion_of`.

If the criterion of multipliers is wrong, compare `_channels` and `wanted_parts` with differences of
the HTFs and of the multipliers. Parameters have their derivatives from `fitting/fit.py`
(`identifiability`); responses, and multipliers of `fit_ldtp`, from `matrices.py`.
"""

import dataclasses
from collections.abc import Iterator
from typing import Literal

import numpy as np
from jaxtyping import Complex, Float, Int

from .._core.arguments import require_among, require_index
from .._core.text import number
from ..errors import DefinitionError
from ..fitting.fit import identifiability
from ..fitting.observations import ObservedHTF
from ..identify.denominator import chi, coefficients_of, multipliers_of
from ..identify.periodic import characteristic_slopes
from ..identify.variable_projection import grouped
from .candidates import Candidates, Measured, Model, Noise, Powers, measured_htfs
from .criterion import Channel, Criterion, LinearCriterion
from .goals import Goal, MultiplierGoal, ParameterGoal
from .matrices import ldtp_matrices, response_criterion


# Exponents of the mean over models. With a larger one for "worst", the mean is closer to the
# largest criterion (within 13 % for ten models now), but the iteration takes shorter steps.
_EXPONENT = {"mean": 1.0, "worst": 16.0}
# A multiplier is double if the relative slope of the polynomial is below this; multipliers of the
# minimal and of the whole model are equal if their relative distance is below this. Larger:
# distinct multipliers count as one. Smaller: rounding separates equal ones.
_SAME = 1e-6


def criterion_of(
    goal: Goal,
    models: list[Model],
    cosines: Candidates,
    noise: Noise,
    power: Powers,
    robust: Literal["mean", "worst"],
) -> Criterion:
    """Return the criterion of a goal for one or several models.

    **Arguments:** `power` of the cosines in the usual design: combinations of matrices that it does
    not determine are left out.

    **Raises:** `DefinitionError` for multipliers that do not exist or are not simple, parameters
    that do not exist, and combinations that the data do not identify, which are named.
    """
    if isinstance(goal, ParameterGoal) and (
        len(models) > 1 or not goal.cycle.is_stable
    ):
        raise DefinitionError(
            "a `goal` of parameters needs a single `model` and a stable `cycle`."
        )
    each = []
    for model in models:
        if isinstance(goal, MultiplierGoal):
            each.append(_multipliers(goal, model, cosines, noise, power))
        elif isinstance(goal, ParameterGoal):
            each.append(_parameters(goal, model, cosines, noise))
        else:
            each.append(response_criterion(goal, model, cosines, noise, power))
    return Criterion(tuple(each), _EXPONENT[robust])


def _multipliers(
    goal: MultiplierGoal,
    model: Model,
    cosines: Candidates,
    noise: Noise,
    power: Powers,
) -> LinearCriterion:
    """Return the criterion of multipliers, as the estimator of the goal estimates them."""
    multipliers = np.asarray(model.multipliers)
    if goal.estimator == "fit_ldtp":
        matrices = ldtp_matrices(model, cosines, goal.harmonics, noise, power)
        c, slopes = characteristic_slopes(matrices.coordinates)
        minimal = multipliers_of(c)
        if goal.which is not None and goal.which < len(multipliers):
            apart = np.abs(minimal - multipliers[goal.which])
            if not apart.min() < _SAME * np.abs(multipliers).max():
                raise DefinitionError(
                    f"no input excites, or no output has, the multiplier "
                    f"{multipliers[goal.which]:.4g}: add an input or an output."
                )
            goal = dataclasses.replace(goal, which=int(np.argmin(apart)))
        wanted, names, part = wanted_parts(goal, minimal, c)
        return matrices.criterion(wanted @ slopes, names, part)
    c = coefficients_of(multipliers)
    htfs = measured_htfs(model, cosines, goal.fitted_harmonics, noise)
    channels = list[Channel]()
    for measured in htfs:
        channels += _channels(measured, c, goal.extra_lags)
    wanted, names, part = wanted_parts(goal, multipliers, c)
    unknowns = tuple(f"c{k}" for k in range(1, len(c) + 1))
    return LinearCriterion(
        names=names,
        unknowns=unknowns,
        channels=tuple(channels),
        wanted=wanted,
        part=part,
    )


def wanted_parts(
    goal: MultiplierGoal,
    multipliers: Complex[np.ndarray, " d"],
    c: Float[np.ndarray, " d"],
) -> tuple[Float[np.ndarray, "rows d"], tuple[str, ...], Int[np.ndarray, " rows"]]:
    """Return derivatives of real and imaginary parts, or moduli, by c; the names of the multipliers
    and moduli, and for each row the index of its name."""
    d = len(c)
    if d == 0:
        raise DefinitionError(
            "all multipliers of the model are zero: choose another `goal`."
        )
    require_index("multiplier", goal.which or 0, d)
    slope = np.polyval(np.polyder(np.array([1.0, *c])), multipliers)
    wanted = list[np.ndarray]()
    names = list[str]()
    part = list[int]()
    if goal.which is None:
        chosen = np.flatnonzero(np.imag(multipliers) >= 0)  # one of each pair
    else:
        chosen = np.array([goal.which])
    for k in chosen:
        z = multipliers[k]
        if abs(slope[k]) < _SAME:
            raise DefinitionError(
                f"the multiplier {z:.4g} is double: choose another `goal`."
            )
        powers = np.arange(d - 1, -1, -1)
        gradient = -(z**powers) / slope[k]
        name = number(z, 4)
        rows = [gradient.real]
        if z.imag != 0:
            rows.append(gradient.imag)
        if goal.part == "modulus":
            rows = [(z.conj() * gradient).real / abs(z)]
            name = f"|{name}|"
        part += [len(names)] * len(rows)
        wanted += rows
        names.append(name)
    return np.array(wanted), tuple(names), np.array(part)


def _parameters(
    goal: ParameterGoal,
    model: Model,
    lines: Candidates,
    noise: Noise,
) -> LinearCriterion:
    """Return the criterion of the relative errors of physical parameters."""
    free = tuple(goal.free)
    wanted = free if goal.quantities is None else tuple(goal.quantities)
    require_among("free parameter", wanted, free, "`quantities` of `goal`: ")
    channels = []
    for htf, members, _, weight in measured_htfs(model, lines, goal.harmonics, noise):
        observed = ObservedHTF(htf, goal.sections)
        data = identifiability(goal.cycle.system, observed, free, guess=goal.cycle)
        if not data.complete:
            lost = "; ".join(data.descriptions())
            raise DefinitionError(
                f"the data do not identify {lost}: leave it out of `free`."
            )
        entries = htf.H[0, 0].size
        shape = 2, len(htf.harmonics), len(members), entries
        cosine = np.broadcast_to(members[:, None], shape).ravel()
        channels.append(Channel(cosine, weight * data.sensitivity))
    rows = np.eye(len(free))[[free.index(name) for name in wanted]]
    return LinearCriterion(
        names=wanted,
        unknowns=free,
        channels=tuple(channels),
        wanted=rows,
        part=np.arange(len(wanted)),
    )


def _channels(
    x: Measured, c: Float[np.ndarray, " d"], extra_lags: int | None
) -> Iterator[Channel]:
    r"""Yield H delayed by 1 to d periods, and the part of it that numerators can explain, from
    $dH = dB/\chi - H\, d\chi/\chi$.

    **Raises:** `DefinitionError` if the HTFs have too few frequencies.
    """
    for group in grouped(x.htf, len(c), extra_lags):
        delay = group.period_delay[:, None]
        slopes = []
        for j in range(1, len(c) + 1):
            slopes.append(group.weighted(c, delay**j * group.data))
        size = group.weight / np.abs(chi(group.period_delay, c))
        size = np.tile(size, 2)
        cosines = np.tile(x.cosines[group.line], 2)
        slope = x.weight * np.concatenate(slopes, axis=1)
        yield Channel(cosines, slope, size[:, None] * group.basis)
