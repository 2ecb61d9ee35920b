"""The models as systems of hybridjax, and its answers as plain numbers."""

import dataclasses
import traceback

import jax.numpy as jnp
import numpy as np
from check import Occurrence, Orbit
from form import Event, Model, Start

import hybridjax as hj


hj.enable_x64()


def flow(names: tuple, rule) -> type:
    """A chart whose field is a rule of the model; `system` holds the parameters."""

    class Flow(hj.Chart):
        states = names
        system: hj.HybridSystem

        def field(self, t, q, u):
            return rule(jnp, t, q, self.system)

    return Flow


def bound(rule, system):
    return lambda t, q, u: rule(jnp, t, q, system)


def transition(event: Event, system) -> hj.Transition:
    more = {}
    if event.reset is not None:
        more["reset"] = bound(event.reset, system)
    if event.enabled is not None:
        more["enabled"] = bound(event.enabled, system)
    if event.schedule is not None:
        trigger = hj.systems.Scheduled(*event.schedule(system))
    else:
        trigger = bound(event.guard, system)
        more["direction"] = event.direction
    return hj.Transition(event.name, event.source, event.target, trigger, **more)


def build(model: Model) -> hj.HybridSystem:
    flows = {name: flow(states, rule) for name, (states, rule) in model.charts.items()}

    def charts(self):
        return {name: kind(self) for name, kind in flows.items()}

    def transitions(self):
        return [transition(event, self) for event in model.events]

    def period(self):
        return model.clock(self)

    body = {
        "__annotations__": dict.fromkeys(model.parameters, hj.Parameter),
        "__module__": __name__,
        "charts": charts,
        "transitions": transitions,
        **{name: hj.parameter(value) for name, value in model.parameters.items()},
    }
    if model.clock is not None:
        body["period"] = period
    return type("Outsider", (hj.HybridSystem,), body)()


@dataclasses.dataclass
class Answer:
    """An orbit, or a refusal's or a crash's text."""

    orbit: Orbit | None
    text: str
    crash: bool = False


SYSTEMS: dict = {}


def answer(model: Model, guess: Start) -> Answer:
    if model.name not in SYSTEMS:
        SYSTEMS.clear()  # one compiled system at a time
        SYSTEMS[model.name] = build(model)
    system = SYSTEMS[model.name]
    search = dict(model.search)
    if model.section is not None:
        search["section"] = hj.AtEvent(model.section)
    try:
        start = hj.Guess(guess.chart, guess.state, guess.time)
        cycle = hj.find_limit_cycle(system, start, **search)
        return Answer(orbit_of(cycle, model), str(cycle))
    except hj.errors.HybridJaxError as error:
        return Answer(None, f"{type(error).__name__}: {error}")
    except (
        Exception
    ) as error:  # a crash is a result of the campaign, not of this program
        place = traceback.extract_tb(error.__traceback__)[-1]
        text = f"{type(error).__name__}: {error} ({place.name}, line {place.lineno})"
        return Answer(None, text, crash=True)


def orbit_of(cycle, model: Model) -> Orbit:
    path = cycle.trajectory()
    names = list(path.system.charts())
    charts = [names[k] for k in np.asarray(path.chart)]
    sizes = {name: len(states) for name, (states, _) in model.charts.items()}
    states = [
        np.array(row[: sizes[chart]], dtype=float)
        for row, chart in zip(np.asarray(path.after), charts, strict=True)
    ]
    return Orbit(
        period=float(cycle.period),
        time=np.asarray(path.t, dtype=float),
        chart=charts,
        state=states,
        is_event=np.asarray(path.event) >= 0,
        events=[Occurrence(float(e.time), e.name) for e in path.events],
        multipliers=np.asarray(cycle.multipliers),
        multiplicity=int(cycle.multiplicity),
    )
