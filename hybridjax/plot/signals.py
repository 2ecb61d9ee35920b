"""What went into an experiment and what came out."""

from collections.abc import Mapping

import numpy as np

from .._core.boundary.checked import checked
from .._core.results import Result
from ..errors import DefinitionError
from ..experiments.data import ExperimentData
from .look import COLORS, COLUMN, CYCLE, AxesLike, Plot, axis_of, panels


@checked
def experiment(
    data: ExperimentData,
    index: int = 0,
    *,
    labels: Mapping[str, str] | None = None,
    ax: AxesLike | None = None,
) -> Plot:
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
    size = {"width": COLUMN, "height": 0.5 + 0.85 * len(rows)}
    with panels(ax, len(rows), 1, **size, sharex=True) as axes:
        for panel, (name, values, is_input) in zip(axes[:, 0], rows, strict=True):
            if is_input:
                panel.step(time, values, where="post", lw=0.5, color=COLORS["black"])
            else:
                panel.plot(time, values, lw=0.5, color=CYCLE[0])
            panel.set_ylabel(axis_of(name, labels, deviation=not is_input))
            if data.window.start:
                panel.axvspan(0, data.window.start / data.n_sections, color="0.92", zorder=0)
            if not data.ok[index] and data.failed_at[index] >= 0:
                panel.axvline(time[data.failed_at[index]], color=COLORS["red"], lw=0.8)
            panel.ticklabel_format(axis="y", style="sci", scilimits=(-2, 3), useMathText=True)
            panel.margins(x=0)
        axes[-1, 0].set_xlabel("time (cycles)")
        title = f"experiment {index}"
        if not data.ok[index]:
            title += f": {Result(int(data.result[index])).message}"
        axes[0, 0].set_title(title, wrap=True)
        axes[0, 0].get_figure(root=True).align_ylabels(axes)
    return Plot(axes)
