"""Harmonic transfer functions against frequency (paper Figs. 3 and 4)."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from .._core.boundary.checked import checked
from .._core.boundary.kinds import Positive, SignalNames
from .._core.signal import ratio, with_unit
from ..errors import DefinitionError
from ..identify.multipliers import StructuredFit
from ..identify.rational import RationalFit
from ..linear.htf import HTF
from .look import COLORS, COLUMN, CYCLE, PAGE, AxesLike, Plot, label_of, letters, panels


Fit = RationalFit | StructuredFit

_FREQUENCY = "input frequency $f$ (cycles/period)"
_OUTPUTS = [COLORS[name] for name in ("green", "red", "blue", "purple", "orange", "sky")]


@checked
def magnitude(
    *htfs: HTF,
    output: str | int = 0,
    input: str | int = 0,
    harmonics: Sequence[int] = (0, 1, -1),
    decades: Positive = 5,
    labels: Mapping[str, str] | None = None,
    ax: AxesLike | None = None,
) -> Plot:
    """|H_m| of one output against the input frequency, on a logarithmic scale.

    One color per |m|, dashed for negative m. Exact HTFs lie as broad pale lines under the
    estimates, wherever they stand in the arguments. HTFs with a variance have a band that holds
    the true value at each frequency with a probability of 95 %.

    **Arguments:** `output`, `input`: names or indices. `decades`: how far below the largest
    value the scale reaches. `labels`: texts for the names. `ax`: by default a new figure.

    **Raises:** `DefinitionError` for an output, input or harmonic that is not there.
    """
    if not htfs:
        raise DefinitionError("`htfs` holds no HTF to draw.")
    if not harmonics:
        raise DefinitionError("`harmonics` must hold one harmonic or more.")
    with panels(ax, height=2.2) as axes:
        panel = axes[0, 0]
        for htf in sorted(htfs, key=_estimates_last):
            i, j = _index(htf.outputs, output), _index(htf.inputs, input)
            f, order = _sorted(htf)
            for m in harmonics:
                size = np.abs(np.asarray(htf.harmonic(m))[order, i, j])
                line = _line(htf, htfs, _harmonic_style(m, harmonics), _name(m))
                panel.plot(f, size, **line)
                _band(panel, f, size, _radius(htf, m, order, i, j), line, 0.3 * np.min(size))
        unit = ratio(htf.outputs[i], htf.inputs[j])
        size = with_unit(f"$|H_m|$, {label_of(htf.outputs[i], labels)}", unit)
        panel.set(yscale="log", xlabel=_FREQUENCY, ylabel=size)
        _frequency_limits(panel, f)
        top = max(np.nanmax(line.get_ydata()) for line in panel.get_lines())
        panel.set_ylim(top * 10.0**-decades, top * 2)
        _legend(panel, htfs)
    return Plot(axes)


@checked
def harmonics(
    families: Mapping[str, HTF | Sequence[HTF]],
    harmonics: Sequence[int] = (0, 1, -1),
    *,
    input: str | int = 0,
    decades: Positive = 5,
    labels: Mapping[str, str] | None = None,
    ax: AxesLike | None = None,
) -> Plot:
    """The paper's Fig. 3: |H_m|, one row per output and one column per section family.

    **Arguments:** `families`: by name, an HTF or several (estimate and exact), all with the same
    outputs. `harmonics`, `input`, `decades` and `labels` as in `magnitude`; a row shares one
    scale.
    """
    columns = _columns(families)
    outputs = columns[0][1][0].outputs
    size = {"width": _width(columns), "height": 0.4 + 1.7 * len(outputs)}
    with panels(ax, len(outputs), len(columns), **size, sharex=True, sharey="row") as axes:
        for i, output in enumerate(outputs):
            limits = []
            for k, (_, htfs) in enumerate(columns):
                magnitude(
                    *htfs, output=output, input=input, harmonics=harmonics, decades=decades,
                    labels=labels, ax=axes[i, k],
                )  # fmt: skip
                limits.append(axes[i, k].get_ylim())
                _tidy(axes[i, k], axes)
            axes[i, 0].set_ylim(*np.max(limits, axis=0))
        for k, (family, _) in enumerate(columns):
            axes[0, k].set_title(family)
        letters(axes)
    return Plot(axes)


@checked
def bode(
    *htfs: HTF,
    fits: Fit | Sequence[Fit] = (),
    harmonic: int = 0,
    outputs: SignalNames | None = None,
    input: str | int = 0,
    labels: Mapping[str, str] | None = None,
    ax: AxesLike | None = None,
) -> Plot:
    """Magnitude and phase of one harmonic for several outputs, with fits in black on top.

    **Arguments:**

    - `htfs`: exact ones lie as broad pale lines under the estimates, and those with a variance
      have bands that hold the true values with a probability of 95 %; their phase is drawn where
      it is known, which it is not where the band reaches down to zero.
    - `fits`: of this harmonic, drawn over the band of the HTFs.
    - `outputs`: names; by default all. One color each.
    - `ax`: two Axes, for magnitude and phase; by default a new figure.

    **Raises:** `DefinitionError` for a name or harmonic that is not there.
    """
    if not htfs:
        raise DefinitionError("`htfs` holds no HTF to draw.")
    fits = (fits,) if isinstance(fits, Fit) else tuple(fits)
    with panels(ax, 2, 1, height=3.4, sharex=True) as axes:
        _bode(axes[:, 0], htfs, fits, harmonic, outputs, input, labels)
        axes[0, 0].set_xlabel("")
    return Plot(axes)


def _bode(axes, htfs, fits, harmonic: int, outputs, input: str | int, labels) -> None:
    upper, lower = axes
    first = htfs[0]
    names = first.outputs if outputs is None else outputs
    pushed = first.inputs[_index(first.inputs, input)]
    units = [ratio(first.outputs[_index(first.outputs, name)], pushed) for name in names]
    same = units[0] if len(set(units)) == 1 else ""  # else each curve says its own
    for number, (name, unit) in enumerate(zip(names, units, strict=True)):
        color, reference = _OUTPUTS[number % len(_OUTPUTS)], None
        for htf in sorted(htfs, key=_estimates_last):
            f, order = _sorted(htf)
            i, j = _index(htf.outputs, name), _index(htf.inputs, input)
            values = np.asarray(htf.harmonic(harmonic))[order, i, j]
            label = with_unit(label_of(name, labels), "" if same else unit)
            line = _line(htf, htfs, {"color": color}, label)
            size, radius = np.abs(values), _radius(htf, harmonic, order, i, j)
            known = np.full(len(f), True) if radius is None else radius < size
            reference = _curve(upper, lower, f, values, reference, known, **line)
            _band(upper, f, size, radius, line, 0.3 * np.min(size))
            if radius is not None:
                turn = np.degrees(np.arcsin(radius[known] / size[known]))
                phase, turn = (_spread(known, x, len(f)) for x in (reference[1], turn))
                _band(lower, f, phase, turn, line)
        for fit in fits:
            values = _evaluate(fit, f, harmonic, name, input)
            line = {"color": "black", "lw": 0.8, "ls": (0, (4, 1.5)), "zorder": 5}
            reference = _curve(upper, lower, f, values, reference, **line)
    for fit in dict.fromkeys(type(fit) for fit in fits):
        upper.plot([], [], color="black", lw=0.8, ls=(0, (4, 1.5)), label=_FIT_NAMES[fit])
    size = with_unit(f"$|{_name(harmonic)[1:-1]}|$", same)
    upper.set(yscale="log", xlabel=_FREQUENCY, ylabel=size)
    lower.set(xlabel=_FREQUENCY, ylabel=f"$\\angle {_name(harmonic)[1:-1]}$ (degrees)")
    _frequency_limits(upper, f)
    _frequency_limits(lower, f)
    lower.yaxis.set_major_locator(MaxNLocator(6, steps=[1, 1.8, 4.5, 9]))
    _legend(upper, htfs)


@checked
def bodes(
    families: Mapping[str, HTF | Sequence[HTF]],
    *,
    fits: Mapping[str, Fit | Sequence[Fit]] | None = None,
    harmonic: int = 0,
    input: str | int = 0,
    labels: Mapping[str, str] | None = None,
    ax: AxesLike | None = None,
) -> Plot:
    """The paper's Fig. 4: a Bode plot of one harmonic with its fits, one column per family.

    **Arguments:** `families` and `fits`: by the same names; the others as in `bode`.

    **Raises:** `DefinitionError` for fits of a family that is not there.
    """
    columns, fits = _columns(families), dict(fits or {})
    for name in fits:
        if name not in families:
            raise DefinitionError(f"there are fits of '{name}', but the HTFs are {list(families)}.")
    size = {"width": _width(columns), "height": 3.4}
    with panels(ax, 2, len(columns), **size, sharex=True, sharey="row") as axes:
        for k, (family, htfs) in enumerate(columns):
            bode(
                *htfs, fits=fits.get(family, ()), harmonic=harmonic, input=input, labels=labels,
                ax=axes[:, k],
            )  # fmt: skip
            axes[0, k].set_title(family)
            for one in axes[:, k]:
                _tidy(one, axes)
        letters(axes)
    return Plot(axes)


_FIT_NAMES: dict[type, str] = {RationalFit: "rational fit", StructuredFit: "structured fit"}


def _columns(families) -> list[tuple[str, tuple[HTF, ...]]]:
    columns = [(k, (v,) if isinstance(v, HTF) else tuple(v)) for k, v in dict(families).items()]
    if not columns or any(not htfs for _, htfs in columns):
        raise DefinitionError("`families` must hold at least one HTF in each family.")
    if len({htf.outputs for _, htfs in columns for htf in htfs}) > 1:
        raise DefinitionError("the families must have the same outputs to share a figure.")
    return columns


def _width(columns) -> float:
    return COLUMN if len(columns) == 1 else PAGE


def _index(names: Sequence[str], which: str | int) -> int:
    if isinstance(which, str) and which in names:
        return names.index(which)
    if not isinstance(which, str) and -len(names) <= which < len(names):
        return int(which)
    raise DefinitionError(f"there is no {which!r} among {', '.join(names)}.")


def _sorted(htf: HTF):
    f = np.asarray(htf.f)
    order = np.argsort(f)
    return f[order], order


def _frequency_limits(ax: Axes, f) -> None:
    step = f[1] - f[0] if len(f) > 1 else 1.0
    ax.set_xlim(min(0.0, f[0]), f[-1] + step)


def _estimates_last(htf: HTF) -> bool:
    return htf.source != "exact"


def _name(m: int) -> str:
    return f"$H_{{{m}}}$"


def _harmonic_style(m: int, shown: Sequence[int]) -> dict:
    sizes = sorted({abs(k) for k in shown})
    dashed = m < 0 and -m in shown
    return {
        "color": CYCLE[sizes.index(abs(m)) % len(CYCLE)],
        "ls": (0, (3, 1.5)) if dashed else "-",
    }


def _line(htf: HTF, htfs: Sequence[HTF], line: dict, label: str) -> dict:
    """Exact HTFs broad and pale, without a label where an estimate of the same curve has one."""
    if htf.source == "exact":
        label = "" if any(map(_estimates_last, htfs)) else label
        return {**line, "ls": "-", "lw": 3.0, "alpha": 0.3, "zorder": 1, "label": label}
    return {**line, "lw": 0.9, "zorder": 3, "label": label}


def _radius(htf: HTF, m: int, order, i: int, j: int) -> np.ndarray | None:
    """Of the discs that hold the true values, or None if that is not known."""
    if htf.variance is None:
        return None
    return np.asarray(htf.select(m).confidence_radius())[0, order, i, j]


def _band(ax: Axes, f, middle, radius, line: dict, floor: float = -np.inf) -> None:
    if radius is None:
        return
    known = np.isfinite(radius)
    low = np.where(known, np.maximum(middle - radius, floor), np.nan)
    high = np.where(known, middle + radius, np.nan)
    ax.fill_between(f, low, high, color=line["color"], alpha=0.25, lw=0, zorder=2)


def _curve(upper: Axes, lower: Axes, f, values, reference, known: Any = slice(None), **line):
    """Draw magnitude and phase, where it is known; whole turns of phase are chosen as in the curve
    before."""
    phase = np.degrees(np.unwrap(np.angle(values[known])))
    if reference is not None and len(phase) and len(reference[0]):
        turns = np.median(np.interp(f[known], *reference) - phase) / 360
        phase = phase + 360 * np.round(turns)
    upper.plot(f, np.abs(values), **line)
    lower.plot(f, _spread(known, phase, len(f)), **line)
    return f[known], phase


def _spread(known, values, count: int) -> np.ndarray:
    """Values where they are known, NaN elsewhere, so that lines have gaps."""
    out = np.full(count, np.nan)
    out[known] = values
    return out


def _evaluate(fit: Fit, f, harmonic: int, output: str, input: str | int) -> np.ndarray:
    i = _index(fit.outputs, output)
    if isinstance(fit, StructuredFit):
        return np.asarray(fit.htf(f, harmonic).H)[0, :, i, _index(fit.inputs, input)]
    if fit.harmonic != harmonic:
        raise DefinitionError(f"the rational fit is of H_{fit.harmonic}, not of H_{harmonic}.")
    return np.asarray(fit.htf(f).H)[0, :, i, 0]


def _legend(ax: Axes, htfs: Sequence[HTF]) -> None:
    if any(htf.source == "exact" for htf in htfs):
        ax.plot([], [], color="0.5", lw=3.0, alpha=0.3, label="exact")
    ax.legend(loc="upper right", ncols=2)


def _tidy(ax: Axes, axes) -> None:
    """In a grid: labels at its edges and one legend only."""
    ax.label_outer()
    if ax is not axes[0, -1] and (legend := ax.get_legend()):
        legend.remove()
