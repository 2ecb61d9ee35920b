r"""Nonlinear distortion as a limit: the even part of second order.

As a function of the powers p it is a quadratic form. With many lines that is $p^T G p$, whose
matrix is not positive semidefinite: lines whose products meet no resonance distort less together
than their neighbors would. Designs are sought within the smallest convex bound of it that is found,
$p^T Q p$ with $Q \succeq 0$ and $Q \succeq G$, and then scaled to the distortion of the very
experiments.
"""

from collections.abc import Mapping
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

from .._core.boundary.checked import checked
from .._core.boundary.kinds import Positive
from ..errors import DefinitionError
from ..experiments.design.design import Design
from ..orbits.cycle import LimitCycle
from ..sections.families import FamilyLike, as_family
from ..sections.second_order import Quadratic, second_order
from .candidates import Candidates, Kept, Model, Powers


# Relative difference of H_0 beyond which a system is not that of the model. Larger: sections of
# another family pass (the hopper's two differ by 0.5 and more). Smaller: estimates are rejected.
_DIFFERENT = 0.3


@checked
class Distortion(eqx.Module):
    """A limit of the nonlinear distortion of outputs: the rms of the part of second order.

    This is the deviation of `(y(u) + y(-u)) / 2` from the cycle, including the mean, up to fourth
    order in the input. It is computed from exact second derivatives, through all events; they
    compile at the first call, for some ten seconds. Inputs act at all sections; the
    distortion is the same for all models of a design.

    **Arguments:**

    - `cycle`: limit cycle of the known or supposed system; `sections`: the family of sections. A
      design raises an error if its model's H_0 differs from this system's by more than 30 %.
    - `rms`: largest distortion of outputs by name, in their units, over all experiments.

    **Raises:** `DefinitionError` if `rms` is empty.
    """

    cycle: LimitCycle
    sections: FamilyLike
    rms: Mapping[str, Positive]

    def __check_init__(self):
        as_family(self.sections)
        if not self.rms:
            raise DefinitionError("`rms` of a distortion limits nothing: name an output.")


class Products(NamedTuple):
    """The distortion of O outputs, as a form of the powers of K cosines."""

    outputs: tuple[str, ...]
    level: Float[np.ndarray, " O"]
    """Largest rms values."""
    quadratic: Quadratic
    cosines: Candidates
    expected: Float[np.ndarray, "O K K"]
    """Mean square of one experiment with random phases: $p^T M p$."""
    bound: Float[np.ndarray, "O K K"]
    """Q in units of the limit."""

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(f"distortion of {name}" for name in self.outputs)

    def require_those_of(self, model: Model) -> None:
        """**Raises:** `DefinitionError` if the model's transfer functions are different."""
        f, channel = self.cosines.f, self.cosines.channel
        H_here = np.mean(self.quadratic.show @ self.quadratic.waves(f, channel), axis=0)
        H_model = np.asarray(model.htf(f, 0).H)[0, np.arange(len(f)), :, channel]
        for name, H in zip(self.outputs, H_here, strict=True):
            if name not in model.outputs:
                continue
            expected = H_model[:, model.outputs.index(name)]
            difference, size = np.linalg.norm(H - expected), np.linalg.norm(expected)
            if difference > _DIFFERENT * size:
                raise DefinitionError(
                    f"`limit` has the distortion of another system than the model: H_0 to {name} "
                    f"differs by {difference / max(size, np.finfo(float).tiny):.0%}. Are its "
                    "sections those of the model?"
                )

    def rms(self, design: Design, phases: bool = False) -> Float[np.ndarray, " O"]:
        """Return the distortion in a design: expected with random phases, or with its `phases`."""
        if phases:
            return np.sqrt(np.mean(self.quadratic.second_order(design.inputs()) ** 2, axis=(0, 1)))
        power = self.cosines.powers_in(design)
        squares = np.einsum("ek,okl,el->o", power, self.expected, power, optimize=True)
        return np.sqrt(np.maximum(squares, 0) / design.experiments)

    def divided(self, kept: Kept, share: Float[np.ndarray, "E k"]) -> Float[np.ndarray, "O k k"]:
        """Return the expected mean square, in units of the limit, as a form of the mean powers of
        cosines whose power in each experiment is a `share` of it."""
        expected = self.expected[:, kept][:, :, kept] / (self.level**2)[:, None, None]
        return expected * (share.T @ share) / len(share)


def products(
    limit: Distortion, cosines: Candidates, inputs: tuple[str, ...], usual: Powers
) -> Products:
    """Return the distortion as a form of powers.

    **Arguments:** `usual`: powers near which the convex bound is to be tight.

    **Raises:** `DefinitionError` for outputs or inputs that do not exist, and another number of
    sections; `ComputationError` as `place_sections`.
    """
    sections = as_family(limit.sections)
    if sections.n_sections != cosines.n_sections:
        raise DefinitionError(
            f"`limit` has the distortion between {sections.n_sections} sections, the model has "
            f"{cosines.n_sections}."
        )
    outputs = tuple(str(n) for n in limit.rms)
    quadratic = second_order(limit.cycle, sections, outputs, inputs)
    pairs = quadratic.products(cosines.f, cosines.channel)
    level = np.array([float(x) for x in limit.rms.values()])
    bound = np.array([_convex(form, usual) for form in pairs.gaussian()])
    scaled = bound / (level**2)[:, None, None]
    return Products(outputs, level, quadratic, cosines, pairs.cosines(), scaled)


def _convex(form: Float[np.ndarray, "K K"], unit: Powers) -> Float[np.ndarray, "K K"]:
    """Return the nearest positive semidefinite matrix that exceeds the form by another such matrix,
    in units of each cosine's power. (In units in which each alone distorts alike the bound of the
    hopper is up to two times as large where power belongs.)"""
    values, vectors = np.linalg.eigh(form * unit[:, None] * unit)
    return (vectors * np.maximum(values, 0)) @ vectors.T / unit[:, None] / unit
