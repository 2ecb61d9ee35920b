"""Sliders for parameters: the limit cycle, its multipliers and its gain follow them."""

import base64
import functools
import io
from collections.abc import Mapping
from typing import Annotated, Any

import numpy as np
from matplotlib import pyplot
from matplotlib.widgets import Slider

from .._core.arguments import Numbers, package
from .._core.boundary.checked import checked
from .._core.boundary.values import Reals
from .._core.results import Result
from .._core.signal import Signal, with_unit
from ..errors import DefinitionError
from ..orbits.cycle import LimitCycle
from ..orbits.find import find_limit_cycle
from ..systems.system import HybridSystem, unit_of_parameter
from ..systems.varied import parameter_of, with_parameters
from .look import COLORS, style
from .orbit import cycle as draw_cycle, plane_of
from .plane import multipliers as draw_multipliers


Ranges = Mapping[str, Annotated[Numbers, Reals("2")]]
# Input frequencies of the gain, in cycles per period. Fewer: resonances have corners. More: slow.
_FREQUENCIES = np.linspace(0.02, 1.98, 50)
# A slider, and what happens where it is moved; the picture comes from Python.
_PAGE = """
function render({ model, el }) {
  const note = document.createElement("div"), picture = document.createElement("img");
  for (const [name, label, low, high] of model.get("sliders")) {
    const row = document.createElement("label"), text = document.createElement("span");
    const about = { type: "range", min: low, max: high, step: (high - low) / 100 };
    const slider = Object.assign(document.createElement("input"), about);
    const show = () => { text.textContent = ` ${label} = ${(+slider.value).toPrecision(4)}`; };
    slider.value = model.get("values")[name];
    slider.oninput = () => {
      show();
      model.set("values", { ...model.get("values"), [name]: +slider.value });
      model.save_changes();
    };
    row.style.display = "block";
    row.append(slider, text);
    el.append(row);
    show();
  }
  const update = () => {
    picture.src = model.get("picture");
    note.textContent = model.get("message");
  };
  picture.style.maxWidth = "100%";
  model.on("change:picture", update);
  update();
  el.append(note, picture);
}
export default { render };
"""


class Explorer:
    """Sliders that move parameters of a system. A notebook shows them (with the extra `explore`).

    **Fields:** `cycle`: the last limit cycle that was found; `message`: "", or where and why the
    cycle was lost; `figure`: orbit, multipliers and gain.
    """

    def __init__(self, cycle: LimitCycle, ranges: dict[str, np.ndarray], plane: tuple[str, str]):
        self.cycle, self.message, self.ranges, self._plane = cycle, "", ranges, plane
        self.values = {name: float(parameter_of(cycle.system, name)) for name in ranges}
        with style():
            # (A layout that is computed for each picture takes longer than the cycle.)
            places: Any = {"left": 0.07, "right": 0.99, "bottom": 0.14, "top": 0.86, "wspace": 0.3}
            self.figure, self._axes = pyplot.subplots(1, 3, figsize=(9.0, 3.2), gridspec_kw=places)
        self._draw()

    @checked
    def move(self, values: Mapping[str, float]) -> None:
        """Give parameters other values, and draw the cycle there.

        The cycle is continued from the last one, in shorter steps where one step fails. Where it is
        lost, `message` has the value and the reason; the last cycle stays, and a later move goes on
        from it.

        **Raises:** `DefinitionError` for a parameter without a slider.
        """
        for name in values:
            if name not in self.ranges:
                raise DefinitionError(f"'{name}' has no slider; {', '.join(self.ranges)} have one.")
        self.values |= {name: float(x) for name, x in values.items()}
        begin = {name: float(parameter_of(self.cycle.system, name)) for name in self.values}
        share, step, self.message = 0.0, 1.0, ""
        while share < 1:
            at = min(share + step, 1.0)
            mixed = {n: (1 - at) * x + at * self.values[n] for n, x in begin.items()}
            system = with_parameters(self.cycle.system, mixed)
            cycle = find_limit_cycle(system, self.cycle, throw=False)
            if cycle.result == Result.OK:
                self.cycle, share = cycle, at
            elif step > 1 / 16:
                step /= 4
            else:
                shown = ", ".join(f"{n} = {x:.4g}" for n, x in mixed.items())
                self.message = f"The cycle is lost at {shown}: {Result(int(cycle.result)).message}."
                break
        self._draw()

    def _draw(self) -> None:
        orbit, circle, gain = self._axes
        for panel in self._axes:
            panel.clear()
        cycle, structure = self.cycle, self.cycle.structure
        draw_cycle(cycle, *self._plane, ax=orbit)
        if len(cycle.multipliers):
            draw_multipliers(cycle, zoom=False, ax=circle)
        if structure.nu:
            f = _FREQUENCIES[(_FREQUENCIES % 1 > 0.01) | cycle.clocked]
            htf = cycle.htf(f, outputs=self._plane[0], inputs=structure.inputs[0])
            gain.semilogy(f, np.abs(htf[0][:, 0, 0]))
            pushed = f"{structure.inputs[0]} to {self._plane[0]}"
            gain.set(xlabel="input frequency (cycles/period)", ylabel=f"$|H_0|$, {pushed}")
        color = COLORS["red"] if self.message else "black"
        self.figure.suptitle(
            "the last cycle that was found" if self.message else "", fontsize=8, color=color
        )

    def show(self) -> None:
        """Open a window with the sliders (in scripts)."""
        window = pyplot.figure(figsize=(5, 0.5 * len(self.ranges) + 0.3))
        self._sliders = []
        for k, (name, (low, high)) in enumerate(self.ranges.items()):
            ax = window.add_axes((0.25, 1 - (k + 1) / (len(self.ranges) + 1), 0.55, 0.05))
            slider = Slider(ax, _label(self.cycle, name), low, high, valinit=self.values[name])
            slider.on_changed(functools.partial(self._slid, name))
            self._sliders.append(slider)
        pyplot.show()

    def _slid(self, name: str, value: float) -> None:
        self.move({name: value})
        if self.message:
            print(self.message)
        self.figure.canvas.draw_idle()

    def widget(self) -> Any:
        """Return the widget, for notebooks that wrap widgets themselves (`marimo.ui.anywidget`).

        **Raises:** `DefinitionError` where anywidget is not installed.
        """
        anywidget: Any = package("anywidget")
        traitlets = package("traitlets")
        sliders = [
            [name, _label(self.cycle, name), *map(float, limits)]
            for name, limits in self.ranges.items()
        ]
        explorer = self

        class Sliders(anywidget.AnyWidget):
            _esm = _PAGE
            sliders = traitlets.List().tag(sync=True)
            values = traitlets.Dict().tag(sync=True)
            message = traitlets.Unicode().tag(sync=True)
            picture = traitlets.Unicode().tag(sync=True)

            @traitlets.observe("values")
            def _moved(self, change) -> None:
                explorer.move(change["new"])
                self.message, self.picture = explorer.message, explorer._picture()

        return Sliders(sliders=sliders, values=self.values)

    def _picture(self) -> str:
        image = io.BytesIO()
        self.figure.savefig(image, format="png", dpi=110)
        return f"data:image/png;base64,{base64.b64encode(image.getvalue()).decode()}"

    def _repr_mimebundle_(self, **options: Any) -> Any:
        pyplot.close(self.figure)  # the widget shows it
        try:
            self._widget = self.widget()
        except DefinitionError as error:
            return {"text/plain": f"Explorer without sliders: {error}"}
        return self._widget._repr_mimebundle_(**options)


@checked
def explore(
    system: HybridSystem | LimitCycle,
    *parameters: str,
    ranges: Ranges | None = None,
    x: str | None = None,
    y: str | None = None,
) -> Explorer:
    """Explore a system by sliders: the orbit, the multipliers and $|H_0|$ follow its parameters.

    Each move continues the limit cycle from the last one. In notebooks (Jupyter, and marimo by
    `marimo.ui.anywidget(explorer.widget())`) it needs the extra `explore`; in scripts, `show()`
    opens a window of matplotlib.

    **Arguments:**

    - `system`: with a default guess, or a limit cycle of it. `parameters`: names.
    - `ranges`: least and largest value by name. Default: half and 1.5 times the present value.
    - `x`, `y`: names of the states or outputs that are drawn. Default: the first two states.

    **Raises:** `DefinitionError` for a parameter that does not exist, a range without its present
    value, and as `find_limit_cycle`; `ComputationError` if there is no cycle to begin with.
    """
    cycle = system if isinstance(system, LimitCycle) else find_limit_cycle(system)
    if cycle.result != Result.OK:
        raise DefinitionError("`system` is a cycle that was not found: explore another one.")
    limits = {}
    for name in dict.fromkeys((*parameters, *(ranges or {}))):
        value = float(parameter_of(cycle.system, name))
        given = (ranges or {}).get(name, sorted((0.5 * value, 1.5 * value)))
        low, high = limits[name] = np.asarray(given, float)
        if not low <= value <= high or low == high:
            raise DefinitionError(
                f"`ranges` of '{name}' must be two numbers around its present value {value:.6g}."
            )
    if not limits:
        raise DefinitionError("explore: name one parameter or more, such as 'k'.")
    return Explorer(cycle, limits, plane_of(cycle.structure, x, y))


def _label(cycle: LimitCycle, name: str) -> str:
    return with_unit(name, Signal(name, unit_of_parameter(cycle.system, name)).unit)
