"""What a model explains of measured data, and what it leaves."""

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator
from scipy import stats

from .._core.boundary.checked import checked
from .._core.boundary.kinds import PeriodCount
from .._core.text import p_value
from ..identify.validate import Validation
from .look import CYCLE, PAGE, AxesLike, Plot, axis_of, letters, panels


@checked
def validation(
    found: Validation,
    *,
    cycles: PeriodCount = 4,
    labels: Mapping[str, str] | None = None,
    ax: AxesLike | None = None,
) -> Plot:
    """Measured and simulated outputs, and correlations of the residuals; one row per output.

    Left: the last cycles of the first record. Middle: correlations of the residuals with earlier
    ones, right: with earlier inputs. Bars are their means over all sections, in units of their
    standard deviation; beyond the shaded band lie 1 % of them where there is no correlation.

    **Arguments:** `cycles` to show; `labels`: texts for the outputs and inputs by name.
    """
    N, ny = found.n_sections, len(found.outputs)
    shown = slice(max(len(found.measured) - cycles * N, 0), None)
    time = (found.first_section + np.arange(len(found.measured)))[shown] / N
    limit = float(stats.norm.isf(0.005))
    with panels(ax, ny, 3, width=PAGE, height=0.6 + 1.6 * ny) as axes:
        for i, name in enumerate(found.outputs):
            signal, auto, cross = axes[i]
            signal.plot(time, found.simulated[shown, i], color=CYCLE[0], label="simulated")
            measured = dict(ls="", marker=".", ms=3, color="black", label="measured")
            signal.plot(time, found.measured[shown, i], **measured)
            signal.set_ylabel(axis_of(name, labels, deviation=True))
            signal.set_title(f"fit {found.fit[i]:.2f} %")
            signal.margins(x=0.02)
            after = np.arange(1, 1 + found.autocorrelation.shape[1])
            _stems(auto, after, found.autocorrelation[:, :, i], CYCLE[0], 0.0, limit)
            auto.set_title(f"residuals: {p_value(found.whiteness[i])}")
            for j, _ in enumerate(found.inputs):
                lags = np.arange(found.cross_correlation.shape[1])
                values = found.cross_correlation[:, :, i, j]
                _stems(cross, lags, values, CYCLE[(1 + j) % len(CYCLE)], 0.2 * j, limit)
            cross.set_title(f"with the input: {p_value(found.independence[i])}")
        axes[0, 0].legend(loc="best")
        axes[-1, 0].set_xlabel("time (cycles)")
        for lags in axes[-1, 1:]:
            lags.set_xlabel("lag (sections)")
        axes[0, 0].get_figure(root=True).align_ylabels(axes[:, 0])
        letters(axes)
    return Plot(axes)


def _stems(ax: Axes, lags, values, color, shift: float, limit: float) -> None:
    """Means over the sections of values that have variance 1 each."""
    count = np.maximum((values != 0).sum(axis=0), 1)
    mean = values.sum(axis=0) / np.sqrt(count)
    ax.axhspan(-limit, limit, color="0.9", zorder=0)
    ax.vlines(lags + shift, 0, mean, color=color, lw=1.2)
    ax.axhline(0, color="black", lw=0.5)
    ax.set_ylabel("std. deviations")
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
