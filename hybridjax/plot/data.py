"""Figures of data: experiments, recordings, impulse responses, phase responses, and the validation
of a model.

Each function draws one type of result. `first_of_data.py` registers them, so that `result.plot()`
finds them; only `phase_response` is also a function of `hj.plot`, with checked arguments. A figure
for a further type is a function here, and a line there. Colors and sizes come from `look.py`, and
may be chosen otherwise. Every figure must also fit into Axes of users: it takes `ax`, and gets its
panels from `look.panels`.

Most functions draw fields of the result as they are: if a figure shows wrong numbers, look at these
first, and then at what is computed here: standard deviations in `section_data`, bands of 1.96
standard errors in `impulse_responses`, the unit of time in `phase_response`, and means over
sections in `_stems`.
"""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from .._core.arguments import channel_index, require_equal, require_index
from .._core.boundary.checked import checked
from .._core.boundary.kinds import PeriodCount
from .._core.results import Result
from .._core.signal import SECONDS, Signal, ratio, square, unit_of, with_unit
from .._core.text import p_value
from ..experiments.data import ExperimentData
from ..identify.validation import Validation
from ..linear.ldtp import LDTP
from ..orbits.responses import PhaseCurve
from ..recordings.beats.response import PhaseResponse
from ..recordings.data import SectionData, input_spectrum
from ..recordings.impulse import ImpulseResponses
from ..recordings.phase import Phase
from . import look
from .look import (
    COLORS,
    COLUMN,
    CYCLE,
    PAGE,
    AxesLike,
    Plot,
    axis_of,
    legend,
    letters,
    panels,
)


def phase(phase: Phase, *, ax: AxesLike | None = None) -> Plot:
    """`phase.plot()`: the periods of the cycles in order, and their distribution."""
    with panels(ax, 1, 2, width=PAGE, height=2.2, width_ratios=(3, 1)) as axes:
        left, right = axes[0]
        first = 0
        # Without rounding errors: they are too narrow for bins.
        rounded = [phase.period * np.round(x / phase.period, 9) for x in phase.periods]
        for k, periods in enumerate(rounded):
            at = first + np.arange(len(periods))
            left.plot(at, periods, ".", ms=2, color=CYCLE[k % len(CYCLE)])
            first += len(periods)
        left.axhline(phase.period, color="black", lw=0.6)
        left.set(xlabel="cycle (trials in different colors)", ylabel="period (s)")
        right.hist(
            np.concatenate(rounded), 30, orientation="horizontal", color=COLORS["gray"]
        )
        right.tick_params(labelleft=False)
        right.set(xlabel="cycles", ylim=left.get_ylim())
        letters(axes)
    return Plot(axes)


def section_data(data: SectionData, *, ax: AxesLike | None = None) -> Plot:
    """`data.plot()` of a recording: for each signal the cycle, deviations, and spectra."""
    N = data.n_sections
    nu = len(data.inputs)
    names = data.inputs + data.outputs
    cycle = np.concatenate([data.cycle_inputs, data.cycle_outputs], axis=1)
    by_record = [np.hstack([r.u, r.y]) for r in data.records]
    values = np.concatenate(by_record)
    samples = [r.first_section + np.arange(len(r.u)) for r in data.records]
    at = np.concatenate(samples) % N
    thin = slice(None, None, max(1, len(at) // 20000))
    phase = np.arange(N) / N
    height = 0.5 + 1.4 * len(names)
    with panels(ax, len(names), 3, width=PAGE, height=height) as axes:
        for i, (name, x) in enumerate(zip(names, values.T, strict=True)):
            average, spread, last = axes[i]
            average.plot(phase, cycle[:, i], ".-", ms=3, color=CYCLE[0])
            average.set_ylabel(axis_of(name))

            dots: Any = {"color": COLORS["gray"], "rasterized": True}
            spread.plot(at[thin] / N, x[thin], ",", **dots)
            std = np.array([np.nanstd(x[at == n]) for n in range(N)])
            for sign in (-2, 2):
                spread.plot(phase, sign * std, color=CYCLE[0])
            spread.set_ylabel(axis_of(name, deviation=True))

            for panel in (average, spread):
                _powers_of_ten(panel)
            if i < nu:
                _draw_spectrum(last, data, i)
            else:
                # (At the section where it scatters most.)
                widest = x[at == np.argmax(std)]
                last.plot(widest, lw=0.5, color=CYCLE[1])
                last.set_xlabel("cycle")
                last.sharey(spread)
                last.tick_params(labelleft=False)
        for panel in axes[-1, :2]:
            panel.set_xlabel("phase (cycles)")
        letters(axes)
    return Plot(axes)


def _draw_spectrum(ax: Axes, data: SectionData, i: int) -> None:
    """Draw the power spectrum of input i, without the part below rounding."""
    f, power = input_spectrum(data)
    floor = 1e-12 * power[:, i].max()
    shown = np.maximum(power[:, i], floor)
    ax.semilogy(f, shown, color=CYCLE[1])
    label = with_unit("power", square(data.inputs[i]))
    ax.set(xlabel="f (1/period)", ylabel=label)


def _powers_of_ten(ax: Axes) -> None:
    """One power of ten for small and large values, and not their zeros at each tick."""
    ax.ticklabel_format(axis="y", style="sci", scilimits=(-2, 3), useMathText=True)


def impulse_responses(
    responses: ImpulseResponses,
    *,
    model: LDTP | None = None,
    input: str | int = 0,
    ax: AxesLike | None = None,
) -> Plot:
    """`responses.plot()`: all phases in colors, and curves at some of them with bands."""
    ny = len(responses.outputs)
    N = len(responses.phase)
    pushing = channel_index("input", input, responses.inputs)
    theory = None if model is None else responses.of_model(model)
    with panels(ax, ny, 2, width=PAGE, height=0.4 + 1.9 * ny) as axes:
        for i, name in enumerate(responses.outputs):
            plane, curves = axes[i]
            values = responses.values[:, :, i, pushing]
            pushed = responses.inputs[pushing]
            impulse = Signal(pushed, unit_of(pushed) and f"{unit_of(pushed)} s")
            label = with_unit(f"{name} / impulse\n", ratio(name, impulse))
            look.colored(plane, responses.lag, responses.phase, values, label)
            plane.set_ylabel("phase of the push")
            quarters = [0, N // 4, N // 2, 3 * N // 4]
            for k, m in enumerate(dict.fromkeys(quarters)):
                band = 1.96 * responses.errors[m, :, i, pushing]
                line = {"color": CYCLE[k % len(CYCLE)]}
                arrow = {
                    "marker": 9,
                    "clip_on": False,
                    "transform": plane.get_yaxis_transform(),
                }
                plane.plot(1.0, responses.phase[m], **line, **arrow)
                curves.plot(
                    responses.lag, values[m], label=f"{responses.phase[m]:.2f}", **line
                )
                if theory is not None:
                    curves.plot(responses.lag, theory[m, :, i, pushing], "k--", lw=0.8)
                low = values[m] - band
                high = values[m] + band
                curves.fill_between(responses.lag, low, high, alpha=0.25, lw=0, **line)
            curves.axhline(0, color="black", lw=0.4)
        if theory is not None:
            axes[0, 1].plot([], [], "k--", lw=0.8, label="model")
        if ax is None:
            legend(axes[0, 1], "upper right", ncols=5, title="pushed at phase")
        for panel in axes[-1]:
            panel.set_xlabel("time (cycles)")
        letters(axes)
    return Plot(axes)


@checked
def phase_response(
    curve: PhaseCurve, *, model: PhaseCurve | None = None, ax: AxesLike | None = None
) -> Plot:
    """Draw a phase response curve, with the 95 % band of an estimate.

    Dotted lines are events of a model.

    **Arguments:**

    - `curve`: result of `hj.recordings.phase_response`, or the curve of a model,
        `cycle.responses().curve()`.
    - `model`: curve of a model, drawn over that of a recording, in its unit of time. Phase 0 of
        both must be the same event. Default: None.
    - `ax`: one Axes. Default: a new figure.

    **Returns:** `hj.plot.Plot` with `axes` (1, 1). Phase is in cycles, the response in
    `curve.unit`.

    **Raises:** `DefinitionError` for inputs in different units, or if `ax` is not one Axes.

    **Example:**

    ```python
    oscillator = hj.find_limit_cycle(hj.models.VanDerPol())
    hj.plot.phase_response(oscillator.responses().curve())
    ```

    **Before:** `hj.recordings.phase_response` or `cycle.responses`. **After:** `plot.save(path)`.
    """
    curves = [curve] if model is None else [curve, model]
    units = [unit_of(x.input) for x in curves]
    if all(units):
        require_equal("the inputs of both curves", "units", units[0], units[-1])
    with panels(ax, height=2.8) as axes:
        panel = axes[0, 0]
        for drawn, color in zip(curves, CYCLE, strict=False):
            seconds = [SECONDS.get(x.time_unit, 0.0) for x in (curve, drawn)]
            scale = seconds[0] / seconds[1] if all(seconds) else 1.0
            label = "model"
            if isinstance(drawn, PhaseResponse):
                low, high = (scale * x for x in drawn.interval(drawn.phase))
                panel.fill_between(
                    drawn.phase, low, high, color=color, alpha=0.25, lw=0
                )
                label = "estimated, 95 %"
            panel.plot(drawn.phase, scale * drawn.values, color=color, label=label)
            for phase in drawn.phase[np.isnan(drawn.values)]:
                panel.axvline(phase, color=color, lw=0.8, ls=":")
        panel.axhline(0, color="black", lw=0.4)
        response = f"response to {curve.input}\n({curve.unit})"
        panel.set(xlabel="phase (cycles)", ylabel=response, xlim=(0, 1))
        panel.legend()
    return Plot(axes)


def experiment(
    data: ExperimentData, index: int = 0, *, ax: AxesLike | None = None
) -> Plot:
    """`data.plot(index)`: inputs, and deviations of the outputs, of one experiment."""
    S, n, _ = data.u.shape
    require_index("experiment", index, S)
    index = index % S
    time = np.arange(n) / data.n_sections
    rows = []
    for k, name in enumerate(data.inputs):
        rows.append((name, data.u[index, :, k], True))
    for k, name in enumerate(data.outputs):
        rows.append((name, data.y[index, :, k], False))
    size = {"width": COLUMN, "height": 0.5 + 0.85 * len(rows)}
    with panels(ax, len(rows), 1, **size, sharex=True) as axes:
        for panel, (name, values, is_input) in zip(axes[:, 0], rows, strict=True):
            if is_input:
                panel.step(time, values, where="post", lw=0.5, color=COLORS["black"])
            else:
                panel.plot(time, values, lw=0.5, color=CYCLE[0])
            panel.set_ylabel(axis_of(name, deviation=not is_input))
            if data.window.start:
                panel.axvspan(
                    0, data.window.start / data.n_sections, color="0.92", zorder=0
                )
            if not data.ok[index] and data.failed_at[index] >= 0:
                panel.axvline(time[data.failed_at[index]], color=COLORS["red"], lw=0.8)
            _powers_of_ten(panel)
            panel.margins(x=0)
        axes[-1, 0].set_xlabel("time (cycles)")
        title = f"experiment {index}"
        if not data.ok[index]:
            title += f": {Result(int(data.result[index])).message}"
        axes[0, 0].set_title(title, wrap=True)
    return Plot(axes)


def validation(
    validation: Validation, *, cycles: PeriodCount = 4, ax: AxesLike | None = None
) -> Plot:
    """`validation.plot()`: measured and simulated outputs, and correlations of residuals."""
    from scipy import special  # (a fifth of a second)

    N = validation.n_sections
    ny = len(validation.outputs)
    shown = slice(max(len(validation.measured) - cycles * N, 0), None)
    sections = validation.first_section + np.arange(len(validation.measured))
    time = sections[shown] / N
    limit = float(special.ndtri(0.995))
    with panels(ax, ny, 3, width=PAGE, height=0.6 + 1.6 * ny) as axes:
        for i, name in enumerate(validation.outputs):
            signal, auto, cross = axes[i]
            signal.plot(
                time, validation.simulated[shown, i], color=CYCLE[0], label="simulated"
            )
            measured = dict(ls="", marker=".", ms=3, color="black", label="measured")
            signal.plot(time, validation.measured[shown, i], **measured)
            signal.set_ylabel(axis_of(name, deviation=True))
            # (The line below the title has room for the power of ten.)
            signal.set_title(f"fit {validation.fit[i]:.3g} %\n", loc="right")
            signal.margins(x=0.02)
            _powers_of_ten(signal)
            auto.set_ylabel("standard deviations")
            _stems(auto, 1.0, validation.autocorrelation[:, :, i], CYCLE[0], limit)
            auto.set_title(
                f"residuals\n{p_value(validation.whiteness[i])}", loc="right"
            )
            for j in range(len(validation.inputs)):
                color = CYCLE[(1 + j) % len(CYCLE)]
                correlation = validation.cross_correlation[:, :, i, j]
                _stems(cross, 0.2 * j, correlation, color, limit)
            cross.set_title(
                f"with the input\n{p_value(validation.independence[i])}", loc="right"
            )
        if ax is None:
            axes[0, 0].fill_between(
                [], [], color="0.9", label="99 % band without correlation"
            )
            legend(axes[0, 0], "upper left", ncols=3)
        axes[-1, 0].set_xlabel("time (cycles)")
        for lags in axes[-1, 1:]:
            lags.set_xlabel("lag (sections)")
    return Plot(axes)


def _stems(ax: Axes, first: float, values, color, limit: float) -> None:
    """Means over the sections of values that have variance 1 each, from a first lag on."""
    count = (values != 0).sum(axis=0)
    mean = values.sum(axis=0) / np.sqrt(np.maximum(count, 1))
    ax.axhspan(-limit, limit, color="0.9", zorder=0)
    ax.vlines(first + np.arange(len(mean)), 0, mean, color=color, lw=1.2)
    ax.axhline(0, color="black", lw=0.5)
    ax.xaxis.set_major_locator(MaxNLocator(5, integer=True))
