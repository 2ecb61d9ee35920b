"""Noise in experiments: random inputs (`ProcessNoise`), simulated linear models with such inputs
(`simulate_experiments`), and errors of measurement (`add_noise`).

`run_experiments` takes a `ProcessNoise`, and calls its `draw`. The noise of an experiment depends
on the seed and on the index of the experiment only, so that any part of a set can be computed
alone: this must stay so. If noise has a wrong variance or correlation, look at `draw` and
`with_memory`; if linear responses are wrong, at `linear/time_response.py`.
"""

import dataclasses
from typing import Annotated, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from .._core.arguments import require_axes
from .._core.boundary.checked import checked
from .._core.boundary.kinds import Index, NonNegative, Numbers, SectionCount, Seed
from .._core.boundary.values import Reals
from ..errors import DefinitionError
from ..linear.ldtp import LDTP
from .data import ExperimentData
from .design.design import DISCARD, Design, require_inputs


@checked
@dataclasses.dataclass(frozen=True)
class ProcessNoise:
    r"""A random input that is added to the excitation and is not recorded. It is held
    from section to section. At section n of the experiment, it is $\sigma_{n \bmod N}
    z_n$, where z is a first-order autoregressive series (AR(1)) of variance 1.

    **Fields:**

    - `std`: standard deviation, in units of the inputs. It is one number, or N numbers,
      one for each section; with N numbers the noise is cyclostationary.
    - `seed`: seed of the random numbers. Default: 0.
    - `memory`: correlation time in cycles. The correlation of noise k sections apart is
      $e^{-k / (N \tau)}$. The noise is stationary from the start of an experiment on. Default: 0,
      white noise.

    **Example:**

    ```python
    gusts = hj.experiments.ProcessNoise(std=1e-4, seed=1)
    noisy = hj.experiments.simulate_experiments(model, design, process_noise=gusts)
    ```

    **After:** `hj.run_experiments`, `hj.experiments.simulate_experiments`.
    """

    std: Annotated[Numbers, Reals(sign="nonnegative")]
    seed: Seed = 0
    memory: NonNegative = 0.0

    def __post_init__(self):
        # (As numbers and tuples, which can be compared and stored as JSON; arrays cannot.)
        plain = np.asarray(self.std).tolist()
        object.__setattr__(
            self, "std", tuple(plain) if isinstance(plain, list) else plain
        )

    def draw(
        self, shape: tuple[int, ...], n_sections: SectionCount, first: Index = 0
    ) -> Float[np.ndarray, "S n nu"]:
        """Return the noise of consecutive experiments of a set, which begin at section 0.

        **Arguments:** `shape`: (S, n, nu). `n_sections`: N. `first`: index of the first experiment
        in the set. The noise of an experiment depends on its index only, so a set can be run in
        parts.

        **Raises:** `DefinitionError` for a `std` of another number of sections.
        """
        self.require(n_sections)
        each = (np.random.default_rng((self.seed, first + s)) for s in range(shape[0]))
        white = np.reshape([rng.normal(size=shape[1:]) for rng in each], shape)
        return np.resize(self.std, shape[1])[:, None] * with_memory(
            white, self.memory, n_sections
        )

    def require(self, n_sections: SectionCount) -> None:
        """**Raises:** `DefinitionError` if `std` has entries for another number of sections."""
        require_axes("`std` of `process_noise`", self.std, {}, {"sections": n_sections})


def with_memory(
    white: Float[np.ndarray, "S n k"], memory: float, n_sections: int
) -> Float[np.ndarray, "S n k"]:
    """Return stationary series of the same variance, with a correlation time of `memory` cycles."""
    if memory == 0 or white.shape[1] == 0:
        return white
    from scipy.signal import lfilter  # takes long to import

    step = np.exp(-1 / (n_sections * memory))
    fresh = np.sqrt(-np.expm1(-2 / (n_sections * memory)))
    later, _ = lfilter(
        [fresh], [1, -step], white[:, 1:], axis=1, zi=step * white[:, :1]
    )
    return np.concatenate([white[:, :1], later], axis=1)


@checked
def simulate_experiments(
    ldtp: LDTP,
    design: Design,
    *,
    discard: Index | None = None,
    start: Literal["cycle", "periodic"] = "cycle",
    process_noise: ProcessNoise | None = None,
) -> ExperimentData:
    """Run a design on a linear periodic model, from section 0.

    **Arguments:**

    - `ldtp`: the model. `design`: a design with the same N and number of inputs.
    - `start`: "cycle" starts at zero, which is the limit cycle, so that a transient decays during
      the first cycles; "periodic" starts in the periodic response, without a transient.
    - `discard`: cycles before the window of P periods. Default: 20 from the cycle (as in the
      paper), 0 from a periodic start.
    - `process_noise`: a random input that is added to the excitation and is not recorded.

    **Returns:** `ExperimentData` with `discard + P` cycles.

    **Raises:** `DefinitionError` if N (also of the process noise) or the inputs differ, if cycles
    of an unstable model are discarded, or if a periodic response does not exist (a multiplier that
    is a P-th root of one).

    **Example:**

    ```python
    linear = hj.experiments.simulate_experiments(model, design, start="periodic")
    print(hj.estimate_htf(linear))
    ```

    **Before:** `hj.linearize` or `hj.fit_ldtp`, and `hj.multisine`. **After:**
    `hj.experiments.add_noise`, `hj.estimate_htf`.
    """
    require_inputs(design, "model", ldtp.n_sections, ldtp.inputs)
    if discard is None:
        discard = DISCARD if start == "cycle" else 0
    if start == "cycle" and discard and (np.abs(ldtp.multipliers) >= 1).any():
        raise DefinitionError(
            'the model is unstable: use start="periodic", or discard=0 for the transient itself.'
        )
    u = design.signals(design.periods + discard)
    x0 = None
    if start == "periodic":
        x0 = ldtp.periodic_states(design.signals(), design.periods)
    applied = u
    if process_noise is not None:
        applied = u + process_noise.draw(u.shape, design.n_sections)
    return ExperimentData(
        u,
        _simulate(ldtp, jnp.asarray(applied), x0),
        n_sections=design.n_sections,
        periods=design.periods,
        inputs=ldtp.inputs,
        outputs=ldtp.outputs,
    )


_simulate = eqx.filter_jit(lambda ldtp, u, x0: jax.vmap(ldtp.simulate)(u, x0))


@checked
def add_noise(
    data: ExperimentData,
    std: Annotated[Numbers, Reals(sign="nonnegative")] | None = None,
    *,
    snr: float | None = None,
    memory: NonNegative = 0.0,
    seed: Seed = 0,
) -> ExperimentData:
    """Add measurement noise to all outputs of all samples, independent from output to output.

    **Arguments:**

    - `data`: `ExperimentData`.
    - `std`: standard deviation in units of the outputs: one number, one for each output, or (N, ny)
      also by section. Give either `std` or `snr`.
    - `snr`: signal-to-noise ratio in dB, for each output: 10 log10 of a ratio of variances. The
      signal is the deviation of the output from the cycle (over all samples and OK experiments).
    - `memory`: correlation time in cycles, as in `ProcessNoise`. Default: 0, white noise.
    - `seed`: seed of the random numbers. Default: 0.

    **Returns:** `ExperimentData` with the noise in `y` (S, n, ny).

    **Raises:** `DefinitionError` unless exactly one of `std` and `snr` is given, with a shape that
    fits the outputs and sections.

    **Example:**

    ```python
    noisy = hj.experiments.add_noise(data, std=1e-4)
    loud = hj.experiments.add_noise(data, snr=20.0, seed=1)
    ```

    **Before:** `hj.run_experiments` or `hj.experiments.simulate_experiments`. **After:**
    `hj.estimate_htf`, `hj.fit_series`.
    """
    if (std is None) == (snr is None):
        raise DefinitionError("add_noise needs either `std` or `snr`.")
    if snr is not None:
        data.require_ok()
        rms = np.sqrt(np.mean(data.y[data.ok] ** 2, axis=(0, 1)))
        std = rms * 10 ** (-snr / 20)
    std = np.asarray(std)
    N = data.n_sections
    ny = data.y.shape[2]
    require_axes("`std`", std, {}, {"outputs": ny}, {"sections": N, "outputs": ny})
    white = np.random.default_rng(seed).normal(size=data.y.shape)
    each = np.resize(np.broadcast_to(std, (N, ny)), data.y.shape[1:])
    return eqx.tree_at(
        lambda d: d.y, data, data.y + each * with_memory(white, memory, N)
    )
