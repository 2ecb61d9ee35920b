"""Periodic systems as time-invariant ones: lifted, with samples of whole periods; harmonic.

Lifting (Bittanti and Colaneri, *Periodic Systems*, 2009, sec. 6.2) stacks the inputs and outputs of
all sections of a period.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .._core.arguments import package
from .._core.boundary.checked import checked
from .._core.boundary.kinds import Count, Positive, SignalNames
from .._core.executor import is_traced
from .._core.precision import require_x64
from .._core.signal import Signal, unit_of
from ..linear.htf import HTF
from ..linear.ldtp import LDTP
from ..orbits.continuous_htf import HarmonicStateSpace, harmonic_state_space
from ..orbits.cycle import LimitCycle
from ..systems.system import OutputNames


@checked
def to_lti(model: LDTP) -> LDTP:
    r"""Return the same system with one sample for each period.

    Sample k of the result has the state at section 0 of period k; the inputs `u[n]`, held from
    section n of that period on; and the outputs `y[n]` at section n of the *same* period, before
    `u[n]` acts except through the feed-through D. So the outputs of a period depend on the inputs
    of the same period: the new D holds the responses within a period (zero for later inputs), C the
    map from section 0 to each section, B the map from each input to section 0 of the next period,
    and A is the monodromy matrix. Names are `u[0]`, ..., `u[N-1]` for an input `u`; all inputs of
    section 0 come first, then the inputs of section 1.

    Its response G at $z = e^{2 \pi i f}$, f in cycles per period, holds all harmonics:
    $H_m(f) = \frac{1}{N} \sum_{n, r} G_{n r}\, e^{-2 \pi i (f + m) n / N} e^{2 \pi i f r / N}$.

    **Returns:** an `LDTP` of one section, with the dimension of the state at section 0.

    **Raises:** `PrecisionError` in single precision.
    """
    require_x64(model)
    A, B, C, D, d, ny = model.A, model.B, model.C, model.D, model.A.shape[-1], len(model.outputs)
    N, _, nu = B.shape

    def advance(carry, section):
        # The state at section n: from that at section 0, and from the inputs since then.
        from_state, from_inputs = carry
        n, A, B, C, D = section
        rows = C @ from_state, jnp.einsum("ij,jkl->ikl", C, from_inputs).at[:, n].set(D)
        return (A @ from_state, jnp.einsum("ij,jkl->ikl", A, from_inputs).at[:, n].set(B)), rows

    carry = jnp.eye(d), jnp.zeros((d, N, nu))
    (A, B), (C, D) = jax.lax.scan(advance, carry, (jnp.arange(N), A, B, C, D))
    first = d if is_traced(model.dims) else int(np.asarray(model.dims)[0])
    return LDTP(
        A[None, :first, :first],
        B.reshape(1, d, N * nu)[:, :first],
        C.reshape(1, N * ny, d)[:, :, :first],
        D.reshape(1, N * ny, N * nu),
        inputs=_at_sections(model.inputs, N),
        outputs=_at_sections(model.outputs, N),
        coordinates=None if model.coordinates is None else model.coordinates[:1],
    )


def _at_sections(names: tuple[str, ...], n_sections: int) -> tuple[str, ...]:
    return tuple(Signal(f"{x}[{n}]", unit_of(x)) for n in range(n_sections) for x in names)


@checked
def to_control(thing: LDTP | HTF, *, period: Positive = 1.0) -> Any:
    """Return an object of python-control.

    - An `LDTP` becomes a `control.StateSpace` of its lifted system (`to_lti`), with dt = `period`.
    - An `HTF` becomes a `control.FrequencyResponseData` with an output `y[m]` for each output y and
      harmonic m: `H_m` at the *input* frequency. All outputs of the first harmonic come first.

    **Arguments:** `period`: the length of a period, in seconds for example. Default: 1, so that
    times are counted in periods.

    **Raises:** `DefinitionError` where python-control is not installed.
    """
    if isinstance(thing, LDTP):
        lti = to_lti(thing)
        names = {"inputs": list(map(str, lti.inputs)), "outputs": list(map(str, lti.outputs))}
        return package("control").StateSpace(*_matrices(lti), period, **names)
    inputs = list(map(str, thing.inputs))
    outputs = [f"{y}[{m}]" for m in thing.harmonics for y in thing.outputs]
    H = np.moveaxis(np.asarray(thing.H), 1, -1).reshape(len(outputs), len(inputs), -1)
    frequencies = 2 * np.pi * np.asarray(thing.f) / period
    about = {"inputs": inputs, "outputs": outputs, "sysname": "HTF"}
    return package("control").FrequencyResponseData(H, frequencies, **about)


@checked
def to_harmonic_state_space(
    cycle: LimitCycle,
    order: Count | None = None,
    *,
    outputs: OutputNames | None = None,
    inputs: SignalNames | None = None,
    tolerance: Positive = 1e-6,
) -> HarmonicStateSpace:
    """Return the harmonic state space of a cycle: Toeplitz matrices of the Fourier coefficients of
    its linearization in continuous time, truncated at an order (see `HarmonicStateSpace`).

    `cycle.htf` gives the same responses without truncation.

    **Arguments:**

    - `order`: the largest harmonic. Default: the first of 2, 4, ..., 64 whose `error` beside
        `cycle.htf` is below `tolerance` (Default: 1e-6).
    - `outputs`, `inputs`: as of `LimitCycle.htf`.

    **Raises:** `DefinitionError` for cycles with events at which deviations jump;
    `ComputationError` if no order is large enough.
    """
    return harmonic_state_space(cycle._course(), order, tolerance, outputs, inputs)


@checked
def to_scipy(model: LDTP, *, period: Positive = 1.0) -> Any:
    """Return the lifted system (`to_lti`) as `scipy.signal.dlti`, with dt = `period`."""
    from scipy.signal import dlti

    return dlti(*_matrices(to_lti(model)), dt=period)


def _matrices(lti: LDTP) -> list[np.ndarray]:
    return [np.asarray(x[0]) for x in (lti.A, lti.B, lti.C, lti.D)]
