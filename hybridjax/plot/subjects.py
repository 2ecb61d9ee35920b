"""Figures of populations: forest plots (`forest`), paired dots (`paired`), and curves or maps of
subjects (`subject_maps`).

`first_of_data.py` registers `forest` and `subject_maps` for `result.plot()`. Sizes and colors may
be chosen otherwise. Columns such as `estimate` and `low` are those of the tables of `Population`,
and must have the same names there.

The tables and maps are computed in `recordings/population/`: if an estimate, an interval or a band
is wrong, look there. If a subject or a mean is in a wrong row, look at `at` in `forest`; if a dot
is on the wrong side, at `side` in `paired`, which follows from the labels of its cell.
"""

import numpy as np

from .._core.boundary.checked import checked
from .._core.signal import with_unit
from ..errors import DefinitionError
from ..recordings.population.maps import MapResult
from ..recordings.population.population import Population
from .look import COLORS, COLUMN, CYCLE, PAGE, AxesLike, Plot, colored, panels


def forest(
    population: Population, quantity: str, *, ax: AxesLike | None = None
) -> Plot:
    """`people.plot(quantity)`: the estimate of each subject, and the means."""
    means = population.mean(quantity)
    subjects = population.predictions(quantity)
    names = []
    at = 0
    with panels(ax, height=0.7 + 0.15 * (len(subjects) + 2 * len(means))) as axes:
        panel = axes[0, 0]
        open_circle = {"ms": 4, "mfc": "none", "mew": 0.8}
        cells = zip(
            means.itertuples(), subjects.groupby("cell", sort=False), strict=True
        )
        for k, (mean, (_, part)) in enumerate(cells):
            rows = at - np.arange(len(part))
            bottom = at - len(part)
            line = {"color": CYCLE[k % len(CYCLE)], "lw": 0.8}
            reach = 1.96 * part["standard_error"]
            panel.errorbar(part["estimate"], rows, xerr=reach, fmt="s", ms=3, **line)
            panel.plot(
                part["prediction"], rows, "o", color=COLORS["gray"], **open_circle
            )
            diamond = bottom + 0.35 * np.array([0, 1, 0, -1])
            panel.fill(
                [mean.low, mean.estimate, mean.high, mean.estimate], diamond, **line
            )
            panel.plot([mean.estimate] * 2, [bottom, at + 0.5], ls=":", **line)
            names += [*zip(rows, part["subject"], strict=True), (bottom, mean.effect)]
            at = bottom - 2
        panel.set_yticks(*zip(*names, strict=True))
        panel.tick_params(axis="y", length=0)
        panel.set(
            ylim=(at + 1, 1), xlabel=with_unit(quantity, population.units[quantity])
        )
    return Plot(axes)


@checked
def paired(
    population: Population,
    quantity: str,
    a: str,
    b: str,
    *,
    ax: AxesLike | None = None,
) -> Plot:
    """Draw the estimates in two conditions or groups, and the means with 95 % intervals.

    Dots are estimates with their standard errors; a line joins those of a subject. Diamonds are
    means. The title gives the mean difference and its 95 % interval.

    **Arguments:**

    - `population`: a `hj.recordings.Population`, also that of `hj.identify_subjects`.
    - `quantity`: name of the quantity, such as "modulus".
    - `a`, `b`: the two conditions, or the two groups.
    - `ax`: one Axes. Default: a new figure.

    **Returns:** `hj.plot.Plot` with `axes` (1, 1), the quantity in its unit.

    **Raises:** `DefinitionError` as `Population.difference`, or if `ax` is not one Axes.

    **Example:**

    ```python
    gain = np.array([0.61, 0.58, 0.66, 0.68, 0.63, 0.71])
    table = {"subject": ["S1", "S2", "S3"] * 2, "condition": ["slow"] * 3 + ["fast"] * 3}
    people = hj.recordings.Population(table, {"gain": gain}, {"gain": 0.02 + 0 * gain})
    hj.plot.paired(people, "gain", "fast", "slow")
    ```

    **Before:** `hj.identify_subjects`. **After:** `plot.save(path)`.
    """
    (test,) = population.difference(quantity, a, b).itertuples()
    subjects = population.predictions(quantity)
    means = population.mean(quantity)
    with panels(ax) as axes:
        panel = axes[0, 0]
        cells = zip(
            means.itertuples(), subjects.groupby("cell", sort=False), strict=True
        )
        for mean, (cell, part) in cells:
            side = [k for k, label in enumerate((a, b)) if label in cell.split(", ")]
            for k in side:
                subjects.loc[part.index, "side"] = k
                error = part["standard_error"]
                panel.errorbar(
                    [k] * len(part), part["estimate"], error, fmt="o", ms=3, lw=0.5
                )
                reach = [[mean.estimate - mean.low], [mean.high - mean.estimate]]
                panel.errorbar(
                    1.3 * k - 0.15, mean.estimate, reach, fmt="D", ms=5, color="black"
                )
        for _, part in subjects.groupby("subject"):
            panel.plot(
                part["side"], part["estimate"], lw=0.5, color=COLORS["gray"], zorder=1
            )
        panel.set_xticks([0, 1], [a, b])
        panel.set(
            xlim=(-0.4, 1.4), ylabel=with_unit(quantity, population.units[quantity])
        )
        panel.set_title(
            f"{a} - {b}: {test.estimate:.3g} [{test.low:.3g}, {test.high:.3g}]"
        )
    return Plot(axes)


def subject_maps(result: MapResult, *, ax: AxesLike | None = None) -> Plot:
    """`maps.mean().plot()`: a mean or a difference over subjects, as a curve or a map."""
    is_complex = np.iscomplexobj(result.values)
    size = np.abs if is_complex else np.asarray
    values = size(result.values)
    inside = result.significant
    label = with_unit("response", result.unit)
    if len(result.axes) > 2:
        raise DefinitionError("a figure has at most two axes, but the maps have more.")
    with panels(ax, width=COLUMN if len(result.axes) == 1 else 0.6 * PAGE) as axes:
        panel = axes[0, 0]
        name, *other = result.axes
        if not other:
            x = result.axes[name]
            low = values - result.reach
            high = values + result.reach
            panel.plot(x, size(result.each).T, color=COLORS["gray"], lw=0.4, alpha=0.7)
            panel.plot(x, values, color=CYCLE[0], lw=1.5, zorder=3)
            panel.fill_between(x, low, high, color=CYCLE[0], alpha=0.3, lw=0, zorder=2)
            foot = np.where(inside, panel.get_ylim()[0], np.nan)
            panel.plot(x, foot, color=CYCLE[1], lw=4, solid_capstyle="butt", zorder=4)
            panel.axhline(0, color="black", lw=0.4)
            panel.set(xlabel=name, ylabel=label)
        else:
            y, x = result.axes.values()
            colored(panel, x, y, values, label, is_complex)
            if inside.any() and not inside.all():
                panel.contour(x, y, inside, [0.5], colors="black", linewidths=1.2)
            panel.set(xlabel=other[0], ylabel=name)
    return Plot(axes)
