r"""Distortion as a limit: what the even part of second order may be.

Of powers p it is a quadratic form. With many lines that is $p^T G p$, whose matrix is not positive
semidefinite: lines whose products meet no resonance disturb less together than their neighbors
would. Designs are sought within the smallest convex bound of it that is found, $p^T Q p$ with
$Q \succeq 0$ and $Q \succeq G$, and then made as large as the distortion of the very experiments
allows.
"""

from collections.abc import Mapping
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from ..._core.boundary.checked import checked
from ..._core.boundary.kinds import Positive
from ...errors import DefinitionError
from ...experiments.design.design import Design
from ...orbits.cycle import LimitCycle
from ...sections.families import FamilyLike, as_family
from ...sections.second_order import Quadratic, second_order
from ..candidates import Candidates
from ..signals import Model


# Relative difference of H_0 beyond which a system is not that of the model. Those of the hopper
# between the paper's two families differ by 0.5 and more. Doubled: such a mistake would pass.
_ANOTHER = 0.3


@checked
class Distortion(eqx.Module):
    """What is not linear in outputs, as a limit: the rms of the part of second order.

    It is what `(y(u) + y(-u)) / 2` differs by from the cycle, including the mean, up to fourth
    order in the input. Exact second derivatives tell it, through all events; they compile at the
    first call, for some ten seconds. Inputs act as they are (no `Window`); of several models there
    is one distortion. A model that responds in another way than `cycle` between `sections` is
    refused where H_0 differs by more than 30 %.

    **Arguments:**

    - `cycle`: of the system that is known, or supposed; `sections`: the family.
    - `rms`: of the distortion of outputs by name, in their units, over all experiments.

    **Raises:** `DefinitionError` if `rms` is empty.
    """

    cycle: LimitCycle
    sections: FamilyLike
    rms: Mapping[str, Positive]

    def __check_init__(self):
        as_family(self.sections)
        if not self.rms:
            raise DefinitionError("`rms` of a distortion limits nothing: name an output.")


def distortion_of(name: str) -> str:
    return f"distortion of {name}"


class Products(NamedTuple):
    """The distortion of O outputs, as a form of the powers of K cosines."""

    names: tuple[str, ...]
    level: Float[np.ndarray, " O"]
    """rms values that are allowed."""
    quadratic: Quadratic
    cosines: Candidates
    expected: Float[np.ndarray, "O K K"]
    """Mean square of one experiment with random phases: $p^T M p$."""
    bound: Float[np.ndarray, "O K K"]
    """Q."""

    def require_those_of(self, model: Model) -> None:
        """**Raises:** `DefinitionError` if the model responds in another way."""
        f, channel = self.cosines.f, self.cosines.channel
        own = np.mean(self.quadratic.show @ self.quadratic.waves(f, channel), axis=0)
        of_model = np.asarray(model.htf(f, 0).H)[0, np.arange(len(f)), :, channel]
        for name, H in zip(self.names, own, strict=True):
            if name not in model.outputs:
                continue
            other = of_model[:, model.outputs.index(name)]
            off, size = np.linalg.norm(H - other), np.linalg.norm(other)
            if off > _ANOTHER * size:
                raise DefinitionError(
                    f"`limit` tells the distortion of another system than the model: H_0 to {name} "
                    f"differs by {off / max(size, np.finfo(float).tiny):.0%}. Are its sections "
                    "those of the model?"
                )

    @property
    def limited(self) -> tuple[str, ...]:
        return tuple(map(distortion_of, self.names))

    @property
    def curved(self) -> Float[np.ndarray, "O K K"]:
        """Q in units of what is allowed."""
        return self.bound / (self.level**2)[:, None, None]

    def rms(self, design: Design, phases: bool = False) -> Float[np.ndarray, " O"]:
        """Of the distortion in a design: expected with random phases, or with its own `phases`."""
        if phases:
            return np.sqrt(np.mean(self.quadratic.second_order(design.inputs()) ** 2, axis=(0, 1)))
        power = self.powers(design)
        squares = np.einsum("ek,okl,el->o", power, self.expected, power, optimize=True)
        return np.sqrt(np.maximum(squares, 0) / design.experiments)

    def powers(self, design: Design) -> Float[np.ndarray, "E K"]:
        """Of each cosine in each experiment."""
        power = np.zeros((design.experiments, len(self.cosines.line)))
        square = np.asarray(design.amplitude) ** 2 / 2
        np.add.at(power, (design.experiment, self.cosines.places(design)), square)
        return power

    def divided(
        self, kept: Int[np.ndarray, " k"], share: Float[np.ndarray, "E k"]
    ) -> Float[np.ndarray, "O k k"]:
        """Expected mean square, in units of what is allowed, as a form of the mean powers of some
        cosines, whose power in each experiment is a `share` of it."""
        some = self.expected[:, kept][:, :, kept] / (self.level**2)[:, None, None]
        return some * (share.T @ share) / len(share)


def products(
    limit: Distortion,
    cosines: Candidates,
    inputs: tuple[str, ...],
    usual: Float[np.ndarray, " K"],
) -> Products:
    """**Arguments:** `usual`, powers about which the convex bound is to be close.

    **Raises:** `DefinitionError` for outputs or inputs that do not exist, and another number of
    sections; `ComputationError` as `place_sections`."""
    sections = as_family(limit.sections)
    if sections.n_sections != cosines.n_sections:
        raise DefinitionError(
            f"`limit` tells the distortion between {sections.n_sections} sections, the model has "
            f"{cosines.n_sections}."
        )
    names = tuple(str(n) for n in limit.rms)
    quadratic = second_order(limit.cycle, sections, names, inputs)
    pairs = quadratic.products(cosines.f, cosines.channel)
    level = np.array([float(x) for x in limit.rms.values()])
    bound = np.array([_convex(one, usual) for one in pairs.gaussian()])
    return Products(names, level, quadratic, cosines, pairs.cosines(), bound)


def _convex(
    form: Float[np.ndarray, "K K"], unit: Float[np.ndarray, " K"]
) -> Float[np.ndarray, "K K"]:
    """The nearest positive semidefinite matrix, which exceeds the form by another such matrix, in
    units of each cosine's power. (In units in which each alone distorts alike the bound of the
    hopper is up to two times as large where power belongs.)"""
    values, vectors = np.linalg.eigh(form * unit[:, None] * unit)
    return (vectors * np.maximum(values, 0)) @ vectors.T / unit[:, None] / unit
