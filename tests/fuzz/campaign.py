"""Random hybrid systems, hybridjax against scipy: `python -m tests.fuzz.campaign`."""

import argparse
import dataclasses
import sys

import jax
import jax.numpy as jnp
import numpy as np

import hybridjax as hj
from hybridjax._core.compilation import quick_jit
from hybridjax.engine.lanes import start_lanes
from hybridjax.engine.move import Options, move
from hybridjax.engine.settings import Settings
from hybridjax.engine.target import until
from hybridjax.systems.structure import Structure

from . import scipy_loop
from .drawing import STRUCTURES, draw
from .scipy_loop import Event, Run
from .structures import Plan, Random, Sample


EVENTS = 6
# Allowed difference in times and states, relative to 1 + their size ...
TOLERANCE = 1e-8
# ... and how far scipy at two tolerances may differ before a system counts as ill-conditioned.
CONDITION = 1e-9
# Tolerances of hybridjax, and the number of its steps.
ACCURACY = 1e-12
STEPS = 1000
# Systems in one compiled call.
BATCH = 21


@dataclasses.dataclass
class Report:
    """What became of the systems of one structure."""

    name: str
    systems: int = 0
    events: int = 0
    excluded: dict[str, list[int]] = dataclasses.field(default_factory=dict)
    """Systems that are not compared, by reason."""
    failures: dict[int, str] = dataclasses.field(default_factory=dict)
    """What went wrong, by system."""
    error: tuple[float, float] = (0.0, 0.0)
    """Largest differences of event times, and of states after events and at the end, relative to
    1 + their size."""

    @property
    def compared(self) -> int:
        excluded = sum(len(numbers) for numbers in self.excluded.values())
        return self.systems - excluded

    def __str__(self):
        lines = [
            f"{self.name}: {self.compared} of {self.systems} compared, {self.events} events; "
            "errors {:.1e} in time, {:.1e} in state".format(*self.error)
        ]
        lines += [
            f"excluded, {reason}: {numbers}"
            for reason, numbers in self.excluded.items()
        ]
        return "\n".join(
            lines + [f"FAILED {self.name}:{k}: {x}" for k, x in self.failures.items()]
        )


def shares(systems: int) -> dict[str, range]:
    """The numbers of the systems of each structure when there are so many in total."""
    names = list(STRUCTURES)
    each, more = divmod(systems, len(names))
    return {name: range(each + (k < more)) for k, name in enumerate(names)}


def check(name: str, numbers, seed: int = 0, accuracy: float = ACCURACY) -> Report:
    """Compare systems `numbers` of a structure."""
    plan = STRUCTURES[name][0]
    report = Report(name, len(numbers))
    samples = [draw(name, k, seed) for k in numbers]
    truths = [truth(plan, sample) for sample in samples]
    ends = [stop(run, sample) for run, sample in zip(truths, samples, strict=True)]
    found = engine(plan, samples, ends, accuracy)
    for k, run, (result, trial) in zip(numbers, truths, found, strict=True):
        if run.excluded:
            report.excluded.setdefault(run.excluded, []).append(k)
            continue
        report.events += len(run.events)
        full = len(run.events) == EVENTS
        if result != hj.errors.Result.OK:
            place = f"{result.name} at t = {trial.t:.9g}"
            report.failures[k] = place
        elif order(trial) != order(run):
            orders = f"events {order(trial)}, but {order(run)} by scipy"
            report.failures[k] = orders
        else:
            error = difference(trial, run, end=not full)
            report.error = tuple(map(max, report.error, error))
            if not max(error) <= TOLERANCE:
                report.failures[k] = "errors {:.1e} in time, {:.1e} in state".format(
                    *error
                )
    return report


def truth(plan: Plan, sample: Sample) -> Run:
    """The trajectory by scipy, with the reason why it is excluded, if it is."""
    run = scipy_loop.run(plan, sample, EVENTS, 1e-13, 1e-14)
    if run.excluded is None:
        rough = scipy_loop.run(plan, sample, EVENTS, 1e-11, 1e-12)
        full = len(run.events) == EVENTS
        if (
            order(rough) != order(run)
            or max(difference(rough, run, not full)) > CONDITION
        ):
            run.excluded = "ill-conditioned"
    return run


def stop(run: Run, sample: Sample) -> float:
    """When hybridjax may stop: at the limit, or a little after the last event."""
    if len(run.events) < EVENTS:
        return sample.start.limit
    return run.t + 1e-3


def order(run: Run) -> list[int]:
    return [event.code for event in run.events]


def difference(a: Run, b: Run, end: bool) -> tuple[float, float]:
    """Largest differences of times and states, relative to 1 + their size."""

    def relative(x, y):
        size = 1 + np.abs(y)
        return np.max(np.abs(x - y) / size)

    pairs = list(zip(a.events, b.events, strict=True))
    times = [relative(x.t, y.t) for x, y in pairs]
    states = [relative(x.after, y.after) for x, y in pairs]
    if end:
        if a.chart == b.chart:
            states.append(relative(a.q, b.q))
        else:
            states.append(np.inf)
    return max(times, default=0.0), max(states, default=0.0)


def engine(
    plan: Plan, samples: list[Sample], ends: list[float], accuracy: float
) -> list[tuple[hj.errors.Result, Run]]:
    """Results and trajectories by hybridjax, up to the wanted number of events.

    The one place that knows how the flow is called.
    """
    out = []
    for k in range(0, len(samples), BATCH):
        piece = samples[k : k + BATCH]
        missing = BATCH - len(piece)
        fill = piece + piece[-1:] * missing
        no_more = ends[-1:] * (BATCH - len(piece))
        stops = ends[k : k + BATCH] + no_more
        many = jax.tree_util.tree_map(
            lambda *x: jnp.stack([jnp.asarray(y) for y in x]), *fill
        )
        times = jnp.asarray(stops)
        moved = _flow(plan, many, times, jnp.asarray(accuracy))
        moved = jax.tree_util.tree_map(np.asarray, moved)
        for i in range(len(piece)):
            result, count, events, t, chart, q = jax.tree_util.tree_map(
                lambda x, i=i: x[i], moved
            )
            events = [
                Event(float(at), int(code), int(b), after[: plan.dims[b]])
                for at, code, b, after in zip(*events, strict=True)
            ]
            state = q[: plan.dims[chart]]
            happened = events[:count]
            run = Run(happened, float(t), int(chart), state)
            out.append((hj.errors.Result(int(result)), run))
    return out


@quick_jit
def _flow(plan: Plan, many: Sample, ends, accuracy):
    def one(sample: Sample, end):
        t, q, u, _ = sample.start
        s = Structure(Random(plan, sample.charts, sample.arrows))
        padded = jnp.zeros((s.d, 1))
        d = plan.dims[0]
        q = padded.at[:d, 0].set(q)
        settings = Settings(rtol=accuracy, atol=accuracy, max_steps=STEPS)
        charts = jnp.zeros(1, jnp.int32)
        lanes = start_lanes(s, t[None], charts, q)
        moved, tape = move(
            s, lanes, u[:, None], until(end[None]), settings, options=Options(True)
        )
        happens = tape.code[:, 0] >= 0
        (rows,) = jnp.nonzero(happens, size=EVENTS, fill_value=0)
        events = [x[rows, ..., 0] for x in (tape.t, tape.code, tape.chart, tape.after)]
        end = moved.lanes
        return (
            moved.result[0],
            happens.sum(),
            events,
            end.t[0],
            end.chart[0],
            end.q[:, 0],
        )

    return jax.vmap(one)(many, ends)


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz.campaign")
    parser.add_argument(
        "--systems", type=int, default=1000, help="number, over all structures"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--accuracy", type=float, default=ACCURACY, help="tolerances of hybridjax"
    )
    arguments = parser.parse_args()
    hj.enable_x64()
    reports = []
    for name, numbers in shares(arguments.systems).items():
        if numbers:
            reports.append(check(name, numbers, arguments.seed, arguments.accuracy))
            print(reports[-1], flush=True)
    excluded = sum(r.systems - r.compared for r in reports) / sum(
        r.systems for r in reports
    )
    print(f"excluded {excluded:.2%} (by scipy alone)")
    return int(any(r.failures for r in reports))


if __name__ == "__main__":
    sys.exit(main())
