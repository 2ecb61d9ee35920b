"""80 experiments x 84 cycles x 32 sections, beside other libraries, each at several accuracies.

`run` is `run_experiments` as a user calls it; `program` only what it compiled; `loops` is `run` in
a process of its own on the same core, with `enable_loop_kernels`. Ratios are times of a peer
divided by those of one of these, each at its fastest setting whose error is below the limit.
"""

import functools as ft
import json
import sys

from peers.contest import Contest, Seconds

from .children import call
from .problems import ALL, Problem, first_and_later, problem, program


ACCURACIES = (1e-7, 1e-8, 1e-9)
LIMITS = (1e-7, 1e-9)
OURS = ("run", "program", "loops")
PEERS = (
    "c",
    "heyoka.scalar",
    "heyoka.simd",
    "heyoka.batch",
    "scipy",
    "jaxonomy",
)


def run(show, options) -> None:
    names = ["c", "heyoka", "scipy"] + ["jaxonomy"] * (options.jaxonomy is not None)
    for model, family in ALL:
        seen = {}

        def note(name, value, seen=seen):
            seen[name] = value
            show(name, value)

        task = problem(model, family, options.quick)
        show(f"{task.label}.section_maps", task.u.size)
        _ours(task, note, options.repeat)
        chosen = model, family, str(options.repeat), str(int(options.quick))
        for name, value in call("experiments", *chosen).items():
            note(name, value)
        Contest(task.job, task.exact, note, options.repeat, options.jaxonomy).run(names)
        for limit in LIMITS:
            _compare(task.label, limit, seen, show)


def _runs(task: Problem, who: str, note, repeat: int) -> None:
    for accuracy in ACCURACIES:
        name = f"{task.label}.{who}.accuracy_{accuracy:.0e}"
        data, compiling, seconds = first_and_later(
            ft.partial(task.run, accuracy), repeat
        )
        if accuracy == ACCURACIES[0]:
            note(f"{task.label}.{who}.compile", compiling)
        _result(note, name, seconds, task.error(data))
        note(f"{name}.failed", int((~data.ok).sum()))


def _ours(task: Problem, note, repeat: int) -> None:
    _runs(task, "run", note, repeat)
    for accuracy in ACCURACIES:
        name = f"{task.label}.program.accuracy_{accuracy:.0e}"
        y, _, seconds = first_and_later(
            ft.partial(program, *task.response(accuracy)), repeat
        )
        _result(note, name, seconds, task.distance(y))


def _result(note, name: str, seconds: Seconds, error: float) -> None:
    note(f"{name}.cpu", seconds.cpu)
    note(f"{name}.wall", seconds.wall)
    note(f"{name}.error", error)


def _compare(label: str, limit: float, seen: dict, show) -> None:
    """Fastest times with errors below the limit, and their ratios to ours."""
    best = {}
    for who in (*OURS, *PEERS):
        found = [
            (seen[x], seen[x.removesuffix("cpu") + "error"])
            for x in seen
            if x.startswith(f"{label}.{who}.") and x.endswith(".cpu")
        ]
        good = [x for x in found if x[1] <= limit]
        if good:
            best[who], error = min(good)
            show(f"{label}.at_{limit:.0e}.{who}.cpu", best[who])
            show(f"{label}.at_{limit:.0e}.{who}.error", error)
        elif found:
            reason = f"errors are {min(e for _, e in found):.1e} and more"
            show(f"{label}.at_{limit:.0e}.{who}.cpu", f'"{reason}"')
    for who in PEERS:
        for ours in OURS:
            if who in best and ours in best:
                ratio = best[who] / best[ours]
                show(
                    f"{label}.at_{limit:.0e}.ratio_{who.replace('.', '_')}.{ours}",
                    ratio,
                )


def main(model: str, family: str, repeat: str, quick: str) -> None:
    import hybridjax as hj

    hj.scale.enable_loop_kernels()
    hj.enable_x64()
    found = {}
    _runs(
        problem(model, family, bool(int(quick))),
        "loops",
        found.__setitem__,
        int(repeat),
    )
    print(json.dumps(found))


if __name__ == "__main__":
    main(*sys.argv[1:])
