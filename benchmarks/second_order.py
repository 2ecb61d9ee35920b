"""What second-order products cost: subsets drawn plainly at random against subsets that avoid them.

The hopper answers two lines f_i and f_j not only at themselves but, to second order, at f_i + f_j
and f_i - f_j (plus integers) as well. The paper's rules allow these products to fall on lines of
the same experiment. Here the paper's protocol (80 experiments, 84 cycles, the last 64 kept,
amplitude 0.01) is run with many seeds, with and without such hits. Printed, as `name value` lines:
the largest error of the estimated H_0 over all 620 frequencies, relative to max|H_0|: its
smallest, median and largest value over the seeds.

    python benchmarks/second_order.py [--seeds 24]
"""

import argparse

import numpy as np

import hybridjax as hj


OUTPUTS = ("yM", "vM")


def sections():
    """The paper's two families."""
    apex = hj.Crossing("vM", "falling")
    return {
        "isochron": hj.ClockPhase(32, anchor=apex),
        "kinematic": hj.KinematicPhase(
            32,
            position="yM",
            velocity="vM",
            center=(1.9, 0.0),
            scale=(0.3, 1.9),
            anchor=apex,
        ),
    }


def errors(cycle, placed, exact, seed: int, division: str) -> np.ndarray:
    """Largest error of H_0 per output."""
    design = hj.experiments.paper_design(seed=seed, division=division)
    data = hj.run_experiments(cycle, placed, design, OUTPUTS)
    return np.asarray(hj.estimate_htf(data, harmonics=0).error(exact))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--seeds", type=int, default=24, help="number of draws, from seed 0 on"
    )
    seeds = range(parser.parse_args().seeds)
    hj.enable_x64()
    hj.scale.enable_compilation_cache()
    cycle = hj.find_limit_cycle(hj.models.VerticalHopper())
    for family, definition in sections().items():
        placed = hj.sections.place_sections(cycle, definition)
        exact = hj.linearize(cycle, placed, OUTPUTS).htf(
            hj.experiments.paper_design().frequencies, 0
        )
        for choice, label in (("random", "random"), ("sum-free", "avoiding")):
            found = np.array(
                [errors(cycle, placed, exact, seed, choice) for seed in seeds]
            )
            for k, output in enumerate(OUTPUTS):
                name = f"second_order.{family}.{label}.{output}"
                print(f"{name}.min {found[:, k].min():.2e}")
                print(f"{name}.median {np.median(found[:, k]):.2e}")
                print(f"{name}.max {found[:, k].max():.2e}", flush=True)


if __name__ == "__main__":
    main()
