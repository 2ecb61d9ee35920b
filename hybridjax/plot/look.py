"""One look for all figures: sizes of a two-column paper, colors, fonts; and saving.

All figures that do not move get their Axes from `panels`, which makes a new figure in the package's
style or takes the Axes of the user, and are returned as a `Plot`. (`motion.py` and `explorer.py`
make their own figures, within `style`.) Constants are a matter of taste and may be changed, for all
figures at once; settings of matplotlib outside of `style` must not be. Helpers for labels and
legends follow (`axis_of`, `legend`, `letters`).

If a figure is not shown in a notebook, look at `_load_backend` and `close_in_notebook`; if a file
has a wrong name or format, at `_write`.
"""

import contextlib
import dataclasses
import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast, get_args

import matplotlib
import numpy as np
from matplotlib import pyplot
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.rcsetup import cycler

from .._core.boundary.checked import checked_methods
from .._core.boundary.kinds import FilePath
from .._core.signal import unit_of, with_unit
from .._core.writing import Format, replacing
from ..errors import DefinitionError


COLUMN = 3.5
"""Width of one column, in inches."""
PAGE = 7.16
"""Width of two columns and the space between, in inches."""

COLORS = {
    "blue": "#0072B2",
    "red": "#D55E00",
    "green": "#009E73",
    "purple": "#CC79A7",
    "orange": "#E69F00",
    "sky": "#56B4E9",
    "black": "#000000",
    "gray": "#8C8C8C",
}
"""The palette of Okabe and Ito (2008), which color-blind readers can tell apart, and a gray."""

CYCLE = [COLORS[name] for name in ("blue", "red", "green", "purple", "orange", "sky")]

_STYLE: dict[Any, Any] = {
    **dict.fromkeys(("font.size", "axes.titlesize", "axes.labelsize"), 8),
    **dict.fromkeys(("xtick.labelsize", "ytick.labelsize", "legend.fontsize"), 7),
    **dict.fromkeys(("axes.linewidth", "xtick.major.width", "ytick.major.width"), 0.6),
    **dict.fromkeys(("axes.spines.top", "axes.spines.right", "legend.frameon"), False),
    **dict.fromkeys(("xtick.direction", "ytick.direction"), "out"),
    "font.family": "DejaVu Sans",
    "mathtext.fontset": "dejavusans",
    "axes.titley": 1.0,
    "axes.prop_cycle": cycler(color=CYCLE),
    "legend.handlelength": 1.6,
    "legend.borderaxespad": 0.3,
    "lines.linewidth": 1.0,
    "lines.markersize": 4,
    "figure.dpi": 150,
}
# Text stays text: it can be searched and edited.
_FONTS_IN_FILES: Any = {"pdf.fonttype": 42, "svg.fonttype": "none"}


@functools.cache
def _load_backend() -> None:
    """Load the backend. In Jupyter, this turns interactive mode on, by default when the first
    figure is made. Inside of `style` that would be undone, and no later figure would be shown."""
    pyplot.switch_backend(matplotlib.get_backend())


def style() -> contextlib.AbstractContextManager:
    """Use the package's look for your own figures.

    Functions of `hj.plot` use it for figures that they create; they do not change the fonts and
    sizes of given Axes. Global settings of matplotlib are never changed.

    **Returns:** a context manager. Figures that are made inside of it have the look.

    **Raises:** `ImportError` if matplotlib cannot load its backend.

    **Example:**

    ```python
    with hj.plot.style():
        figure, panel = plt.subplots()
        panel.plot(*cycle.trajectory()("yM", "vM")[1:])
    ```

    **Before:** any result. **After:** `figure.savefig`.
    """
    _load_backend()
    return matplotlib.rc_context(_STYLE | _FONTS_IN_FILES)


def close_in_notebook(figure: Figure) -> None:
    """Notebooks show what the figure belongs to, and no still beside it."""
    if "inline" in matplotlib.get_backend().lower():
        pyplot.close(figure)


AxesLike = Axes | np.ndarray | Sequence
"""Axes to draw on: one, or a grid of them."""


@checked_methods
@dataclasses.dataclass(frozen=True, repr=False)
class Plot:
    """The figure that every function of `hybridjax.plot` returns.

    **Fields:** `axes`, the grid of panels, (rows, columns); `figure`, in which they are.
    """

    axes: np.ndarray

    @property
    def figure(self) -> Figure:
        return self.axes[0, 0].get_figure(root=True)

    @property
    def ax(self) -> Axes:
        """The first panel, and the only one of many plots."""
        return self.axes[0, 0]

    def save(
        self, path: FilePath, formats: Sequence[Format] | None = None
    ) -> tuple[Path, ...]:
        """Write the figure, in one file for each format.

        **Arguments:** `path`: with a suffix, or without; `formats`, of "png" (150 dots per inch),
        "pdf" and "svg". Default: that of the suffix; without suffix, "png".

        **Returns:** the paths.

        **Raises:** `DefinitionError` if they cannot be written, and for a suffix of another format.

        **Example:**

        ```python
        hj.plot.cycle(cycle, "yM", "vM").save("orbit", formats=("png", "svg"))
        ```
        """
        if formats is None:
            suffix = Path(path).suffix[1:]
            known = suffix in get_args(Format)
            formats = [cast(Format, suffix if known else "png")]
        return _write(path, self, formats)

    def show(self) -> None:
        """Open a window with the figure, or show it in a notebook."""
        self.figure.show()

    def __repr__(self) -> str:
        rows, columns = self.axes.shape
        return f"Plot({rows} x {columns} panels)"


@contextlib.contextmanager
def panels(
    ax: AxesLike | None,
    rows: int = 1,
    columns: int = 1,
    *,
    width: float = COLUMN,
    height: float = 2.6,
    **options,
):
    """The grid of Axes that is given, or a new one in the package's style, (rows, columns).

    **Raises:** `DefinitionError` for another number of Axes.
    """
    if ax is None:
        size: Any = {
            "figsize": (width, height),
            "layout": "constrained",
            "squeeze": False,
        }
        with style():
            axes = pyplot.subplots(rows, columns, **size, **options)[1]
            # (Here, since ticks are made when the figure is drawn.)
            for panel in axes.flat:
                panel.tick_params(labelsize=_STYLE["xtick.labelsize"])
            yield axes
            axes[0, 0].figure.align_ylabels(axes)
        return
    axes = np.asarray(ax, dtype=object)
    if not all(isinstance(panel, Axes) for panel in axes.flat):
        raise DefinitionError("`ax` must hold Axes of matplotlib, and nothing else.")
    if axes.size != rows * columns:
        raise DefinitionError(
            f"`ax` must hold {rows} x {columns} Axes, one for each panel, not {axes.size}."
        )
    yield axes.reshape(rows, columns)


def axis_of(name: str, *, deviation: bool = False) -> str:
    """The label of an axis for a signal, or for its deviation from the cycle, with the unit."""
    return with_unit(rf"$\delta$ {name}" if deviation else name, unit_of(name))


def colored(
    ax: Axes,
    x,
    y,
    values: np.ndarray,
    label: str,
    is_size: bool = False,
) -> None:
    """A map in colors with a bar: around zero, or of magnitudes from zero on."""
    top = np.abs(values).max()
    look: Any = (
        {"cmap": "viridis", "vmin": 0} if is_size else {"cmap": "RdBu_r", "vmin": -top}
    )
    image = ax.pcolormesh(
        x,
        y,
        values,
        **look,
        vmax=top,
        rasterized=True,
        shading="nearest",
    )
    cast(Any, ax.figure).colorbar(image, ax=ax, label=label)


def legend(ax: Axes, place: str, **options: Any) -> None:
    """The legend of a panel, beside all panels of a new figure, where it covers no curve."""
    figure = cast(Any, ax.get_figure(root=True))
    figure.legend(*ax.get_legend_handles_labels(), loc=f"outside {place}", **options)


def legend_above(ax: Axes, columns: int = 4) -> None:
    """A legend over the panel, with its entries side by side."""
    ax.legend(
        loc="lower center",
        bbox_to_anchor=(0.5, 1.0),
        ncols=columns,
        columnspacing=1.2,
    )


def letters(axes: Any) -> None:
    """Call the Axes of a figure A, B, C, ..."""
    for ax, letter in zip(np.ravel(axes), "ABCDEFGHIJKLMNOPQRSTUVWXYZ", strict=False):
        ax.set_title(letter, loc="left", fontweight="bold")
        ax.yaxis.set_offset_position("right")  # (a power of ten would cover the letter)


def _write(path: FilePath, plot: Plot, formats: Sequence[Format]) -> tuple[Path, ...]:
    """Write a figure, in one file for each format. A suffix of a format is dropped."""
    path = Path(path)
    if path.suffix[1:] in get_args(Format):
        path = path.with_suffix("")
    elif path.suffix[1:].isalpha():
        raise DefinitionError(
            f"cannot write '{path}': formats are {', '.join(get_args(Format))}."
        )
    if not path.name:
        raise DefinitionError(
            f"'{path}' is a folder: add the name of a file without its suffix."
        )
    paths = tuple(path.with_name(f"{path.name}.{format}") for format in formats)
    with matplotlib.rc_context(_FONTS_IN_FILES):
        for target, format in zip(paths, formats, strict=True):
            with replacing(target) as new:
                plot.figure.savefig(new, format=format, dpi=_STYLE["figure.dpi"])
    return paths


def save_and_close(
    path: FilePath, plot: Plot, formats: Sequence[Format]
) -> tuple[Path, ...]:
    """Write a figure that is not shown, and free its memory."""
    paths = _write(path, plot, formats)
    pyplot.close(plot.figure)
    return paths
