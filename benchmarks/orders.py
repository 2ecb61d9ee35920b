"""Whether results depend on what ran before in the same process, or on the clock.

python benchmarks/orders.py [--runs 4]

Each run is a process that computes the cycle, its linearization and two experiments of all systems,
in an order of its own: the first two in opposite orders, so that each of the 300 pairs comes in
both, the others in random ones. For each system: the largest difference between two runs of states
on the cycle and of outputs in experiments, and of the matrices of the linearization, each relative
to the largest; and the error that the experiments state.
"""

import argparse
import itertools
import os
import subprocess
import sys
import tempfile

import numpy as np
from gallery_cases import CASES, Case

import hybridjax as hj


SLOW = {"biped", "torso walker", "two hoppers", "compass gait", "short gait"}
NAMES = [*(x for x in CASES if x not in SLOW), "FitzHugh-Nagumo, 0.001"]


def case_of(name: str) -> Case:
    if name in CASES:
        return CASES[name]()
    case = CASES["FitzHugh-Nagumo"]()
    return case._replace(system=hj.models.FitzHughNagumo(eps=0.001))


def results(case: Case) -> dict[str, np.ndarray]:
    options = {
        x: getattr(case, x)
        for x in ("section", "multiplicity", "conserved", "max_period")
    }
    cycle = hj.find_limit_cycle(case.system, case.guess, **options)
    placed = hj.sections.place_sections(cycle, case.sections)
    model = hj.linearize(cycle, placed, case.output)
    design = hj.multisine(
        placed.n_sections,
        4,
        amplitude=case.amplitude or 1e-5,
        inputs=case.system.inputs,
    )
    u = design.signals(cycles=4)[:2]
    data = hj.run_experiments(cycle, placed, u, case.output, start="cycle", discard=0)
    q, y = np.asarray(placed.lanes.q), np.nan_to_num(data.y)
    return {
        "cycle": q / (np.abs(q).max(axis=1, keepdims=True) + 1e-300),
        "linearization": np.concatenate(
            [np.ravel(x) for x in (*model.A, *model.B, *model.C)]
        ),
        "experiments": y / (np.abs(y).max() + np.abs(data.cycle_outputs).max()),
        "stated": np.asarray(data.error),
    }


def one_run(names: list[str], path: str) -> None:
    hj.enable_x64()
    parts = {}
    for name in names:
        parts |= {f"{name}|{k}": v for k, v in results(case_of(name)).items()}
        print(".", end="", flush=True)
    np.savez(path, **parts)


def compare(runs: int) -> None:
    orders = [NAMES, NAMES[::-1]]
    orders += [
        list(np.random.default_rng(k).permutation(NAMES)) for k in range(runs - 2)
    ]
    with tempfile.TemporaryDirectory() as folder:
        paths = [os.path.join(folder, f"{k}.npz") for k in range(len(orders))]
        for order, path in zip(orders, paths, strict=True):
            subprocess.run(
                [sys.executable, __file__, "--order", path, *order], check=True
            )
        parts = [dict(np.load(path)) for path in paths]
    print(
        "\n| system | cycle | linearization | experiments | stated |\n|---|---|---|---|---|"
    )
    for name in NAMES:
        row = []
        for what in ("cycle", "linearization", "experiments"):
            each = [x[f"{name}|{what}"] for x in parts]
            size = np.abs(each[0]).max() if what == "linearization" else 1.0
            differences = [
                np.abs(a - b).max() / size for a, b in itertools.combinations(each, 2)
            ]
            row.append(max(differences))
        stated = max(x[f"{name}|stated"].max() for x in parts)
        print(f"| {name} | {' | '.join(f'{x:.1e}' for x in (*row, stated))} |")


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--runs", type=int, default=4)
    parser.add_argument("--order", nargs="+")
    options = parser.parse_args()
    if options.order:
        one_run(options.order[1:], options.order[0])
    else:
        compare(options.runs)
