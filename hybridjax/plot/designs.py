"""Figures of designs for a quantity of interest: spectra (`spectrum`), and standard errors against
cycles (`standard_errors`).

Colors, sizes and limits of axes may be chosen otherwise. It must stay that both functions take `ax`
and get their panels from `look.panels`, so that they fit into Axes of users.

Powers and errors are those of an `OptimalDesign` or a study: if one is wrong, look at
`designs/optimize.py` or `designs/study.py`. Two things are computed here: the amplitudes in
`spectrum`, from the powers of all lines of one frequency, and the lines of `standard_errors`, which
fall with the root of the number of cycles.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

from .._core.boundary.checked import checked
from .._core.signal import unit_of, with_unit
from ..designs.candidates import Model
from ..designs.optimize import OptimalDesign
from ..designs.study import SequentialDesign
from ..errors import DefinitionError
from .frequency import FREQUENCY
from .look import COLORS, COLUMN, CYCLE, AxesLike, Plot, panels


@checked
def spectrum(plan: OptimalDesign, model: Model, *, ax: AxesLike | None = None) -> Plot:
    """Draw the spectrum of an optimal design and of the design that it improves.

    The upper panel shows |H_0| of all outputs, each relative to its largest value. The lower panel
    shows the amplitude of each excited frequency: the rms over all experiments and inputs, although
    most experiments leave this frequency out. Other frequencies are not drawn.

    **Arguments:**

    - `plan`: result of `hj.optimal_design`.
    - `model`: the model that the plan was made for.
    - `ax`: two Axes. Default: a new figure.

    **Returns:** `hj.plot.Plot` with `axes` (2, 1). Frequencies are in cycles per period, amplitudes
    in the unit of the first input, over three decades.

    **Raises:** `DefinitionError` for a model of other signals or sections, or if `ax` does not hold
    two Axes.

    **Example:**

    ```python
    plan = hj.optimal_design(model, design)
    hj.plot.spectrum(plan, model)
    ```

    **Before:** `hj.optimal_design`. **After:** `hj.run_experiments`.
    """
    signals = {*model.inputs, *model.outputs}
    if model.n_sections != plan.design.n_sections or not signals <= set(plan.rms):
        raise DefinitionError(
            "`model` is not the one that the plan was made for: other signals."
        )
    with panels(ax, 2, 1, width=COLUMN, height=3.2, sharex=True) as axes:
        above, below = axes[:, 0]
        f = np.unique(plan.frequencies)
        response = np.asarray(model.htf(f, 0).H)[0]
        H = np.abs(response)
        for k, name in enumerate(model.outputs):
            for i, _ in enumerate(model.inputs):
                modulus = H[:, k, i]
                size = modulus / modulus.max()
                above.plot(f, size, color=CYCLE[k % len(CYCLE)], label=name)
        above.set(yscale="log", ylabel="$|H_0|$ / largest")
        above.legend()
        for power, color, label in (
            (plan.usual_power, COLORS["gray"], plan.usual_name),
            (plan.power, COLORS["red"], "optimal"),
        ):
            amplitude = np.sqrt(
                2 * np.array([power[plan.frequencies == x].sum() for x in f])
            )
            used = amplitude > 0
            style = dict(marker="o", ms=2, lw=0, color=color, label=label)
            below.plot(f[used], amplitude[used], **style)
        label = with_unit("amplitude, rms\nover experiments", unit_of(model.inputs[0]))
        largest = max(plan.power.max(), plan.usual_power.max())
        top = np.sqrt(2 * largest)
        limits = dict(xlim=(0, f.max()), ylim=(1e-3 * top, 2 * top))
        below.set(yscale="log", xlabel=FREQUENCY, ylabel=label, **limits)
        below.legend()
    return Plot(axes)


@checked
def standard_errors(
    plan: OptimalDesign,
    studies: Mapping[str, SequentialDesign | Sequence[SequentialDesign]] | None = None,
    *,
    ax: AxesLike | None = None,
) -> Plot:
    """Draw the standard error against the number of cycles, on logarithmic axes.

    Lines are Cramer-Rao bounds for the optimal design and for the design that it
    improves. Points are standard errors of sequential designs after each block of
    experiments. The first block has the original design, before it is improved. For
    several quantities, the root of the sum of squares is drawn.

    **Arguments:**

    - `plan`: result of `hj.optimal_design`.
    - `studies`: by label, one `hj.designs.SequentialDesign` or several. Default: None.
    - `ax`: one Axes. Default: a new figure.

    **Returns:** `hj.plot.Plot` with `axes` (1, 1). Standard errors are in the unit of the quantity
    of interest; multipliers have none.

    **Raises:** `DefinitionError` for a study without a block, or if `ax` is not one Axes.

    **Example:**

    ```python
    plan = hj.optimal_design(model, design)
    hj.plot.standard_errors(plan)
    ```

    **Before:** `hj.optimal_design`. **After:** `hj.designs.SequentialDesign`.
    """
    with panels(ax, height=2.4) as axes:
        panel = axes[0, 0]
        reached: list[float] = [plan.cycles]
        for k, (label, given) in enumerate((studies or {}).items()):
            several = [given] if isinstance(given, SequentialDesign) else list(given)
            color = CYCLE[k % len(CYCLE)]
            for number, study in enumerate(several):
                if not study.blocks:
                    raise DefinitionError(
                        "a study without a block has no errors: `add` data."
                    )
                error = np.linalg.norm(study.standard_errors, axis=1)
                style = dict(
                    label=label if number == 0 else None, color=color, zorder=2
                )
                panel.plot(study.cycles, error, marker="o", ms=3, lw=0.6, **style)
                reached += study.cycles.tolist()
        around = 1.5 if studies else 10.0
        low = min(reached) / around
        high = max(reached) * around
        for errors, needed, color, label in (
            (
                plan.usual_standard_errors,
                plan.usual.cycles(0),
                COLORS["gray"],
                plan.usual_name,
            ),
            (
                plan.standard_errors,
                plan.cycles,
                COLORS["black"],
                "optimal, model known",
            ),
        ):
            n = np.array([low, high])
            size = np.linalg.norm(errors) * np.sqrt(needed / n)
            panel.plot(n, size, color=color, lw=1.2, label=label, zorder=1)
        panel.set(xscale="log", yscale="log", xlabel="cycles", ylabel="standard error")
        panel.set_xlim(low, high)
        for axis, text in ((panel.xaxis, "{x:.0f}"), (panel.yaxis, "{x:.0e}")):
            axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
            axis.set_major_formatter(StrMethodFormatter(text))
            axis.set_minor_formatter(NullFormatter())
        panel.legend()
    return Plot(axes)
