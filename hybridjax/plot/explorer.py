"""`explore`: sliders for parameters; the limit cycle, its multipliers and its gain follow them.

`Explorer` has the last cycle that was found and continues it to other parameters (`_follow`, in
shorter steps where one fails). `_draw` moves the artists of one figure. In notebooks, the page
`_PAGE` (JavaScript) and Python exchange two messages, `asked` and `answer` (`widget`, `_answer`),
whose keys must be the same on both sides. In scripts, `show` opens sliders of matplotlib.

If a cycle is lost without need, look at `_follow`; if the picture is not that of the sliders, at
`number`, `waiting` and `moved` in `_PAGE`; if moving is slow, at `_draw` (the gain takes as long as
the cycle) and at what sets `_easel` to None, which draws the whole figure anew.
"""

import functools as ft
from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib import pyplot
from matplotlib.colors import to_rgba
from matplotlib.widgets import Slider

from .._core.arguments import package, require_among, searching
from .._core.boundary.checked import checked
from .._core.results import Result
from .._core.signal import ratio, with_unit
from ..errors import ComputationError, DefinitionError
from ..orbits.curve import away_from_events
from ..orbits.cycle import LimitCycle
from ..orbits.find import find_limit_cycle
from ..systems.system import HybridSystem, require_positive, unit_of_parameter
from ..systems.varied import parameter_of, with_parameters
from .film import PNG, Easel, png
from .frequency import FREQUENCY
from .look import COLORS, CYCLE, close_in_notebook, style
from .motion import portrait, widened
from .orbit import plane_of


# Input frequencies of the gain, in cycles per period. Fewer: resonances have corners. More: slow.
_FREQUENCIES = np.linspace(0.02, 1.98, 197)
# The background of a picture that is not that of the sliders.
_OLD = "0.88"
# Sliders, and the picture that comes from Python. While one is on its way, only the last place of
# the sliders is kept; once they rest, the gain is asked for. A picture of values that are not
# those of the sliders fades after a third of a second (sooner: pictures flicker while a slider
# moves), and a line below says so, until their own picture comes.
_PAGE = """
function render({ model, el }) {
  const values = { ...model.get("asked").values };
  let moved = false, waiting = false, number = 0;
  const ask = (gain) => {
    [moved, waiting] = [false, true];
    model.set("asked", { values: { ...values }, gain, number: ++number });
    model.save_changes();
  };
  const mark = () => {
    const shown = model.get("answer").values;
    const fits = Object.keys(values).every((name) => values[name] === shown[name]);
    picture.style.transition = fits ? "" : "opacity 0.1s 0.3s";
    picture.style.opacity = fits ? 1 : 0.25;
    state.textContent = fits ? "" : "searching for the cycle; the picture is that before";
  };
  const row = ([name, label, min, max]) => `<label style="display: block">
    <input type="range" name="${name}" min="${min}" max="${max}" step="${(max - min) / 100}"
    value="${values[name]}"> ${label} = <output>${values[name].toPrecision(4)}</output></label>`;
  el.innerHTML = model.get("answer").sliders.map(row).join("")
    + '<img style="max-width: 100%"><div style="min-height: 1.4em"></div>';
  const picture = el.querySelector("img"), state = el.querySelector("img + div");
  el.oninput = ({ target }) => {
    target.nextElementSibling.value = (+target.value).toPrecision(4);
    [values[target.name], moved] = [+target.value, true];
    mark();
    if (!waiting) ask(false);
  };
  const update = () => {
    const answer = model.get("answer");
    [picture.src, waiting] = [answer.picture, false];
    mark();
    if (moved || !answer.gain) ask(!moved);
  };
  model.on("change:answer", update);
  update();
}
export default { render };
"""


class Explorer:
    """Sliders that move parameters of a system. A notebook shows them (with the extra `explore`).

    **Fields:** `cycle`: the last limit cycle that was found; `message`: "", or where and why the
    cycle was lost, and at which values of the parameters it was found last; `figure`: orbit,
    multipliers and gain of `cycle`, below the message, on gray where the cycle was lost.
    """

    def __init__(self, cycle: LimitCycle, sliders: list, plane: tuple[str, str]):
        self.cycle = cycle
        self.message = ""
        self._sliders = sliders
        self._plane = plane
        self.values = {
            name: float(parameter_of(cycle.system, name)) for name, *_ in sliders
        }
        s = cycle.structure
        places = {"left": 0.07, "right": 0.99, "bottom": 0.14, "top": 0.84}
        with style():
            # (A layout that is computed for each picture takes longer than the cycle.)
            self.figure, self._axes = pyplot.subplots(1, 3, figsize=(9.0, 3.2))
            self.figure.subplots_adjust(**places, wspace=0.4)
            orbit, circle, gain = self._axes
            self._portrait = portrait(orbit, circle, s, plane)
            orbit.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=4)
            (self._gain,) = gain.semilogy([], [], color=CYCLE[0])
            pushed = s.inputs[0] if s.nu else ""
            label = with_unit(f"$|H_0|$, {plane[0]}", ratio(plane[0], pushed))
            gain.set(xlabel=FREQUENCY, ylabel=label)
            self._lost = self.figure.suptitle(
                "", fontsize=8, color=COLORS["red"], wrap=True
            )
        self._easel: Easel | None = None
        self._draw()
        close_in_notebook(self.figure)

    @checked
    def move(self, values: Mapping[str, float]) -> None:
        """Give parameters other values, and draw the cycle there.

        The cycle is continued from the last one, in shorter steps where one step fails. Where it is
        lost, `message` has the value and the reason; the last cycle stays, and a later move goes on
        from it.

        **Raises:** `DefinitionError` for a parameter without a slider.
        """
        require_among("slider", values, self.values)
        self._follow(values)
        self._draw()
        self.figure.canvas.draw_idle()

    def _follow(self, values: Mapping[str, float]) -> None:
        """Continue the cycle to these values, in shorter steps where one fails. If it is lost, keep
        the last one, and say so in `message`."""
        self.values |= {name: float(x) for name, x in values.items()}
        begin = {
            name: float(parameter_of(self.cycle.system, name)) for name in self.values
        }
        share = 0.0
        step = 1.0
        self.message = ""
        while share < 1:
            at = min(share + step, 1.0)
            mixed = {}
            for n, x in begin.items():
                mixed[n] = (1 - at) * x + at * self.values[n]
            system = with_parameters(self.cycle.system, mixed)
            cycle = find_limit_cycle(system, away_from_events(self.cycle), throw=False)
            if cycle.result == Result.OK:
                self.cycle = cycle
                share = at
            elif step > 1 / 16:
                step /= 4
            else:
                found = {
                    name: float(parameter_of(self.cycle.system, name)) for name in mixed
                }
                self.message = (
                    f"The cycle is lost at {_written(mixed)}: "
                    f"{Result(int(cycle.result)).message}. The picture is that at "
                    f"{_written(found)}."
                )
                break

    def _draw(self, gain: bool = True) -> None:
        """Draw the cycle, and the gain, which takes as long to compute."""
        cycle = self.cycle
        s = self.cycle.structure
        if gain and s.nu:
            f = _FREQUENCIES[(_FREQUENCIES % 1 > 0.01) | cycle.clocked]
            htf = cycle.htf(f, outputs=self._plane[0], inputs=s.inputs[0])
            modulus = np.abs(htf[0][:, 0, 0])
            self._gain.set_data(f, modulus)
        self._gain.set_alpha(1.0 if gain else 0.3)
        self._lost.set_text(self.message)
        self._shade(bool(self.message))
        self._moving = [*self._portrait(cycle), self._gain, self._lost]
        if any([widened(ax) for ax in self._axes]):
            self._easel = None

    def _shade(self, is_old: bool) -> None:
        """Make the background gray where the picture is not that of the sliders."""
        color = _OLD if is_old else "white"
        if self._axes[0].get_facecolor() == to_rgba(color):
            return
        for ax in self._axes:
            ax.set_facecolor(color)
        self._easel = None

    def _slide(self, name: str, value: float) -> None:
        """Follow a slider of the window: the picture is marked until the search ends."""
        self._lost.set_text(f"Searching for the cycle at {name} = {value:.4g}.")
        self._shade(True)
        self.figure.canvas.draw()
        self.figure.canvas.flush_events()
        self.move({name: value})

    def __repr__(self) -> str:
        title = f"Explorer({_written(self.values)})"
        lines = [title, self.message, repr(self.cycle)]
        return "\n".join(filter(None, lines))

    def show(self) -> None:
        """Open a window with the sliders (in scripts)."""
        window = pyplot.figure(figsize=(5, 0.5 * len(self._sliders) + 0.3))
        self._widgets = []  # (a slider that nobody holds does not move)
        for k, (name, label, low, high) in enumerate(self._sliders, 1):
            bottom = 1 - k / (len(self._sliders) + 1)
            ax = window.add_axes((0.25, bottom, 0.55, 0.05))
            self._widgets.append(
                Slider(ax, label, low, high, valinit=self.values[name])
            )
            self._widgets[-1].on_changed(ft.partial(self._slide, name))
        pyplot.show()

    def widget(self) -> Any:
        """Return the widget, for notebooks that wrap widgets themselves (`marimo.ui.anywidget`).

        **Raises:** `DefinitionError` where anywidget is not installed.
        """
        anywidget: Any = package("anywidget")
        traitlets = package("traitlets")
        explorer = self

        class Sliders(anywidget.AnyWidget):
            _esm = _PAGE
            asked = traitlets.Dict().tag(sync=True)
            answer = traitlets.Dict().tag(sync=True)

            @traitlets.observe("asked")
            def _moved(self, change) -> None:
                self.answer = explorer._answer(**change["new"])

        return Sliders(asked={"values": self.values, "gain": True, "number": 0})

    def _answer(
        self,
        values: Mapping[str, float],
        gain: bool,
        number: int,
    ) -> dict[str, Any]:
        """Return the answer to a message of the page: the picture of the cycle at these values.

        **Arguments:** `gain`: whether the gain is computed, too. `number`: number of the message,
        which makes each answer another one.
        """
        if values != self.values:
            self._follow(values)
        self._draw(gain)
        self._easel = self._easel or Easel(self.figure, self._moving, 110)
        picture = png(self._easel.image(self._moving), compress_level=1)
        return {
            "picture": picture,
            "values": dict(values),
            "gain": gain,
            "number": number,
            "sliders": self._sliders,
        }

    def _repr_mimebundle_(self, **options: Any) -> Any:
        try:
            self._widget = self.widget()
        except DefinitionError as error:
            return {"text/plain": f"Explorer without sliders: {error}"}
        data, about = self._widget._repr_mimebundle_(**options)
        still = self._widget.answer["picture"].removeprefix(PNG)  # where no kernel runs
        return {**data, "text/plain": "Explorer", "image/png": still}, about


def _written(values: Mapping[str, float]) -> str:
    return ", ".join(f"{name} = {x:.4g}" for name, x in values.items())


@checked
def explore(
    system: HybridSystem | LimitCycle,
    *parameters: str,
    ranges: Mapping[str, tuple[float, float]] | None = None,
    x: str | None = None,
    y: str | None = None,
) -> Explorer:
    """Explore a system by sliders: the orbit, the multipliers and $|H_0|$ follow its parameters.

    Each move continues the limit cycle from the last one. In notebooks (Jupyter, and marimo by
    `marimo.ui.anywidget(explorer.widget())`) it needs the extra `explore`; in scripts, `show()`
    opens a window of matplotlib.

    **Arguments:**

    - `system`: a system with a default guess, or one of its limit cycles.
    - `parameters`: names of the parameters that get sliders.
    - `ranges`: least and largest value by name. Default: half and 1.5 times the present value.
    - `x`, `y`: names of the states or outputs that are drawn. Default: the first two states.

    **Returns:** `hj.plot.Explorer` with the present `cycle`, a `message` if the cycle was lost, and
    the `figure`. Parameters are in their units.

    **Raises:** `DefinitionError` for a parameter that does not exist, a range without its present
    value, and in the cases of `find_limit_cycle`; `ComputationError` if there is no cycle to begin
    with.

    **Example:**

    ```python
    explorer = hj.explore(hopper, "k", ranges={"k": (8.0, 12.0)})
    print(explorer.cycle.multipliers)
    ```

    **Before:** `hj.HybridSystem`, or `hj.find_limit_cycle`. **After:** `hj.continuation`,
    `hj.sweep`.
    """
    with searching("as `system`", (ComputationError, DefinitionError)):
        cycle = system if isinstance(system, LimitCycle) else find_limit_cycle(system)
    cycle.require_found()
    sliders = []
    ranges = ranges or {}
    for name in dict.fromkeys((*parameters, *ranges)):
        value = float(parameter_of(cycle.system, name))
        usual = sorted((0.5 * value, 1.5 * value))
        low, high = map(float, ranges.get(name, usual))
        if not low <= value <= high or low == high:
            raise DefinitionError(
                f"`ranges` of '{name}' must enclose its value, {value:.6g}."
            )
        for end in (low, high):
            require_positive(with_parameters(cycle.system, {name: end}))
        sliders.append(
            [name, with_unit(name, unit_of_parameter(cycle.system, name)), low, high]
        )
    if not sliders:
        raise DefinitionError("explore: name one parameter or more, such as 'k'.")
    return Explorer(cycle, sliders, plane_of(cycle.structure, x, y))
