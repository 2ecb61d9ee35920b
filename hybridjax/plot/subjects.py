"""Figures of populations: forest plots, paired dots, and curves or maps of subjects."""

import numpy as np
from matplotlib.axes import Axes
from scipy import stats

from .._core.boundary.checked import checked
from .._core.signal import with_unit
from ..errors import DefinitionError
from ..recordings.population.maps import MapMean, MapTest
from ..recordings.population.population import Population
from .look import COLORS, COLUMN, CYCLE, PAGE, AxesLike, Plot, panels


@checked
def forest(population: Population, quantity: str, *, ax: AxesLike | None = None) -> Plot:
    """Draw the estimate of each subject with its 95 % interval, its prediction (open circle), and
    the mean of each group and condition (diamond: its 95 % interval)."""
    means = population.mean(quantity)
    subjects = population.predictions(quantity)
    cells = list(dict.fromkeys(subjects["cell"]))
    names, at = [], 0
    with panels(ax, height=0.7 + 0.15 * (len(subjects["cell"]) + 2 * len(cells))) as axes:
        panel = axes[0, 0]
        for k, cell in enumerate(cells):
            color, mean = CYCLE[k % len(CYCLE)], {n: x[k] for n, x in means.columns.items()}
            of = np.flatnonzero(subjects["cell"] == cell)
            rows = at - np.arange(len(of))
            reach = stats.norm.ppf(0.975) * subjects["standard_error"][of]
            panel.errorbar(subjects["estimate"][of], rows, xerr=reach, fmt="s", ms=3, lw=0.8,
                           color=color, zorder=3)  # fmt: skip
            panel.plot(subjects["prediction"][of], rows, "o", ms=4, mfc="none", mec=COLORS["gray"],
                       mew=0.8, zorder=4)  # fmt: skip
            bottom = rows[-1] - 1
            panel.fill(
                [mean["low"], mean["estimate"], mean["high"], mean["estimate"]],
                [bottom, bottom + 0.35, bottom, bottom - 0.35], color=color, lw=0,
            )  # fmt: skip
            panel.plot([mean["estimate"]] * 2, [bottom, at + 0.5], color=color, lw=0.5, ls=":")
            summary = "mean" if cell == "all" else f"mean, {cell}"
            names += [*zip(rows, subjects["subject"][of], strict=True), (bottom, summary)]
            at = bottom - 2
        panel.set_yticks([y for y, _ in names], [name for _, name in names])
        panel.tick_params(axis="y", length=0)
        panel.set_ylim(at + 1, 1)
        panel.set_xlabel(with_unit(quantity, population.units[quantity]))
    return Plot(axes)


@checked
def paired(
    population: Population, quantity: str, a: str, b: str, *, ax: AxesLike | None = None
) -> Plot:
    """Draw the estimates of two conditions or groups as dots with standard errors, those of a
    subject joined by a line, beside the means with 95 % intervals.

    **Raises:** `DefinitionError` as `Population.difference`.
    """
    test = population.difference(quantity, a, b)
    chosen = population.predictions(quantity).columns
    means = population.mean(quantity)
    with panels(ax) as axes:
        panel = axes[0, 0]
        places: dict[str, list[tuple[float, float]]] = {}
        sides = [[c for c in dict.fromkeys(chosen["cell"]) if x in c.split(", ")] for x in (a, b)]
        for k, cells in enumerate(sides):
            for j, cell in enumerate(cells):
                rows, color = np.flatnonzero(chosen["cell"] == cell), CYCLE[j % len(CYCLE)]
                at, out = k + 0.1 * (j - (len(cells) - 1) / 2), (-0.15, 0.15)[k]
                panel.errorbar(np.full(len(rows), at), chosen["estimate"][rows],
                               chosen["standard_error"][rows], fmt="o", ms=3, lw=0.5, color=color,
                               zorder=3)  # fmt: skip
                for i in rows:
                    places.setdefault(chosen["subject"][i], []).append((at, chosen["estimate"][i]))
                mean = list(means["effect"]).index(f"mean, {cell}")
                low, value, high = (means[n][mean] for n in ("low", "estimate", "high"))
                panel.errorbar(at + out, value, [[value - low], [high - value]], fmt="D", ms=5,
                               color="black", capsize=2)  # fmt: skip
        for points in places.values():
            panel.plot(*zip(*points, strict=True), lw=0.5, color=COLORS["gray"], zorder=1)
        panel.set_xticks([0, 1], [a, b])
        panel.set_xlim(-0.4, 1.4)
        panel.set_ylabel(with_unit(quantity, population.units[quantity]))
        value, low, high = (test[n][0] for n in ("estimate", "low", "high"))
        panel.set_title(f"{a} - {b}: {value:.3g} [{low:.3g}, {high:.3g}]")
    return Plot(axes)


@checked
def subject_maps(result: MapMean | MapTest, *, ax: AxesLike | None = None) -> Plot:
    """Draw a mean or a difference over subjects. A curve: each subject as a thin line, the mean,
    and its band or the significant points (bar). A map: its values, with outlined significant
    points; of complex values the magnitude.

    **Raises:** `DefinitionError` for maps with more than two axes.
    """
    if len(result.axes) > 2:
        raise DefinitionError("a figure has at most two axes, but the maps have more.")
    with panels(ax, width=COLUMN if len(result.axes) == 1 else 0.6 * PAGE) as axes:
        panel = axes[0, 0]
        if len(result.axes) == 1:
            _curves(result, panel)
        else:
            _map(result, panel)
    return Plot(axes)


def _curves(result: MapMean | MapTest, panel: Axes) -> None:
    ((name, x),) = result.axes.items()
    size = np.abs if np.iscomplexobj(result.values) else np.asarray
    if len(result.each):
        panel.plot(x, size(result.each).T, color=COLORS["gray"], lw=0.4, alpha=0.7)
    mean = size(result.values)
    panel.plot(x, mean, color=CYCLE[0], lw=1.5, zorder=3)
    if isinstance(result, MapMean):
        panel.fill_between(x, mean - result.reach, mean + result.reach, color=CYCLE[0], alpha=0.3,
                           lw=0, zorder=2)  # fmt: skip
    else:
        foot = np.where(result.significant, panel.get_ylim()[0], np.nan)
        panel.plot(x, foot, color=CYCLE[1], lw=4, solid_capstyle="butt", zorder=4)
    panel.axhline(0, color="black", lw=0.4)
    kind = "difference" if isinstance(result, MapTest) else "response"
    panel.set(xlabel=name, ylabel=with_unit(kind, result.unit))


def _map(result: MapMean | MapTest, panel: Axes) -> None:
    (vertical, y), (horizontal, x) = result.axes.items()
    is_complex = np.iscomplexobj(result.values)
    values = np.abs(result.values) if is_complex else result.values
    top = np.abs(values).max()
    image = panel.pcolormesh(
        x, y, values, cmap="viridis" if is_complex else "RdBu_r", vmin=0 if is_complex else -top,
        vmax=top, shading="nearest", rasterized=True,
    )  # fmt: skip
    kind = "difference" if isinstance(result, MapTest) else "response"
    panel.figure.colorbar(image, ax=panel, label=with_unit(kind, result.unit))
    if isinstance(result, MapTest):
        inside = result.significant
    else:
        inside = np.abs(result.values) > result.reach
    # Outlines along the edges of the points: cells are bounded halfway between coordinates.
    across, along = _edges(x), _edges(y)
    padded = np.pad(inside, 1)
    for i, j in zip(*np.nonzero(padded[:, 1:] != padded[:, :-1]), strict=True):
        panel.plot([across[j]] * 2, along[[i - 1, i]], color="black", lw=1.2)
    for i, j in zip(*np.nonzero(padded[1:] != padded[:-1]), strict=True):
        panel.plot(across[[j - 1, j]], [along[i]] * 2, color="black", lw=1.2)
    panel.set(xlabel=horizontal, ylabel=vertical)


def _edges(x: np.ndarray) -> np.ndarray:
    middle = (x[1:] + x[:-1]) / 2
    return np.concatenate([[2 * x[0] - middle[0]], middle, [2 * x[-1] - middle[-1]]])
