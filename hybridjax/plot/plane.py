"""Figures in the complex plane: multipliers (`multipliers`), poles and zeros (`poles_zeros`).

True values are crosses, estimates open markers; `_values` and `_series` read both from any result,
`_borders` the 95 % confidence regions. `_zoom` decides whether an inset around the leading
multiplier is drawn, and where. Markers, colors and places of the inset are a matter of taste; the
regions are not: they are those of `MultiplierFit.ellipse`.

If a distance in the legend is wrong, look at `compare_multipliers`, which pairs estimates with true
values (`identify/multiplier_estimate.py`); if a region is missing or wrong, at `_borders` and at
`ellipse` in that file; if an inset is missing, at the last condition of `_zoom`.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle

from .._core.boundary.checked import checked
from ..errors import DefinitionError
from ..identify.multiplier_estimate import (
    MultiplierFit,
    Multipliers,
    compare_multipliers,
)
from ..identify.rational import RationalFit
from ..linear.ldtp import LDTP
from ..linear.multipliers import largest_first
from ..orbits.cycle import LimitCycle
from .look import COLORS, COLUMN, CYCLE, PAGE, AxesLike, Plot, legend, letters, panels


_MARKERS = "osD^vP*X"
Estimate = RationalFit | MultiplierFit | Multipliers


@checked
def multipliers(
    true: LimitCycle | LDTP | MultiplierFit | Multipliers,
    estimates: Mapping[str, Estimate] | RationalFit | MultiplierFit | None = None,
    *,
    zoom: bool = True,
    ax: AxesLike | None = None,
) -> Plot:
    """Draw Floquet multipliers in the unit disc: true ones as crosses, estimates as open markers.

    The legend gives the largest distance |Δλ| of each estimate from the true multipliers, and an
    inset enlarges the surroundings of the leading multiplier so that the estimates can be told
    apart. Estimates with a covariance get the borders of their 95 % confidence regions.

    **Arguments:**

    - `true`: multipliers (d,), or a `LimitCycle` or `LDTP` that has them; or the estimate with
        which others are compared, such as a `SeriesFit`.
    - `estimates`: by label, a `RationalFit` (one marker per output), a `StructuredFit`,
        `SeriesFit` or the result of `hj.identify.cramer_rao`, or multipliers (d,); or one fit
        without a label. Default: none.
    - `zoom`: whether to draw the inset. Default: True.
    - `ax`: one Axes. Default: a new figure.

    **Returns:** `hj.plot.Plot` with `axes` (1, 1). Multipliers have no unit.

    **Raises:** `DefinitionError` if there are no multipliers, or if `ax` is not one Axes.

    **Example:**

    ```python
    hj.plot.multipliers(cycle, {"structured fit": fit})
    ```

    **Before:** `hj.fit_multipliers`. **After:** `plot.save(path)`.
    """
    reference = "estimate" if isinstance(true, MultiplierFit) else "exact"
    if isinstance(estimates, RationalFit | MultiplierFit):
        estimates = {"fit": estimates}
    elif estimates is None:
        estimates = {}
    borders = _borders({reference: true, **estimates})
    true = _values(true)
    if true.size == 0:
        raise DefinitionError("`true` holds no multiplier to draw.")
    series = _series(estimates)
    cross: dict[str, Any] = {"marker": "+", "ms": 9, "mew": 1.2, "color": "black"}
    markers = [_Markers(reference, true, cross), *_markers_of(series, true)]
    with panels(ax, height=3.5 + 0.15 * len(series)) as axes:
        panel = axes[0, 0]
        _unit_circle(panel)
        _enclose(panel, markers)
        boxes = [panel]
        if zoom and (series or borders):
            boxes += _zoom(panel, true, series, borders)
        for box in boxes:
            for x in markers:
                x.draw(box, borders.get(x.label, []))
        _complex_axes(panel, r"\lambda")
        if ax is None and series:
            legend(panel, "lower center")
        elif series:
            panel.legend()
    return Plot(axes)


class _Markers(NamedTuple):
    """Multipliers with the label of their source, and how they look."""

    label: str
    values: np.ndarray
    look: dict[str, Any]

    def draw(self, ax: Axes, borders: list[np.ndarray]) -> None:
        """Draw them, with the borders of their confidence regions."""
        look = {"label": self.label, **self.look}
        ax.plot(np.real(self.values), np.imag(self.values), ls="", **look)
        for border in borders:
            # Of a real multiplier it is an interval, whose ends would not be seen.
            ends = []
            x = np.real(border)
            y = np.imag(border)
            if np.ptp(y) == 0:
                ends = [int(x.argmin()), int(x.argmax())]
            edge: Any = {"lw": 0.7, "marker": "|", "ms": 5, "markevery": ends}
            ax.plot(x, y, color=look["color"], **edge)


def _markers_of(
    series: Mapping[str, np.ndarray], true: np.ndarray
) -> Iterator[_Markers]:
    """Open markers of the estimates, each with its largest distance from the true multipliers."""
    for k, (label, z) in enumerate(series.items()):
        error = compare_multipliers(z, true).max_error
        look = {
            "ms": 5,
            "mew": 1.0,
            "mfc": "none",
            "marker": _MARKERS[k % len(_MARKERS)],
            "color": CYCLE[k % len(CYCLE)],
            "label": rf"{label}: $|\Delta\lambda|$ = {error:.1e}",
        }
        yield _Markers(label, z, look)


def _enclose(panel: Axes, markers: Sequence[_Markers]) -> None:
    """Set limits around the unit circle and all multipliers."""
    farthest = max(np.abs(x.values).max() for x in markers)
    far = 1.1 * max(1.0, farthest)
    limits = (-far, far)
    panel.set(xlim=limits, ylim=limits, aspect="equal")
    panel.locator_params(nbins=5)


@checked
def poles_zeros(fits: Mapping[str, RationalFit], *, ax: AxesLike | None = None) -> Plot:
    """Draw poles (crosses) and zeros (circles) of rational fits in the z-plane, a column per
    output.

    The upper row shows them all, the lower one the surroundings of the poles. Each family of
    sections has one color, so that a family that moves poles or zeros is seen. The multipliers are
    the N-th powers of the poles.

    **Arguments:**

    - `fits`: results of `hj.identify.fit_rational` by name of the section family, all with the same
      outputs and number of sections.
    - `ax`: two Axes per output. Default: a new figure.

    **Returns:** `hj.plot.Plot` with `axes` (2, ny).

    **Raises:** `DefinitionError` if there are no fits, if their outputs or sections differ, or if
    `ax` does not hold two Axes per output.

    **Example:**

    ```python
    hj.plot.poles_zeros({"clock": hj.identify.fit_rational(htf)})
    ```

    **Before:** `hj.identify.fit_rational`. **After:** `plot.save(path)`.
    """
    if not fits or len({(fit.outputs, fit.n_sections) for fit in fits.values()}) != 1:
        raise DefinitionError(
            "`fits` must hold one or more fits with the same outputs and N."
        )
    first = next(iter(fits.values()))
    outputs = first.outputs
    width = COLUMN if len(outputs) == 1 else PAGE
    with panels(ax, 2, len(outputs), width=width, height=4.0) as axes:
        for i, output in enumerate(outputs):
            upper, lower = axes[:, i]
            for panel in (upper, lower):
                _unit_circle(panel)
                for k, (family, fit) in enumerate(fits.items()):
                    # Equal ones stay visible: each family is smaller than the one before.
                    size = 8 - 2.5 * (k % 3)
                    look = {"color": CYCLE[k % len(CYCLE)], "ms": size, "mew": 1.0}
                    for name, z, marker in (
                        ("poles", fit.poles[i], "x"),
                        ("zeros", fit.zeros[i], "o"),
                    ):
                        look["marker"] = marker
                        look["label"] = f"{name}, {family}"
                        panel.plot(z.real, z.imag, ls="", mfc="none", **look)
            poles = np.concatenate([fit.poles[i] for fit in fits.values()])
            center = np.real(poles).mean()
            reach = 1.5 * np.abs(poles - center).max() or 1.0
            lower.set(xlim=(center - reach, center + reach), ylim=(-reach, reach))
            upper.set_aspect("equal", adjustable="datalim")
            x0, x1 = lower.get_xlim()
            y0, y1 = lower.get_ylim()
            upper.indicate_inset((x0, y0, x1 - x0, y1 - y0), edgecolor="black")
            upper.set_title(output)
            lower.set_title("enlarged: around the poles")
            _complex_axes(lower, "z")
            _complex_axes(upper, "z")
            lower.set_xlabel(
                rf"{lower.get_xlabel()}  (multipliers $\lambda = z^{{{first.n_sections}}}$)"
            )
        legend(axes[0, 0], "upper center", ncols=4 if len(outputs) > 1 else 2)
        letters(axes)
    return Plot(axes)


def _values(source: Any) -> np.ndarray:
    if isinstance(source, LimitCycle | LDTP | MultiplierFit):
        source = source.multipliers
    return np.asarray(source).ravel().astype(complex)


def _series(estimates: Mapping[str, Any]) -> dict[str, np.ndarray]:
    series = {}
    for label, estimate in estimates.items():
        if isinstance(estimate, RationalFit):
            for name, z in zip(estimate.outputs, estimate.multipliers, strict=True):
                series[f"{label}, {name}"] = _values(z)
        else:
            series[label] = _values(estimate)
    return series


def _borders(estimates: Mapping[str, Any]) -> dict[str, list[np.ndarray]]:
    """Return the borders of the confidence regions by label, where covariances are finite."""
    borders = {}
    for label, fit in estimates.items():
        if isinstance(fit, MultiplierFit) and np.isfinite(fit.covariance).all():
            count = len(fit.multipliers)
            borders[label] = [np.asarray(fit.ellipse(i)) for i in range(count)]
    return borders


def _zoom(
    ax: Axes,
    true: np.ndarray,
    series: Mapping[str, np.ndarray],
    borders,
) -> list[Axes]:
    """An inset around the leading true multiplier, at a place that is free of markers; none where
    it would enlarge less than twice or no place is free."""
    largest = largest_first(true)[0]
    leading = complex(true[largest])
    reaches = [1e-12]
    for z in series.values():
        reaches.append(np.abs(z - leading).min())
    for region in borders.values():
        # Of the region next to the leading multiplier, all of it.
        reaches.append(min(np.abs(x - leading).max() for x in region))
    reach = 1.35 * max(reaches)
    side = 0.36
    far = ax.get_xlim()[1]
    values = np.concatenate([true, *series.values()])
    points = (values / far + 1 + 1j) / 2
    places = np.array(
        [
            0.6 + 0.5j,
            0.33 + 0.5j,
            0.5 + 0.5j,
            0.5 + 0.25j,
            0.5 + 0.75j,
        ]
    )
    apart = points - places[:, None]
    larger = np.maximum(np.abs(apart.real), np.abs(apart.imag))
    room = larger.min(axis=1)
    place = places[int(room.argmax())]
    if 2 * reach > side * far or room.max() < side / 2:
        return []
    inset = ax.inset_axes(
        (place.real - side / 2, place.imag - side / 2, side, side),
        xlim=leading.real + np.array([-reach, reach]),
        ylim=leading.imag + np.array([-reach, reach]),
        aspect="equal",
        xticks=[],
        yticks=[],
    )
    # (Numbers at its ticks would be long and differ in their last digits.)
    width = f"{2 * reach:.1e} wide"
    inset.text(0.5, 0.02, width, transform=inset.transAxes, ha="center", size=6)
    inset.spines[:].set(visible=True, color="0.4")
    ax.indicate_inset_zoom(inset, edgecolor="0.4")
    return [inset]


def _unit_circle(ax: Axes) -> None:
    ax.add_patch(Circle((0, 0), 1, fill=False, ec=COLORS["gray"], lw=0.6, zorder=0))
    ax.axhline(0, color=COLORS["gray"], lw=0.3, zorder=0)
    ax.axvline(0, color=COLORS["gray"], lw=0.3, zorder=0)


def _complex_axes(ax: Axes, symbol: str) -> None:
    ax.set(xlabel=rf"$\mathrm{{Re}}\,{symbol}$", ylabel=rf"$\mathrm{{Im}}\,{symbol}$")
