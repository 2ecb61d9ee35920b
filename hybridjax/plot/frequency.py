"""Figures of harmonic transfer functions against frequency (paper Figs. 3 and 4): `htf` and `bode`.

Both sort HTFs such that exact ones lie below estimates (`_exact_first`, which also evaluates
models), and read curves with the radii of their confidence discs by `_values`. `htf` draws
magnitudes (`_magnitude`), `bode` magnitudes and phases (`_BodePanels`, with the axes of `_Scale`).
A dict of HTFs becomes a grid of such panels (`_grid`).

Colors and lines (`_line`, `_harmonic_style`, `_FIT_STYLE`) are a matter of taste. What is drawn is
not: bands are those of `HTF.confidence_radius`, and a phase whose disc contains zero is left out.

If a curve or a band is at wrong values, look at `_values`; if a phase is off by whole turns or
missing, at `_phase` and at `is_certain` in `_BodePanels.response`. If the unit of frequencies is
wrong, look at `_Scale`; if that of magnitudes is, at `_Curve.unit`, and for `htf` at `_magnitude`.
"""

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Literal, NamedTuple, cast

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from .._core.arguments import channel_index, require_among
from .._core.boundary.checked import checked
from .._core.boundary.kinds import Positive, SignalNames
from .._core.signal import SECONDS, ratio, with_unit
from ..errors import DefinitionError
from ..identify.joint.fit import LDTPFit
from ..identify.multipliers import StructuredFit
from ..identify.rational import RationalFit
from ..identify.series.fit import SeriesFit
from ..linear.htf import HTF
from ..linear.ldtp import LDTP
from ..orbits.cycle import LimitCycle
from ..systems.system import name_of
from .look import COLORS, COLUMN, CYCLE, PAGE, AxesLike, Plot, letters, panels


InBand = RationalFit | StructuredFit
"""Fits to HTFs, which hold in the band of these."""
Fit = InBand | SeriesFit | LDTPFit
Transfer = HTF | LDTP | Fit
"""HTFs, and models and fits, whose HTFs are drawn at the frequencies of the first HTF beside them,
or over all frequencies."""
Families = Mapping[str, Transfer | Sequence[Transfer]]
"""HTFs by name, such as that of a family of sections."""
Fits = Fit | Sequence[Fit]
Unit = Literal["cycles/period", "Hz", "rad/s"]
"""Units of frequencies."""
FREQUENCY = "input frequency $f$ (cycles/period)"
# Frequencies at which models without an HTF beside them are drawn, up to half of their sections in
# a period. Fewer: peaks have corners. More: time.
_FREQUENCIES = 501
_OUTPUTS = [
    COLORS[name] for name in ("green", "red", "blue", "purple", "orange", "sky")
]
_FIT_STYLE = {"color": "black", "lw": 0.8, "ls": (0, (4, 1.5))}


@checked
def htf(
    *htfs: Transfer | Sequence[Transfer] | Families,
    output: str | int | None = None,
    input: str | int = 0,
    harmonics: Sequence[int] = (0, 1, -1),
    decades: Positive = 5,
    ax: AxesLike | None = None,
) -> Plot:
    """Draw |H_m| against the input frequency, on a logarithmic scale.

    One color per |m|, dashed for negative m. Exact HTFs, and those of models (`LDTP`), are drawn as
    broad pale lines under the estimates, in any order of the arguments. Models and fits are drawn
    at the frequencies of the first HTF. Without an HTF, they are drawn over all frequencies. HTFs
    with a variance have a band that holds the true value at each frequency with a probability of
    95 %.

    **Arguments:**

    - `htfs`: one HTF or several, also in a list, for a panel with one output; or a dict by name
      (the paper's Fig. 3), for a column for each name and a row for each output. An entry is an
      HTF, or several (an estimate, and an exact HTF or a model); all have the same outputs, and a
      row shares one scale. Models, fits and the results of `hj.identify_recording` stand for their
      HTFs.
    - `output`: name or index. Default: the first; all outputs of a dict.
    - `input`: name or index. The axis names the input if there are several. Default: 0.
    - `harmonics`: the m of the H_m. Default: (0, 1, -1).
    - `decades`: number of decades of the scale below the largest value. Default: 5.
    - `ax`: one Axes per panel. Default: a new figure.

    **Returns:** `hj.plot.Plot` with `axes` (1, 1), or (outputs, names) of a dict. Frequencies are
    in cycles per period, magnitudes in units of the output per unit of the input.

    **Raises:** `DefinitionError` for an output, input or harmonic that does not exist, or if `ax`
    does not hold one Axes per panel.

    **Example:**

    ```python
    hj.plot.htf(htf, model, output="yM", harmonics=(0, 1))
    ```

    **Before:** `hj.estimate_htf`. **After:** `hj.fit_multipliers`.
    """
    families = _families(htfs)
    if families is None:
        drawn = _exact_first(_one_by_one(htfs))
        shown = 0 if output is None else output
        with panels(ax, height=2.2) as axes:
            _magnitude(axes[0, 0], drawn, shown, input, harmonics, decades)
        return Plot(axes)
    by_name = _by_column(families)
    columns = {name: _exact_first(given) for name, given in by_name.items()}
    outputs = next(iter(columns.values()))[0].outputs
    if output is not None:
        outputs = (_pick("output", output, outputs),)
    with _grid(columns, len(outputs), 0.4 + 1.7 * len(outputs), ax) as axes:
        for row, name in zip(axes, outputs, strict=True):
            limits = []
            for panel, drawn in zip(row, columns.values(), strict=True):
                _magnitude(panel, drawn, name, input, harmonics, decades)
                limits.append(panel.get_ylim())
            row[0].set_ylim(*np.max(limits, axis=0))
    return Plot(axes)


def _magnitude(
    panel: Axes,
    drawn: list[HTF],
    output: str | int,
    input: str | int,
    harmonics: Sequence[int],
    decades: float,
) -> None:
    if not harmonics:
        raise DefinitionError("`harmonics` must hold one harmonic or more.")
    first = drawn[0]
    name = _pick("output", output, first.outputs)
    pushed = _pick("input", input, first.inputs)
    for htf in drawn:
        for m in harmonics:
            observed = _same(name, output, htf.outputs)
            excited = _same(pushed, input, htf.inputs)
            f, values, radius = _values(htf, m, observed, excited)
            size = np.abs(values)
            style = _harmonic_style(m, harmonics)
            line = _line(htf, drawn, style, _name(m))
            panel.plot(f, size, **line)
            if radius is not None:
                edges = _edges(size, radius, 0.3 * np.min(size))
                _fill(panel, f, *edges, line["color"])
    curve = _curve(name, pushed, first)
    label = with_unit(f"$|H_m|$, {curve}", ratio(name, pushed))
    panel.set(yscale="log", xlabel=FREQUENCY, ylabel=label)
    _frequency_limits(panel, f)
    top = max(np.nanmax(line.get_ydata()) for line in panel.get_lines())
    panel.set_ylim(top * 10.0**-decades, top * 2)
    _legend(panel, drawn)


@checked
def bode(
    *htfs: Transfer | Sequence[Transfer] | Families,
    fits: Fits | Mapping[str, Fits] = (),
    harmonic: int = 0,
    outputs: SignalNames | None = None,
    input: str | int | None = None,
    unit: Unit = "cycles/period",
    period: Positive | LimitCycle | None = None,
    log: bool = False,
    ax: AxesLike | None = None,
) -> Plot:
    """Draw magnitude and phase of one harmonic for several outputs and inputs, with fits in black.

    **Arguments:**

    - `htfs`: one HTF or several, also in a list; or a dict of them by name (the paper's Fig. 4),
      for a column for each name. Exact HTFs, and those of models (`LDTP`), are drawn as broad pale
      lines under the estimates: models at the frequencies of the first HTF, and models alone over
      all. HTFs with a variance have bands that contain the true values with a probability of 95 %.
      Their phase is not drawn where the band of the magnitude contains zero. Fits to data, and the
      results of `hj.identify_recording`, are drawn as models are if they are alone, and beside
      HTFs or models as `fits`.
    - `fits`: fits to this harmonic, drawn over the frequency band of the HTFs, each for the inputs
      that it has; by name beside a dict of HTFs. Default: none.
    - `harmonic`: the m of H_m. Default: 0.
    - `outputs`: names of outputs. Default: all.
    - `input`: name or index of one input. Each output and input has a curve of its own color.
      Default: all.
    - `unit`: the unit of frequencies, "cycles/period", "Hz" or "rad/s". The latter two need
      `period`. Default: "cycles/period".
    - `period`: the period in seconds, such as `result.phase.periods.mean()` of a recording, or the
      limit cycle, whose `time_unit` then counts. Default: None.
    - `log`: True draws as control engineers do, with a logarithmic axis of frequencies, from the
      lowest positive one on, and the magnitude in decibels, 20 log10 of its value in units of the
      output per unit of the input. Default: False.
    - `ax`: two Axes, for magnitude and phase; two per name of a dict. Default: a new figure.

    **Returns:** `hj.plot.Plot` with `axes` (2, 1), or (2, names) of a dict. Frequencies are in
    `unit`, magnitudes in units of the output per unit of the input (with `log`, in decibels of
    these), phases in degrees.

    **Raises:** `DefinitionError` for a name or harmonic that does not exist, for fits that have
    none of the inputs, for a fit to HTFs without an HTF beside it, for a unit of time without a
    period, if no frequency is positive on a
    logarithmic axis, or if `ax` does not hold one Axes per panel.

    **Example:**

    ```python
    hj.plot.bode(htf, model, fits=fit, outputs=("yM",))
    hj.plot.bode(htf, unit="Hz", period=cycle, log=True)
    ```

    **Before:** `hj.estimate_htf`. **After:** `hj.fit_multipliers`.
    """
    families = _families(htfs)
    if families is not None:
        options = dict(harmonic=harmonic, outputs=outputs, input=input)
        axis = dict(unit=unit, period=period, log=log)
        return _bodes(families, fits, options | axis, ax)
    scale = _Scale.of(unit, period, log)
    if isinstance(fits, Mapping):
        raise DefinitionError("`fits` by name need HTFs by name: pass a dict of them.")
    shown, beside = _apart(_one_by_one(htfs))
    if not any(isinstance(htf, HTF) for htf in shown):
        _refuse_in_band(beside)
    drawn = _exact_first(shown)
    fits = (*beside, *((fits,) if isinstance(fits, Fit) else fits))
    fitted = [fit.htf(drawn[-1].frequencies) for fit in fits]
    curves = _curves(drawn[0], outputs, input)
    for htf in fitted:
        if all(curve.input not in htf.inputs for curve in curves):
            _pick("input", curves[0].input, htf.inputs)
    units = {curve.unit for curve in curves}
    # (Where units differ, the label of each curve has its own.)
    same = units.pop() if len(units) == 1 else ""
    with panels(ax, 2, 1, height=3.4, sharex=True) as axes:
        upper, lower = axes[:, 0]
        bode_panels = _BodePanels(upper, lower, scale)
        for number, curve in enumerate(curves):
            color = _OUTPUTS[number % len(_OUTPUTS)]
            label = with_unit(curve.label, "" if same else curve.unit)
            bode_panels.curve(curve, harmonic, drawn, fitted, color, label)
        for kind in dict.fromkeys(htf.source for htf in fitted):
            upper.plot([], [], **_FIT_STYLE, label=kind)
        symbol = _name(harmonic)[1:-1]
        bode_panels.label(symbol, same, np.asarray(drawn[-1].frequencies))
        # (Over a logarithmic axis the upper right corner is no longer empty.)
        _legend(upper, drawn, over_log=log)
    return Plot(axes)


class _Scale(NamedTuple):
    """How a Bode plot shows frequencies and magnitudes."""

    label: str
    """The label of the axis of frequencies."""
    factor: float
    """A frequency in its unit, of one cycle per period."""
    log: bool
    """Frequencies on a logarithmic axis, and magnitudes in decibels."""

    @classmethod
    def of(cls, unit: str, period: float | LimitCycle | None, log: bool) -> "_Scale":
        """**Raises:** `DefinitionError` for a unit of time without a period in seconds."""
        if unit == "cycles/period":
            return cls(FREQUENCY, 1.0, log)
        if period is None:
            raise DefinitionError(
                f"bode: `unit='{unit}'` needs the `period`: pass the limit cycle, or seconds, such "
                "as `result.phase.periods.mean()` of a recording."
            )
        seconds = _seconds(period) if isinstance(period, LimitCycle) else period
        if unit == "Hz":
            return cls("input frequency (Hz)", 1 / seconds, log)
        return cls("input frequency $\\omega$ (rad/s)", 2 * np.pi / seconds, log)

    def magnitude(self, size: np.ndarray) -> np.ndarray:
        if not self.log:
            return size
        with np.errstate(divide="ignore"):
            return 20 * np.log10(size)


def _seconds(cycle: LimitCycle) -> float:
    """Return the period of a cycle in seconds. (A system without a unit of time has seconds.)

    **Raises:** `DefinitionError` for a unit that is none of time.
    """
    unit = cycle.system.time_unit
    if unit and unit not in SECONDS:
        raise DefinitionError(
            f"bode: the unit of time of {name_of(cycle.system)}, '{unit}', is none of "
            f"{', '.join(SECONDS)}: pass `period` in seconds."
        )
    return float(cycle.period) * SECONDS.get(unit, 1.0)


class _BodePanels(NamedTuple):
    """The two panels of a Bode plot."""

    upper: Axes
    lower: Axes
    scale: _Scale

    def curve(
        self,
        curve: "_Curve",
        harmonic: int,
        drawn: Sequence[HTF],
        fitted: Sequence[HTF],
        color: str,
        label: str,
    ) -> None:
        """Draw one output and input of all HTFs in one color, and of fits in black."""
        reference = None
        for htf in drawn:
            line = _line(htf, drawn, {"color": color}, label)
            reference = self.response(htf, harmonic, curve, line, reference)
        for htf in fitted:
            if curve.input in htf.inputs:
                line = {**_FIT_STYLE, "zorder": 5}
                self.response(htf, harmonic, curve, line, reference)

    def response(
        self,
        htf: HTF,
        harmonic: int,
        curve: "_Curve",
        line: dict[str, Any],
        reference: tuple | None,
    ) -> tuple:
        """Draw magnitude and phase of one curve, with whole turns as in `reference`; return the
        next reference: frequencies and phases that are certain."""
        pushed = _same(curve.input, curve.which, htf.inputs)
        f, values, radius = _values(htf, harmonic, curve.output, pushed)
        size = np.abs(values)
        is_certain = np.full(len(f), True)
        if radius is not None:
            is_certain = radius < size
            # (Parts of a line, no single points.)
            neighbors = np.convolve(is_certain, np.ones(3))[1:-1]
            is_certain &= neighbors > 1
        phase = _phase(f, values, is_certain, reference)
        shown = f * self.scale.factor
        self.upper.plot(shown, self.scale.magnitude(size), **line)
        self.lower.plot(shown, phase, **line)
        if radius is not None:
            color = line["color"]
            low, high = _edges(size, radius, 0.3 * np.min(size))
            edges = self.scale.magnitude(low), self.scale.magnitude(high)
            _fill(self.upper, shown, *edges, color)
            sine = np.where(is_certain, radius, np.nan) / size
            edges = _edges(phase, np.degrees(np.arcsin(sine)))
            _fill(self.lower, shown, *edges, color)
        return f[is_certain], phase[is_certain]

    def label(self, symbol: str, unit: str, frequencies: np.ndarray) -> None:
        """Label the axes, and set their limits and ticks.

        **Arguments:** `unit`: that of all magnitudes; "" where they differ or have none.

        **Raises:** `DefinitionError` for a logarithmic axis without a positive frequency.
        """
        f = np.sort(frequencies) * self.scale.factor
        magnitude = with_unit(f"$|{symbol}|$", unit)
        if self.scale.log:
            reference = f"dB of 1 {unit}" if unit else "dB"
            magnitude = f"$|{symbol}|$ ({reference})"
        else:
            self.upper.set_yscale("log")
        self.upper.set_ylabel(magnitude)
        self.lower.set(xlabel=self.scale.label, ylabel=f"$\\angle {symbol}$ (degrees)")
        self.lower.yaxis.set_major_locator(MaxNLocator(6, steps=[1, 1.8, 4.5, 9]))
        for panel in self:
            if isinstance(panel, Axes):
                self._limit(panel, f)

    def _limit(self, panel: Axes, f: np.ndarray) -> None:
        if not self.scale.log:
            _frequency_limits(panel, f)
            return
        positive = f[f > 0]
        if not len(positive):
            raise DefinitionError(
                "bode: a logarithmic axis needs a frequency above 0: pass `log=False`."
            )
        panel.set_xscale("log")
        panel.set_xlim(positive[0], 1.001 * positive[-1])
        panel.grid(which="both", color="0.9", lw=0.4)


class _Curve(NamedTuple):
    """One output and one input of a Bode plot."""

    output: str
    input: str
    which: str | int
    """The input as the caller gave it: a loop's input has another name, that of its reference."""
    label: str

    @property
    def unit(self) -> str:
        return ratio(self.output, self.input)


def _curves(
    htf: HTF, outputs: Sequence[str] | None, input: str | int | None
) -> list[_Curve]:
    inputs = range(len(htf.inputs)) if input is None else [input]
    curves = []
    names = htf.outputs if outputs is None else outputs
    for name in names:
        output = _pick("output", name, htf.outputs)
        for which in inputs:
            pushed = _pick("input", which, htf.inputs)
            label = _curve(output, pushed, htf) if input is None else output
            curves.append(
                _Curve(
                    output=output,
                    input=pushed,
                    which=which,
                    label=label,
                )
            )
    return curves


def _bodes(
    families: Families,
    fits: Fits | Mapping[str, Fits],
    options: dict[str, Any],
    ax: AxesLike | None,
) -> Plot:
    """Bode plots side by side, with the same options of `bode`."""
    columns = _by_column(families)
    if not isinstance(fits, Mapping):
        fits = dict.fromkeys(families, fits)
    require_among("name", fits, families, "`fits`: ")
    with _grid(columns, 2, 3.4, ax) as axes:
        for k, (family, drawn) in enumerate(columns.items()):
            bode(*drawn, fits=fits.get(family, ()), ax=axes[:, k], **options)
    return Plot(axes)


Given = Sequence[Transfer | Sequence[Transfer] | Families]


def _one_by_one(htfs: Given) -> list[Transfer]:
    """HTFs without the lists in which some were given."""
    found: list[Transfer] = []
    for given in htfs:
        found += [given] if isinstance(given, Transfer) else cast(Sequence, given)
    return found


def _families(htfs: Given) -> Families | None:
    """HTFs by name, if a dict of them was given."""
    named = [x for x in htfs if isinstance(x, Mapping)]
    if not named:
        return None
    if len(htfs) > 1:
        raise DefinitionError("pass HTFs, or one dict of them by name, not both.")
    return named[0]


def _by_column(families: Families) -> dict[str, tuple[Transfer, ...]]:
    columns: dict[str, tuple[Transfer, ...]] = {}
    outputs: set[tuple[str, ...]] = set()
    for name, htfs in dict(families).items():
        columns[name] = (htfs,) if isinstance(htfs, Transfer) else tuple(htfs)
        outputs.update(htf.outputs for htf in columns[name])
    if not columns or not all(columns.values()):
        raise DefinitionError("a dict of HTFs must hold at least one for each name.")
    if len(outputs) > 1:
        raise DefinitionError("HTFs must have the same outputs to share a figure.")
    return columns


def _apart(htfs: Sequence[Transfer]) -> tuple[list[Transfer], list[Fit]]:
    """HTFs and models, and the fits to be drawn over them; fits alone are drawn as HTFs are."""
    fits = [x for x in htfs if isinstance(x, Fit)]
    others: list[Transfer] = [x for x in htfs if not isinstance(x, Fit)]
    return (others, fits) if others else (list(htfs), [])


@contextlib.contextmanager
def _grid(
    columns,
    rows: int,
    height: float,
    ax: AxesLike | None,
) -> Iterator[np.ndarray]:
    """Panels with a column for each family: labels at the edges of the grid and one legend."""
    size = {"width": COLUMN if len(columns) == 1 else PAGE, "height": height}
    with panels(ax, rows, len(columns), **size, sharex=True, sharey="row") as axes:
        yield axes
        for panel in axes.flat:
            panel.label_outer()
            legend = panel.get_legend()
            if legend is not None and panel is not axes[0, -1]:
                legend.remove()
        for panel, family in zip(axes[0], columns, strict=True):
            panel.set_title(family)
        letters(axes)


def _refuse_in_band(fits: Sequence[Transfer]) -> None:
    """**Raises:** `DefinitionError` for a fit that holds in the band of its data, where it would be
    drawn over all frequencies."""
    for fit in fits:
        if isinstance(fit, InBand):
            raise DefinitionError(
                f"a {type(fit).__name__} holds in the band of its data: draw it beside their HTF, "
                "`hj.plot.bode(htf, fit)`, or its own, `fit.htf(frequencies)`."
            )


def _exact_first(htfs: Sequence[Transfer]) -> list[HTF]:
    if not htfs:
        raise DefinitionError("`htfs` holds nothing to draw.")
    grids = [htf.frequencies for htf in htfs if isinstance(htf, HTF)]
    if not grids:
        _refuse_in_band(htfs)
        grids = [np.linspace(0, htfs[0].n_sections / 2, _FREQUENCIES)]
    drawn = [htf if isinstance(htf, HTF) else htf.htf(grids[0]) for htf in htfs]
    return sorted(drawn, key=lambda htf: htf.source != "exact")


def _pick(kind: str, which: str | int, names: Sequence[str]) -> str:
    return names[channel_index(kind, which, names)]


def _curve(output: str, pushed: str, htf: HTF) -> str:
    """The name of a curve, with the input where an HTF has several."""
    return output if len(htf.inputs) == 1 else f"{output} from {pushed}"


def _same(name: str, which: str | int, names: Sequence[str]) -> str | int:
    """The signal of this name, or else `which` (a loop's input is its reference)."""
    return name if name in names else which


def _values(
    htf: HTF,
    m: int,
    output: str | int,
    input: str | int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Return frequencies in ascending order, the values of H_m, and the radii of the discs that
    hold the true values; None without a variance."""
    order = np.argsort(htf.frequencies)
    i = channel_index("output", output, htf.outputs)
    j = channel_index("input", input, htf.inputs)
    values = np.asarray(htf[m])[order, i, j]
    radius = None
    if htf.variance is not None:
        radii = np.asarray(htf.select(m).confidence_radius())
        radius = radii[0, order, i, j]
    return np.asarray(htf.frequencies)[order], values, radius


def _frequency_limits(ax: Axes, f) -> None:
    spacing = f[1] - f[0] if len(f) > 1 else 1.0
    first = min(0.0, f[0])
    ax.set_xlim(first, f[-1] + spacing)


def _name(m: int) -> str:
    return f"$H_{{{m}}}$"


def _harmonic_style(m: int, shown: Sequence[int]) -> dict:
    sizes = sorted({abs(k) for k in shown})
    dashed = m < 0 and -m in shown
    color = CYCLE[sizes.index(abs(m)) % len(CYCLE)]
    return {"color": color, "ls": (0, (3, 1.5)) if dashed else "-"}


def _line(htf: HTF, htfs: Sequence[HTF], line: dict, label: str) -> dict:
    """Exact HTFs broad and pale, without a label where an estimate of the same curve has one."""
    if htf.source != "exact":
        return {**line, "lw": 0.9, "zorder": 3, "label": label}
    if any(other.source != "exact" for other in htfs):
        label = ""
    return {**line, "ls": "-", "lw": 3.0, "alpha": 0.3, "zorder": 1, "label": label}


def _edges(middle, radius, floor: float = -np.inf) -> tuple[np.ndarray, np.ndarray]:
    """Return the lower edge of a band, no lower than a floor, and the upper one."""
    radius = np.where(np.isfinite(radius), radius, np.nan)
    return np.maximum(middle - radius, floor), middle + radius


def _fill(ax: Axes, f, low, high, color: str) -> None:
    ax.fill_between(f, low, high, color=color, alpha=0.25, lw=0, zorder=2)


def _phase(f, values, known, reference: tuple | None) -> np.ndarray:
    """Return the phase in degrees where it is known, NaN elsewhere; whole turns are chosen as in
    the reference, a pair of frequencies and phases."""
    phase = np.full(len(f), np.nan)
    angles = np.unwrap(np.angle(values[known]))
    phase[known] = np.degrees(angles)
    if reference is not None and known.any() and len(reference[0]):
        off = np.interp(f[known], *reference) - phase[known]
        turns = np.median(off) / 360
        phase += 360 * np.round(turns)
    return phase


def _legend(ax: Axes, htfs: Sequence[HTF], over_log: bool = False) -> None:
    if any(htf.source == "exact" for htf in htfs):
        ax.plot([], [], color="0.5", lw=3.0, alpha=0.3, label="exact")
    if over_log:
        ax.legend(loc="best")
    else:
        ax.legend(loc="upper right", ncols=2)
