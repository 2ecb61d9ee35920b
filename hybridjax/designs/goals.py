"""What one wants to know."""

from collections.abc import Sequence
from typing import Literal

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from .._core.boundary.checked import checked
from .._core.boundary.kinds import Index, SignalNames
from ..errors import DefinitionError
from ..fitting.fit import identifiability
from ..fitting.observations import ObservedHTF
from ..identify.multipliers.structured import StructuredFit
from ..linear.frequency_response import Harmonics
from ..linear.htf import HTF
from ..linear.ldtp import LDTP
from ..orbits.cycle import LimitCycle
from ..sections.section_list import FamilyLike
from .allocation import Question
from .candidates import Candidates
from .sensitivities import DirectSensitivities, denominator_sensitivities


Model = LDTP | StructuredFit
Criterion = Literal["A", "D"]

# Multipliers whose polynomial has a smaller slope than that are not simple. Doubled: of two that
# are twice as far apart no first-order variance is given.
_SIMPLE = 1e-6


@checked
class Multipliers(eqx.Module):
    """The Floquet multipliers, as `fit_multipliers` finds them, with all numerators unknown.

    **Arguments:**

    - `which`: index of the only multiplier to ask for, as `model.multipliers` has them; None asks
      for all, a conjugate pair once.
    - `part`: `"position"`, real and imaginary parts, or `"modulus"`.
    - `criterion`: `"A"`, the sum of the variances, or `"D"`, the volume of the ellipsoid.
    - `harmonics` and `overhang`: those of the fit.
    """

    which: Index | None = eqx.field(static=True, default=None)
    part: Literal["position", "modulus"] = eqx.field(static=True, default="position")
    criterion: Criterion = eqx.field(static=True, default="A")
    harmonics: Harmonics = eqx.field(static=True, default=(-2, -1, 0, 1, 2))
    overhang: Index | None = eqx.field(static=True, default=None)

    def question(
        self, model: Model, cosines: Candidates, noise: Float[np.ndarray, " ny"]
    ) -> Question:
        """**Arguments:** `noise`, the standard deviation at the sections, infinite for outputs that
        are not measured.

        **Raises:** `DefinitionError` for a multiplier that does not exist or is not simple, and
        where the cosines cannot tell the multipliers."""
        multipliers = np.asarray(model.multipliers)
        c = np.poly(multipliers).real[1:]
        channels = _by_channel(cosines)
        htfs = [_measured(model, cosines, here, self.harmonics, noise, i) for i, here in channels]
        members = [here for _, here in channels]
        sensitivities = denominator_sensitivities(htfs, members, c, self.overhang)
        wanted, names = self._wanted(multipliers, c)
        unknowns = tuple(f"c{k}" for k in range(1, len(c) + 1))
        return Question(sensitivities, wanted, names, unknowns, self.criterion)

    def _wanted(self, multipliers, c):
        """Derivatives of real and imaginary parts, or moduli, by c, and their names."""
        d = len(c)
        if d == 0:
            raise DefinitionError("the model has no multipliers but zero: nothing decays slowly.")
        if self.which is not None and self.which >= d:
            raise DefinitionError(f"there is no multiplier {self.which}: the model has {d}.")
        slope = np.polyval(np.polyder([1.0, *c]), multipliers)
        wanted, names = [], []
        for k in range(d) if self.which is None else [self.which]:
            z = multipliers[k]
            if self.which is None and z.imag < 0:
                continue
            if abs(slope[k]) < _SIMPLE:
                raise DefinitionError(
                    f"the multiplier {z:.4g} is not simple: its variance is infinite to first "
                    "order, so no design can be made for it."
                )
            gradient = -(z ** np.arange(d - 1, -1, -1)) / slope[k]
            name = f"{z.real:.4g}" if z.imag == 0 else f"{z.real:.4g}{z.imag:+.4g}i"
            if self.part == "modulus":
                wanted.append((z.conj() * gradient).real / abs(z))
                names.append(f"|{name}|")
            elif z.imag == 0:
                wanted.append(gradient.real)
                names.append(name)
            else:
                wanted += [gradient.real, gradient.imag]
                names += [f"Re({name})", f"Im({name})"]
        return np.array(wanted), tuple(names)


@checked
class Parameters(eqx.Module):
    """Physical parameters, as `fit_model` finds them from HTFs: their relative errors.

    The derivatives are exact, through the limit cycle and its sections; they compile at the first
    call, for a minute or so.

    **Arguments:**

    - `cycle`: of the system whose parameters are looked for; `sections`: the family.
    - `free`: names of all parameters that are unknown; `wanted`: those one asks for, None for all.
    - `criterion`: `"A"` or `"D"`, as for `Multipliers`. `harmonics`: those of the HTFs.
    """

    cycle: LimitCycle
    sections: FamilyLike
    free: SignalNames = eqx.field(static=True)
    wanted: SignalNames | None = eqx.field(static=True, default=None)
    criterion: Criterion = eqx.field(static=True, default="A")
    harmonics: Harmonics = eqx.field(static=True, default=(-2, -1, 0, 1, 2))

    def question(
        self, model: Model, cosines: Candidates, noise: Float[np.ndarray, " ny"]
    ) -> Question:
        """As of `Multipliers`.

        **Raises:** `DefinitionError` for parameters that do not exist, and combinations that the
        data cannot see, which are named."""
        free = self.free
        wanted = free if self.wanted is None else self.wanted
        strange = [name for name in wanted if name not in free]
        if strange:
            raise DefinitionError(f"'{strange[0]}' is wanted, but not one of `free`: {free}.")
        slopes, candidate = [], []
        for i, here in _by_channel(cosines):
            htf = _measured(model, cosines, here, self.harmonics, noise, i)
            observed = ObservedHTF(htf, self.sections)
            seen = identifiability(self.cycle.system, observed, free, guess=self.cycle)
            if not seen.complete:
                lost = "; ".join(seen.descriptions())
                raise DefinitionError(f"the data cannot see {lost}: leave it out of `free`.")
            slopes.append(seen.sensitivity.T)
            shape = 2, len(htf.harmonics), len(here), htf.H[0, 0].size
            candidate.append(np.broadcast_to(here[:, None], shape).ravel())
        sensitivities = DirectSensitivities(
            np.concatenate(candidate), np.concatenate(slopes, axis=1)
        )
        rows = np.eye(len(free))[[free.index(name) for name in wanted]]
        return Question(sensitivities, rows, tuple(wanted), free, self.criterion)


Goal = Multipliers | Parameters


def _by_channel(cosines: Candidates) -> list[tuple[int, Int[np.ndarray, " k"]]]:
    """Each input that is used, and its cosines."""
    return [(int(i), np.flatnonzero(cosines.channel == i)) for i in np.unique(cosines.channel)]


def _measured(
    model: Model,
    cosines: Candidates,
    here: np.ndarray,
    harmonics: Sequence[int] | int,
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
