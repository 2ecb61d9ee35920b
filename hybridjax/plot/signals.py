"""What went into an experiment and what came out."""

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure

from .._core.results import Result
from ..errors import DefinitionError
from ..experiments.data import ExperimentData
from .look import COLORS, COLUMN, CYCLE, label_of, new_figure, style


def experiment(
    data: ExperimentData, index: int = 0, *, labels: Mapping[str, str] | None = None
) -> Figure:
    """Inputs and deviations of the outputs of one experiment, against time in cycles.

    One row per signal; cycles before the window that estimates use are shaded, and a failed
    experiment ends at a mark with its reason.

    **Raises:** `DefinitionError` for an experiment that does not exist.
    """
    S, n, _ = data.u.shape
    if not -S <= index < S:
        raise DefinitionError(f"there is no experiment {index}; there are {S}.")
    index = index % S
    time = np.arange(n) / data.n_sections
    rows = [(name, data.u[index, :, k], True) for k, name in enumerate(data.inputs)]
    rows += [(name, data.y[index, :, k], False) for k, name in enumerate(data.outputs)]
    with style():
        figure, axes = new_figure(
            len(rows), 1, width=COLUMN, height=0.5 + 0.85 * len(rows), sharex=True
        )
        for ax, (name, values, is_input) in zip(axes[:, 0], rows, strict=True):
            if is_input:
                ax.step(time, values, where="post", lw=0.5, color=COLORS["black"])
            else:
                ax.plot(time, values, lw=0.5, color=CYCLE[0])
            text = label_of(name, labels)
            ax.set_ylabel(text if is_input else rf"$\delta$ {text}")
            if data.window.start:
                ax.axvspan(0, data.window.start / data.n_sections, color="0.92", zorder=0)
            if not data.ok[index] and data.failed_at[index] >= 0:
                ax.axvline(time[data.failed_at[index]], color=COLORS["red"], lw=0.8)
            ax.ticklabel_format(axis="y", style="sci", scilimits=(-2, 3), useMathText=True)
            ax.margins(x=0)
        axes[-1, 0].set_xlabel("time (cycles)")
        title = f"experiment {index}"
        if not data.ok[index]:
            title += f": {Result(int(data.result[index])).message}"
        axes[0, 0].set_title(title, wrap=True)
        figure.align_ylabels()
    return figure
