"""Flows of models with events from the SBML Test Suite, against its expected curves.

    python benchmarks/sbml.py FOLDER                 all cases with events
    python benchmarks/sbml.py FOLDER --cases 00026 00041
    python benchmarks/sbml.py FOLDER --gradients 20  and gradients of 20 of the right ones

FOLDER has one folder for each case (`00026` with `00026-sbml-l3v1.xml`, `-model.m`, `-settings.txt`
and `-results.csv`): it is `cases/semantic` of https://github.com/sbmlteam/sbml-test-suite (LGPL
2.1), from which nothing is kept here:

    S. M. Keating, L. P. Smith, B. Shapiro, M. Hucka, F. T. Bergmann, B. Olivier and A. Finney,
    The SBML Test Suite, semantic test cases, https://sbml.org/software/sbml-test-suite.

Prints for each case whether it is right (all numbers within the tolerances of the case), refused
by a code or an error of the package, wrong, or skipped, because the reader in `sbml_models.py`
cannot express it. With `--gradients`, derivatives of the sum of the final states by all numbers of
a model (initial values, sizes, parameters, thresholds of events), in forward and reverse mode, are
compared with central differences.
"""

import argparse
import collections
import csv
import re
import warnings
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import sbml_models
from sbml_models import Event, Model, Point, Skip

import hybridjax as hj


EVENTS = {"EventNoDelay", "EventWithDelay", "EventPriority"}
# Events of a flow of which times are kept.
_MOST_EVENTS = 64
# Steps of the differences, as a part of each number (or of 1).
_STEP = 1e-4
# Derivatives are right within this error, relative to the largest one and to 1.
_DERIVATIVE = 1e-6


class Field(hj.Chart):
    """The rates of a model's states."""

    system: "System"
    states: tuple[str, ...] = eqx.field(static=True)

    def field(self, t, q, u):
        point = self.system.at(t, q)
        return [0.0 * t + point.rate(x) for x in self.states]


class Trigger(eqx.Module):
    """One inequality of an event's trigger: the event happens where it begins to hold, if the
    trigger then depends on it."""

    system: "System"
    event: Event = eqx.field(static=True)
    k: int = eqx.field(static=True)

    def guard(self, t, q, u):
        inequality = sbml_models.inequalities(self.event.trigger)[self.k]
        return self.system.at(t, q).threshold(inequality)

    def reset(self, t, q, u):
        return self.system.at(t, q).after(self.event)

    def enabled(self, t, q, u):
        point = self.system.at(t, q)
        trigger = self.event.trigger
        known = [point.holds(x) for x in sbml_models.inequalities(trigger)]

        def with_own(value):
            return sbml_models.holds(
                trigger, iter([*known[: self.k], value, *known[self.k + 1 :]])
            )

        return jnp.logical_and(with_own(True), jnp.logical_not(with_own(False)))


class System(hj.HybridSystem):
    """A model as a system of one chart."""

    inputs = ()
    numbers: dict[str, jax.Array]
    model: "Model" = eqx.field(static=True)

    def at(self, t, q):
        return Point(self.model, self.numbers, t, q)

    def charts(self):
        return {"main": Field(system=self, states=self.model.states)}

    def transitions(self):
        return [x for event in self.model.events for x in self._of(event)]

    def _of(self, event):
        """The transitions of an event, one for each inequality that can change."""
        orders = sbml_models.inequalities(event.trigger)
        for k in range(len(orders)):
            trigger = Trigger(self, event, k)
            enabled = None if len(orders) == 1 else trigger.enabled
            name = event.name if len(orders) == 1 else f"{event.name}, {k}"
            yield hj.Transition(
                name,
                "main",
                "main",
                trigger.guard,
                reset=trigger.reset,
                enabled=enabled,
            )


# Cases.


def tags_of(folder: Path) -> set[str]:
    text = (folder / f"{folder.name}-model.m").read_text(errors="replace")
    lines = re.findall(r"^(?:component|test)Tags:(.*)$", text, re.M)
    return {x.strip() for line in lines for x in line.split(",")}


def curves(model: Model, settings: sbml_models.Settings, numbers, times, states):
    """The variables of a case (K, variables) at some times."""

    def at(t, q):
        point = Point(model, numbers, t, q)

        def variable(name):
            if name in settings.amount:
                return point.amount(name)
            if name in settings.concentration:
                return point.concentration(name)
            return point.symbol(name)

        found = [jnp.asarray(variable(x), float) for x in settings.variables]
        return jnp.stack(found)

    return np.asarray(jax.vmap(at)(times, states))


def expected(folder: Path, settings: sbml_models.Settings) -> tuple:
    """Times and the curves of a case, from its file."""
    with open(folder / f"{folder.name}-results.csv", newline="") as file:
        head, *rows = [row for row in csv.reader(file) if row]
    names = [x.strip() for x in head]
    table = np.array([[float(x) for x in row] for row in rows])
    return table[:, 0], table[:, [names.index(x) for x in settings.variables]]


class Case:
    """A case, its model and what is expected of it.

    **Raises:** `Skip` if the reader cannot express it.
    """

    def __init__(self, folder: Path):
        path = folder / f"{folder.name}-sbml-l3v1.xml"
        if not path.exists():
            raise Skip("no file of Level 3 Version 1")
        self.model = sbml_models.read(path)
        self.settings = sbml_models.read_settings(
            folder / f"{folder.name}-settings.txt"
        )
        self.times, self.curves = expected(folder, self.settings)
        self.first = sbml_models.events_at_start(self.model)
        self.numbers = {x: jnp.asarray(y) for x, y in self.model.numbers.items()}

    def flow(self, numbers, **options) -> hj.orbits.Flow:
        """The flow of the model with other numbers."""
        state = sbml_models.start(self.model, numbers, self.first)
        guess = hj.Guess("main", state)
        system = System(numbers, self.model)
        return hj.flow(system, guess, float(self.times[-1]), **options)

    def verdict(self) -> tuple[str, str]:
        """Whether the flow is right, refused or wrong, and in what."""
        try:
            found = self.flow(self.numbers, throw=False, max_events=_MOST_EVENTS)
        except hj.errors.HybridJaxError as problem:
            return "refused", f"{type(problem).__name__}: {problem}"
        if found.result != 0:
            return "refused", hj.errors.Result(int(found.result)).name
        _, states = found.require_trajectory().at(self.times)
        own = curves(self.model, self.settings, self.numbers, self.times, states)
        doubts = "".join(f" [{x.cause}]" for x in found.findings)
        about = f"{int(found.count)} events{doubts}"
        limit = self.settings.absolute + self.settings.relative * np.abs(self.curves)
        same = (own == self.curves) | (np.isnan(own) & np.isnan(self.curves))
        bad = ~(same | (np.abs(own - self.curves) <= limit))
        if not bad.any():
            return "right", about
        k, j = np.argwhere(bad)[0]
        name = self.settings.variables[j]
        return "wrong", (
            f"{about}, first {name} at {self.times[k]:g}: {own[k, j]:.9g}, expected "
            f"{self.curves[k, j]:.9g}"
        )

    def gradients(self) -> tuple[str, str]:
        """Whether derivatives of the sum of the final states by all numbers are right."""
        state = float(jnp.sum(self.flow(self.numbers, throw=False).state))

        def total(numbers):
            found = self.flow(numbers, throw=False)
            return jnp.sum(found.state), found.result

        @jax.jit
        def derivatives(numbers):
            forward, _ = jax.jacfwd(total, has_aux=True)(numbers)
            (value, result), reverse = jax.value_and_grad(total, has_aux=True)(numbers)
            return value, result, forward, reverse

        value, result, forward, reverse = derivatives(self.numbers)
        if result != 0:
            return "refused", hj.errors.Result(int(result)).name
        names = list(self.numbers)
        by_differences = differences(total, self.numbers)
        size = 1 + np.abs(by_differences).max()

        def error(found):
            own = np.array([found[x] for x in names])
            return float(np.max(np.abs(own - by_differences)) / size)

        errors = error(forward), error(reverse)
        apart = abs(float(value) - state) / (1 + abs(state))
        is_right = max(errors) < _DERIVATIVE and apart < 1e-9
        return "right" if is_right else "wrong", (
            f"{len(names)} numbers, forward {errors[0]:.1e}, reverse {errors[1]:.1e}, value inside "
            f"of jit {apart:.1e}"
        )


def differences(function, numbers: dict[str, jax.Array]) -> np.ndarray:
    """Derivatives of a function of numbers by central differences of fourth order."""
    names = list(numbers)
    given = np.array([float(numbers[x]) for x in names])
    step = _STEP * np.where(given == 0, 1.0, np.abs(given))

    @jax.jit
    @jax.vmap
    def values(row):
        return function(dict(zip(names, row, strict=True)))[0]

    def slope(h):
        rows = np.concatenate([given + np.diag(h), given - np.diag(h)])
        up, down = np.split(np.asarray(values(rows)), 2)
        return (up - down) / (2 * h)

    return (4 * slope(step / 2) - slope(step)) / 3


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path)
    parser.add_argument("--cases", nargs="*", help="names; default: all")
    parser.add_argument("--gradients", type=int, default=0, help="of so many cases")
    options = parser.parse_args()
    hj.enable_x64()
    warnings.simplefilter("ignore")
    folders = [x for x in sorted(options.folder.iterdir()) if x.is_dir()]
    if options.cases:
        folders = [x for x in folders if x.name in options.cases]
    counts: collections.Counter = collections.Counter()
    reasons: collections.Counter = collections.Counter()
    right = []
    for folder in folders:
        if not tags_of(folder) & EVENTS:
            continue
        try:
            case = Case(folder)
        except Skip as why:
            counts["skipped"] += 1
            reasons[str(why)] += 1
            continue
        what, about = case.verdict()
        counts[what] += 1
        print(f"sbml.{folder.name} {what}: {about}", flush=True)
        if what == "right":
            right.append((folder.name, case))
            # (In the others, the only event is at the start, where the reader carries it out, or
            # never happens.)
            counts["right with events"] += not about.startswith("0 events")
    for what in ("right", "right with events", "refused", "wrong", "skipped"):
        print(f"sbml.{what.replace(' ', '_')} {counts[what]}")
    for why, count in reasons.most_common():
        print(f"sbml.skipped.{why.replace(' ', '_')} {count}")
    gradients: collections.Counter = collections.Counter()
    chosen = np.linspace(0, len(right) - 1, min(options.gradients, len(right)))
    for k in chosen.round().astype(int):
        name, case = right[k]
        what, about = case.gradients()
        gradients[what] += 1
        print(f"sbml.gradients.{name} {what}: {about}", flush=True)
    for what, count in gradients.items():
        print(f"sbml.gradients.{what} {count}")


if __name__ == "__main__":
    main()
