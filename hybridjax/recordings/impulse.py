"""Phase-dependent impulse responses: the effect of a brief push on the outputs, by the phase of the
push and the time since the push.

`impulse_responses` computes them from a `SeriesFit`, with standard errors, and returns
`ImpulseResponses`. The response continues beyond the fitted lags by the recursion from cycle to
cycle (`whole`). A push is as short as the band of the input allows (`_push`, `_smeared`). Up to
`_by_push`, responses have the lag as their first axis, and then the section of the output; only
`_by_push` turns that into the section of the push.

If responses are shifted in phase or lag, look at `_by_push`, and at `fit.lead` in `pushed`; if they
have the wrong scale, at `_durations` (the area of a push); if errors are wrong, at `_slopes`.
"""

from typing import Annotated, Any

import equinox as eqx
import numpy as np
from jaxtyping import Float
from scipy import ndimage, signal

from .._core.arguments import require_same
from .._core.boundary.checked import checked
from .._core.boundary.values import Number
from .._core.showable import Showable
from .._core.text import fields
from ..errors import DefinitionError
from ..experiments.record import average_cycle
from ..identify.series.fit import SeriesFit
from ..linear.ldtp import LDTP
from .data import WHOLE_BAND, SectionData, input_band
from .smoothing import Series


# The edge of the band is at this many standard deviations of the push's spectrum, where 4 % are
# left. More: pushes are wider. Fewer: the push has power beyond the band.
_SPECTRUM_REACH = 2.5
# The push is cut off at this many standard deviations, where 1 % of its peak is left. More: pushes
# take longer. Fewer: the push begins and ends with a jump.
_PUSH_REACH = 3

Responses = Float[np.ndarray, "N lags ny nu"]


class ImpulseResponses(Showable, eqx.Module):
    r"""Outputs after a brief push of area 1, for each phase at which it acts.

    The impulse response of a periodic system depends on two times; neuromechanics calls it the
    phase-dependent impulse response function (Kiemel, Logan and Jeka, arXiv 1607.01746, 2016).

    **Fields:**

    - `values` (N, lags, ny, nu): `[m, r]` is the response r sections after section m, at which the
      push acts, divided by its area (input times time).
    - `errors`: their standard errors.
    - `phase` (N,): phase of the push. `lag` (lags,): time since then. Both in cycles.
    - `width`: standard deviation of the push, in cycles; 0 for a push that lasts for one section.
    - `durations` (N,): mean time from each section to the next. `inputs`, `outputs`.
    """

    values: Responses
    errors: Responses
    phase: Float[np.ndarray, " N"]
    lag: Float[np.ndarray, " lags"]
    width: float = eqx.field(static=True)
    durations: Float[np.ndarray, " N"]
    inputs: tuple[str, ...] = eqx.field(static=True)
    outputs: tuple[str, ...] = eqx.field(static=True)

    __repr__ = fields

    n_sections = property(lambda self: len(self.phase))

    @checked
    def plot(
        self,
        *,
        model: LDTP | None = None,
        input: str | int = 0,
        ax: object = None,
    ) -> Any:
        """Draw the responses of a rhythm to a push against the phase of the push and the time
        since.

        Left: all phases, in colors. Right: curves at the phases marked left, with bands of 95 %.
        Dashed: the responses of a model with the same sections.

        **Arguments:**

        - `model`: an `LDTP` with the same sections, inputs and outputs. Default: None.
        - `input`: name or index of the input that pushes. Default: 0.
        - `ax`: two Axes per output. Default: a new figure.

        **Returns:** `hj.plot.Plot` with `axes` (ny, 2). Time and phase are in cycles, responses in
        units of the output per unit of the input times second.

        **Raises:** `DefinitionError` for an input that does not exist, a model with other sections
        or names, or if `ax` does not hold two Axes per output.

        **Example:**

        ```python
        result.responses.plot(input="u")
        ```
        """
        return super().plot(model=model, input=input, ax=ax)

    @checked
    def of_model(self, model: LDTP) -> Responses:
        """Return the responses of a model to pushes that are held from each section to the next.

        **Raises:** `DefinitionError` if the model has other sections or names.
        """
        require_same("model and responses", model, self)
        N, lags = self.values.shape[:2]
        push = _push(self.width * N)
        h = np.asarray(model.impulse_response(lags + len(push) // 2))
        h = _smeared(h.swapaxes(0, 1), push)[:lags]
        return _by_push(h, self.durations, push)


ResponseCycles = Annotated[
    float, Number("a number above 0, up to 10000", above=0, high=1e4)
]
PushWidth = Annotated[float, Number("a number from 0 to 1000", low=0, high=1e3)]


@checked
def impulse_responses(
    fit: SeriesFit,
    data: SectionData,
    cycles: ResponseCycles | None = None,
    *,
    width: PushWidth | None = None,
) -> ImpulseResponses:
    """Return the responses of a fit to a push at each phase, with standard errors.

    The standard errors are those of white noise. They leave out the change of inputs between one
    section and the next, which a fit takes as constant. The error decreases with the square of
    `n_sections`: it is 0.07 % (rms) of the largest response of the paper's hopper under a force up
    to 8 Hz with 16 sections, and 0.015 % with 32.

    **Arguments:**

    - `fit`: result of `fit_series`.
    - `data`: the data that were fitted; their times give the area of an input that is held for a
      section.
    - `cycles`: duration of the responses. Default: 3, or longer if the push is wide.
    - `width`: standard deviation of the push (Gaussian), in cycles. 0: the push is held for one
      section. Default: the smallest width for which the spectrum of the push lies in the band of
      the inputs, because the response of the system is unknown outside of this band.

    **Returns:** `hj.recordings.ImpulseResponses`: `values` and `errors` (N, lags, ny, nu), in units
    of the output per unit of the input times second; `phase` (N,) and `lag` (lags,), in cycles.

    **Raises:** `DefinitionError` if fit and data have different sections or names.

    **Example:**

    ```python
    responses = hj.recordings.impulse_responses(result.fit, result.data, cycles=2)
    print(responses.values.shape)
    ```

    **Before:** `hj.fit_series`. **After:** `responses.plot()`,
    `hj.recordings.PopulationMaps`.
    """
    require_same("fit and data", fit, data)
    N, R = fit.numerators.shape[:2]
    if width is None:
        edge = min(input_band(data))
        is_narrow = edge < WHOLE_BAND * N / 2
        width = _SPECTRUM_REACH / (2 * np.pi * edge) if is_narrow else 0.0
    if cycles is None:
        cycles = max(3.0, 2 * _PUSH_REACH * width)
    lags = round(cycles * N) + 1
    if lags < 2:
        raise DefinitionError(
            f"`cycles` must hold one section or more, but is {cycles:g}."
        )
    push = _push(width * N)
    reach = len(push) // 2
    if reach >= lags:
        raise DefinitionError(
            f"`width` {width:g} is too large for responses of {cycles:g} cycles: lower it, or "
            "raise `cycles`."
        )
    # Beyond the fitted lags, responses to an input at one section follow a recursion from cycle to
    # cycle.
    recursion = np.zeros(len(fit.coefficients) * N + 1)
    recursion[::N] = [1.0, *fit.coefficients]
    longest = max(fit.lead + lags + reach, R)

    def whole(x: np.ndarray) -> np.ndarray:
        """Return a response, given up to lag R, for all lags, which come first."""
        longer = np.zeros((longest, *x.shape[1:]))
        longer[: len(x)] = x
        return np.asarray(signal.lfilter([1.0], recursion, longer, axis=0))

    def pushed(x: np.ndarray) -> np.ndarray:
        """Return responses to a push, which begins some sections before its middle."""
        return _smeared(whole(x), push)[fit.lead : fit.lead + lags]

    numerators = fit.numerators.swapaxes(0, 1)
    values = pushed(numerators)
    slope = pushed(_slopes(fit, whole(numerators)))
    by_coefficients = np.einsum("ranij,ab,rbnij->rnij", slope, fit.covariance, slope)
    root = pushed(fit.roots.transpose(2, 0, 1, 3, 4))
    square = (root**2).sum(axis=4)
    by_numerators = square * fit.noise[:, None] ** 2
    errors = np.sqrt(by_numerators + by_coefficients)
    durations = _durations(data)
    return ImpulseResponses(
        values=_by_push(values, durations, push),
        errors=_by_push(errors, durations, push),
        phase=np.arange(N) / N,
        lag=np.arange(lags) / N,
        width=float(width),
        durations=durations,
        inputs=fit.inputs,
        outputs=fit.outputs,
    )


def _slopes(
    fit: SeriesFit,
    response: Float[np.ndarray, "longest N ny nu"],
) -> Float[np.ndarray, "longest d N ny nu"]:
    """Return the derivatives of a recursion's right-hand side with respect to c."""
    N, R = fit.numerators.shape[:2]
    longest = len(response)
    shape = (longest, len(fit.coefficients), *response.shape[1:])
    slope = np.zeros(shape)
    slope[:R] = fit.slopes.transpose(2, 0, 1, 3, 4)
    for j in range(slope.shape[1]):
        delay = (j + 1) * N
        slope[delay:, j] -= response[: max(longest - delay, 0)]
    return slope


def _durations(data: SectionData) -> Series:
    """Return the mean time from each section to the next."""
    N = data.n_sections
    section = [x.first_section + np.arange(len(x.u) - 1) for x in data.records]
    steps = np.concatenate([np.diff(t) for t in data.times])
    number = np.concatenate(section) % N
    return average_cycle(number, steps[:, None], N)[:, 0]


def _smeared(h: np.ndarray, push: Series) -> np.ndarray:
    """Return responses to a push that lasts for several sections, from responses to a push of one
    section. The first axis has the lags."""
    return np.asarray(ndimage.correlate1d(h, push, axis=0, mode="constant"))


def _push(width: float) -> Series:
    """A Gaussian of this standard deviation in sections, as weights of sum 1 around its middle."""
    reach = int(np.ceil(_PUSH_REACH * width))
    distance = np.arange(-reach, reach + 1) / max(width, 1e-9)
    weights = np.exp(-0.5 * distance**2)
    return weights / weights.sum()


def _by_push(
    h: Float[np.ndarray, "lags N ny nu"],
    durations: Series,
    push: Series,
) -> Responses:
    """Responses to a push of area 1, indexed by the section of the push, from responses indexed by
    the section of the output."""
    N = len(durations)
    area = ndimage.correlate1d(durations, push, mode="wrap")
    m = np.arange(N)[:, None]
    r = np.arange(len(h))
    area_of_push = area[:, None, None, None]
    return h[r, (m + r) % N] / area_of_push
