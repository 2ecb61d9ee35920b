"""Figures of populations: forest plots, paired dots, and curves or maps of subjects."""

import numpy as np
from scipy import stats

from .._core.boundary.checked import checked
from .._core.signal import with_unit
from ..errors import DefinitionError
from ..recordings.population.maps import MapResult
from ..recordings.population.population import Population
from .look import COLORS, COLUMN, CYCLE, PAGE, AxesLike, Plot, panels


@checked
def forest(population: Population, quantity: str, *, ax: AxesLike | None = None) -> Plot:
    """Draw the estimate of each subject with its 95 % interval, its prediction (open circle), and
    the mean of each group and condition (diamond: its 95 % interval)."""
    means = population.mean(quantity)
    subjects = population.predictions(quantity)
    names, at, count = [], 0, len(subjects["cell"]) + 2 * len(means["low"])
    numbers = zip(*(means[n] for n in ("effect", "low", "estimate", "high")), strict=True)
    with panels(ax, height=0.7 + 0.15 * count) as axes:
        panel = axes[0, 0]
        for k, (effect, low, mean, high) in enumerate(numbers):
            color = CYCLE[k % len(CYCLE)]
            cell = effect.removeprefix("mean, ") if effect != "mean" else "all"
            of = np.flatnonzero(subjects["cell"] == cell)
            rows, bottom = at - np.arange(len(of)), at - len(of)
            reach = stats.norm.ppf(0.975) * subjects["standard_error"][of]
            panel.errorbar(subjects["estimate"][of], rows, xerr=reach, fmt="s", ms=3, lw=0.8,
                           color=color, zorder=3)  # fmt: skip
            panel.plot(subjects["prediction"][of], rows, "o", ms=4, mfc="none", mec=COLORS["gray"],
                       mew=0.8, zorder=4)  # fmt: skip
            diamond = bottom + 0.35 * np.array([0, 1, 0, -1])
            panel.fill([low, mean, high, mean], diamond, color=color, lw=0)
            panel.plot([mean, mean], [bottom, at + 0.5], color=color, lw=0.5, ls=":")
            names += [*zip(rows, subjects["subject"][of], strict=True), (bottom, effect)]
            at = bottom - 2
        panel.set_yticks(*zip(*names, strict=True))
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
    test, means = population.difference(quantity, a, b), population.mean(quantity)
    rows = population.predictions(quantity)
    with panels(ax) as axes:
        panel = axes[0, 0]
        side = {c: k for k, x in enumerate((a, b)) for c in rows["cell"] if x in c.split(", ")}
        place = np.array([side.get(cell, np.nan) for cell in rows["cell"]])
        panel.errorbar(place, rows["estimate"], rows["standard_error"], fmt="o", ms=3, lw=0.5,
                       color=CYCLE[0], zorder=3)  # fmt: skip
        for subject in dict.fromkeys(rows["subject"]):
            of = rows["subject"] == subject
            panel.plot(place[of], rows["estimate"][of], lw=0.5, color=COLORS["gray"], zorder=1)
        for cell, k in side.items():
            i = list(means["effect"]).index(f"mean, {cell}")
            low, value, high = (means[n][i] for n in ("low", "estimate", "high"))
            panel.errorbar(1.3 * k - 0.15, value, [[value - low], [high - value]], fmt="D", ms=5,
                           color="black", capsize=2)  # fmt: skip
        panel.set_xticks([0, 1], [a, b])
        panel.set_xlim(-0.4, 1.4)
        panel.set_ylabel(with_unit(quantity, population.units[quantity]))
        value, low, high = (test[n][0] for n in ("estimate", "low", "high"))
        panel.set_title(f"{a} - {b}: {value:.3g} [{low:.3g}, {high:.3g}]")
    return Plot(axes)


@checked
def subject_maps(result: MapResult, *, ax: AxesLike | None = None) -> Plot:
    """Draw a mean or a difference over subjects. A curve: each subject as a thin line, the mean,
    its band, and the significant points (bar). A map: its values, with outlined significant
    points; of complex values the magnitude.

    **Raises:** `DefinitionError` for maps with more than two axes.
    """
    is_complex, is_mean = np.iscomplexobj(result.values), np.isfinite(result.reach).all()
    size = np.abs if is_complex else np.asarray
    values, inside = size(result.values), result.significant
    label = with_unit("response" if is_mean else "difference", result.unit)
    if len(result.axes) > 2:
        raise DefinitionError("a figure has at most two axes, but the maps have more.")
    with panels(ax, width=COLUMN if len(result.axes) == 1 else 0.6 * PAGE) as axes:
        panel, (name, *other) = axes[0, 0], result.axes
        if not other:
            x = result.axes[name]
            if len(result.each):
                panel.plot(x, size(result.each).T, color=COLORS["gray"], lw=0.4, alpha=0.7)
            panel.plot(x, values, color=CYCLE[0], lw=1.5, zorder=3)
            panel.fill_between(x, values - result.reach, values + result.reach, color=CYCLE[0],
                               alpha=0.3, lw=0, zorder=2)  # fmt: skip
            foot = np.where(inside, panel.get_ylim()[0], np.nan)
            panel.plot(x, foot, color=CYCLE[1], lw=4, solid_capstyle="butt", zorder=4)
            panel.axhline(0, color="black", lw=0.4)
            panel.set(xlabel=name, ylabel=label)
        else:
            y, x = result.axes.values()
            top = np.abs(values).max()
            image = panel.pcolormesh(
                x, y, values, cmap="viridis" if is_complex else "RdBu_r",
                vmin=0 if is_complex else -top, vmax=top, shading="nearest", rasterized=True,
            )  # fmt: skip
            panel.figure.colorbar(image, ax=panel, label=label)
            if inside.any() and not inside.all():
                panel.contour(x, y, inside, [0.5], colors="black", linewidths=1.2)
            panel.set(xlabel=other[0], ylabel=name)
    return Plot(axes)
