"""The cosines among which a design divides power (`Candidates`), the signals that they cause, and
their measurement (`Noise`, `Measured`).

All other files of `designs` use `Candidates`. `mean_squares` gives the power of each signal per
unit of power of each cosine, for limits; `measured_htfs` gives the HTFs with their variances, for
criteria. `draw_models` is public: models from the confidence region of an estimate.

The order of the cosines (by line, then by input) must stay: powers, limits and criteria are arrays
in this order. If all standard errors are wrong by one factor, look at `measured_htfs` and
`make_noise`; if a limit holds for another rms than predicted, at `mean_squares`; if a design is
refused, at `Candidates.of`.
"""

import dataclasses
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Complex, Float, Int

from .._core.arguments import require_among
from .._core.boundary.checked import checked
from .._core.boundary.kinds import Count, Positive, Seed
from ..errors import DefinitionError
from ..experiments.design.design import Design
from ..experiments.design.partition import is_half_integer
from ..identify.joint.fit import LDTPFit
from ..identify.multipliers import StructuredFit
from ..linear.frequency_response import Harmonics
from ..linear.htf import HTF
from ..linear.ldtp import LDTP


Model = LDTP | StructuredFit
Powers = Float[np.ndarray, " K"]
Kept = Int[np.ndarray, " k"]
"""Indices of the cosines that remain, in ascending order."""
Squares = dict[str, Powers]
"""Mean square of each signal, by name, per unit of each cosine's power."""
NoiseLike = Mapping[str, Positive | Callable[[np.ndarray], np.ndarray]] | Positive

# Default noise, relative to the rms of the output in the usual design: 20 dB. It scales all
# standard errors; the optimal powers depend only on the ratios of the outputs.
_NOISE = 0.1
# Largest number of draws for each model. More: estimates that are nearly unstable are accepted,
# although their stable draws represent the confidence region poorly. Fewer: estimates with slow
# modes are rejected.
_TRIES = 20


class Candidates(NamedTuple):
    """The K cosines of a design, each a line at an input."""

    line: Int[np.ndarray, " K"]
    """j, so that f = j / periods."""
    channel: Int[np.ndarray, " K"]
    """Index of the input."""
    periods: int
    n_sections: int
    cycles: int
    """T, periods of all experiments together."""

    @classmethod
    def of(cls, design: Design) -> "Candidates":
        """Return the cosines of a design.

        **Raises:** `DefinitionError` for multiples of 1/2, and for lines that excite several inputs
        in one experiment.
        """
        half = is_half_integer(design.line, design.periods)
        if half.any():
            raise DefinitionError(
                f"f = {design.frequency[half][0]:g} is a multiple of 1/2: use a `design` without "
                "such lines."
            )
        shared = np.stack([design.experiment, design.line])
        if len(np.unique(shared, axis=1).T) < len(design.line):
            raise DefinitionError(
                "the `design` excites several inputs with one line: use division='random' or "
                "'disjoint'."
            )
        line, channel = np.unique(np.stack([design.line, design.channel]), axis=1)
        return cls(line, channel, design.periods, design.n_sections, design.cycles(0))

    @property
    def f(self) -> Powers:
        """Frequencies, cycles per period."""
        return self.line / self.periods

    def only(self, kept: Kept) -> "Candidates":
        return self._replace(line=self.line[kept], channel=self.channel[kept])

    def responses(
        self, model: Model, harmonics: Harmonics | None = None
    ) -> Complex[np.ndarray, "K M ny"]:
        """Return the HTFs of each cosine's input at its frequency."""
        f, place = np.unique(self.f, return_inverse=True)
        H = np.asarray(model.htf(f, harmonics).H)
        return H[:, place, :, self.channel]

    def places(self, design: Design) -> Int[np.ndarray, " L"]:
        """Return the index of the cosine of each line of a design."""
        inputs = self.channel.max() + 1
        key = self.line * inputs + self.channel
        wanted = design.line * inputs + design.channel
        order = np.argsort(key)
        return order[np.searchsorted(key, wanted, sorter=order)]

    def powers_in(self, design: Design) -> Float[np.ndarray, "E K"]:
        """Return the mean square of each cosine in each experiment of a design."""
        power = np.zeros((design.experiments, len(self.line)))
        square = np.asarray(design.amplitude) ** 2 / 2
        np.add.at(power, (design.experiment, self.places(design)), square)
        return power

    def power_of(self, design: Design) -> Powers:
        """Return the mean square of each cosine over all experiments of a design."""
        return self.powers_in(design).mean(axis=0)


def mean_squares(model: Model, cosines: Candidates) -> Squares:
    """Return the mean squares of inputs, outputs, and rates of inputs.

    The rate is the change from one section to the next: a cosine of f changes by
    $2 \\sin(\\pi f / N)$ times its amplitude.
    """
    half_angle = np.pi * cosines.f / cosines.n_sections
    change = 4 * np.sin(half_angle) ** 2
    squares: Squares = {}
    for i, name in enumerate(model.inputs):
        own = (cosines.channel == i).astype(float)
        squares[name] = own
        squares[f"rate of {name}"] = own * change
    power = np.abs(cosines.responses(model)) ** 2
    outputs = power.sum(axis=1)
    return squares | dict(zip(model.outputs, outputs.T, strict=True))


def rms_of(squares: list[Squares], names: list[str], power: Powers) -> dict[str, float]:
    """Return rms values of signals; of several models the root of the mean square."""
    rms = {}
    for name in names:
        mean_square = np.mean([each[name] @ power for each in squares])
        rms[name] = float(np.sqrt(mean_square))
    return rms


class Noise(NamedTuple):
    """Noise of the outputs that are measured."""

    outputs: Int[np.ndarray, " ny"]
    """Indices of these outputs."""
    spectrum: Callable[
        [Float[np.ndarray, " F"], tuple[int, ...]], Float[np.ndarray, "M F ny"]
    ]
    """The variance of white noise with the same spectral density as at the harmonics m of f."""


def make_noise(model: Model, noise: NoiseLike | None, rms: dict[str, float]) -> Noise:
    """Return the noise that the argument `noise` of `optimal_design` describes.

    **Arguments:** `rms`: values of the outputs in the usual design, for the default.

    **Raises:** `DefinitionError` for outputs that do not exist, and spectra that are not positive.
    """
    outputs = model.outputs
    N = model.n_sections
    if noise is None:
        noise = {name: _NOISE * rms[name] for name in outputs if rms[name] > 0}
    if isinstance(noise, int | float):
        noise = dict.fromkeys(outputs, float(noise))
    require_among("output", noise, outputs, "`noise`: ")
    if not noise:
        raise DefinitionError(
            f"`noise` names no output; outputs are {', '.join(outputs)}."
        )
    measured = {name: noise[name] for name in outputs if name in noise}

    def spectrum(f: np.ndarray, harmonics: tuple[int, ...]) -> np.ndarray:
        shifted = f + np.array(harmonics)[:, None]
        folded = np.abs((shifted + N / 2) % N - N / 2)
        levels = np.empty((*folded.shape, len(measured)))
        for k, (name, level) in enumerate(measured.items()):
            levels[..., k] = _noise_level(name, level, folded)
        return levels**2

    return Noise(np.array([outputs.index(name) for name in measured]), spectrum)


def _noise_level(name: str, level: Any, f: np.ndarray) -> np.ndarray:
    """The standard deviation at frequencies, of a number or of a function of frequency."""
    value = np.asarray(level(f) if callable(level) else level)
    is_real = value.dtype.kind in "fiu" and value.shape in ((), f.shape)
    if not is_real or not ((value > 0) & np.isfinite(value)).all():
        raise DefinitionError(
            f"`noise` of {name} must be positive: one real number, or one per frequency."
        )
    return value


class Measured(NamedTuple):
    """The HTFs from one input to the measured outputs."""

    htf: HTF
    """With variances as large as its values: no unit of the inputs makes them rounding errors."""
    cosines: Int[np.ndarray, " F"]
    """Indices of the candidates at these frequencies."""
    channel: int
    weight: float
    """Factor by which errors with the variances of `htf` exceed the errors at power 1."""


def measured_htfs(
    model: Model,
    cosines: Candidates,
    harmonics: Harmonics | None,
    noise: Noise,
) -> Iterator[Measured]:
    r"""Yield the HTFs of each input that is used.

    The variance is $v = 4 S / (N P \sum a^2)$ (`Design.expected_variance`), where the sum of
    a^2/2 over all experiments is the power times their number, and S the noise's spectrum at the
    harmonic.
    """
    for i in np.unique(cosines.channel):
        members = np.flatnonzero(cosines.channel == i)
        htf = model.htf(cosines.f[members], harmonics)
        spectrum = noise.spectrum(cosines.f[members], htf.harmonics)
        samples = cosines.n_sections * cosines.cycles
        variance: Any = 2 * spectrum[..., None] / samples
        H: Any = np.asarray(htf.H)[:, :, noise.outputs, i : i + 1]
        power = np.mean(np.abs(H) ** 2)
        larger = power / np.mean(variance) or 1.0
        htf = dataclasses.replace(
            htf,
            H=H,
            variance=larger * variance,
            inputs=htf.inputs[i : i + 1],
            outputs=tuple(htf.outputs[k] for k in noise.outputs),
        )
        yield Measured(
            htf=htf,
            cosines=members,
            channel=int(i),
            weight=float(np.sqrt(larger)),
        )


@checked
def draw_models(fit: LDTPFit, count: Count, seed: Seed = 0) -> list[LDTP]:
    """Draw stable models from the confidence region of an estimate, for `optimal_design`.

    The draws are Gaussian with the covariance of the fit; those with a multiplier of modulus one or
    more are discarded.

    **Arguments:**

    - `fit`: result of `fit_ldtp`.
    - `count`: number of models.
    - `seed`: seed of the draws. Default: 0.

    **Returns:** a list of `count` models, each an `LDTP` with the sections and signals of the fit.

    **Raises:** `DefinitionError` if hardly any are stable.

    **Example:**

    ```python
    models = hj.designs.draw_models(hj.fit_ldtp(htf, dims=2), 3)
    plan = hj.optimal_design(models, design)
    ```

    **Before:** `hj.fit_ldtp`. **After:** `hj.optimal_design`.
    """
    rng = np.random.default_rng(seed)
    models = []
    root = fit._spread.root
    for _ in range(_TRIES * count):
        moved = fit._coordinates.moved(root @ rng.normal(size=root.shape[1]))
        if np.abs(np.linalg.eigvals(moved.monodromy())).max() < 1:
            models.append(moved.to_ldtp(fit._scale, fit.inputs, fit.outputs))
        if len(models) == count:
            return models
    raise DefinitionError(
        f"`fit` is uncertain, only {len(models)} of {_TRIES * count} models in its confidence "
        "region are stable: measure more before a design is made."
    )
