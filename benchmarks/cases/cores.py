"""Two cores against one: `run_experiments` with `workers=2` and with `workers=1`.

In a process of its own, which may use two cores; seconds of the wall's clock.
"""

import json
import sys

import one_thread


CORES = 2


def run(show, options) -> None:
    from .children import call

    for name, value in call(
        "cores", str(options.repeat), str(int(options.quick))
    ).items():
        show(name, value)


def main(repeat: int, quick: bool) -> None:
    found = {"cores": one_thread.unpin(CORES)}
    import hybridjax as hj

    hj.enable_x64()
    from .problems import HOPPER, measure, problem

    for model, family in HOPPER:
        for count in (16,) if quick else (80, 640):
            task = problem(model, family, quick)
            task = task.part(count, task.u.shape[1])
            walls = {}
            for workers in (1, 2):
                task.run(workers=workers)
            for workers in (1, 2):
                data, seconds = measure(
                    lambda t=task, w=workers: t.run(workers=w), repeat
                )
                name = f"{task.label}.size_{count}.workers_{workers}"
                found[f"{name}.wall"] = walls[workers] = seconds.wall
                found[f"{name}.cpu"] = seconds.cpu
                if count <= 80:
                    found[f"{name}.error"] = task.error(data)
            found[f"{task.label}.size_{count}.speedup"] = walls[1] / walls[2]
    print(json.dumps(found))


if __name__ == "__main__":
    main(int(sys.argv[1]), bool(int(sys.argv[2])))
