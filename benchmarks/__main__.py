"""All benchmarks by name: `python benchmarks` lists them, `python benchmarks NAME ...` runs some.

`python benchmarks release` runs what is run before a release, one after the other. Options of one
case: `python benchmarks NAME -- OPTION ...`, or the script itself with `--help`.
"""

import pathlib
import subprocess
import sys


# By name: script and options, CPU minutes, and what its numbers show.
CASES = {
    "speed": (
        "run.py",
        20,
        "speed beside C, heyoka and scipy; errors; docs/benchmarks.md",
    ),
    "speed-quick": (
        "run.py --quick",
        4,
        "the same with small sizes: does all of it work?",
    ),
    "gallery": (
        "gallery.py --out out",
        15,
        "every model: cycle, multipliers, HTFs, a picture",
    ),
    "estimation": ("estimation.py --runs 200", 20, "errors and regions of HTFs"),
    "multipliers": (
        "identification.py --seeds 40 --runs 200",
        20,
        "errors and regions of fits",
    ),
    "colored": ("colored.py --draws 40", 10, "regions under colored noise"),
    "process-noise": (
        "process_noise.py --draws 40",
        10,
        "fits with innovations, validation",
    ),
    "in-loop": ("in_loop.py --draws 60", 3, "plant and controller apart, in a loop"),
    "state-space": (
        "joint.py --draws 12",
        5,
        "fits of whole models beside their bound",
    ),
    "recordings": (
        "recordings.py",
        30,
        "multipliers from recordings, clean and corrupted",
    ),
    "population": (
        "population.py",
        25,
        "means, maps and power over simulated subjects",
    ),
    "designs": ("designs.py --draws 40", 25, "strides that optimal designs save"),
    "parameters": (
        "fitting.py --seeds 10 --draws 40",
        10,
        "physical parameters from data",
    ),
    "second-order": (
        "second_order.py",
        2,
        "second-order products on lines, and draws without",
    ),
    "outsiders": (
        "outsiders",
        120,
        "models by outsiders: true cycle or refusal, beside scipy",
    ),
    "jumps": (
        "jumps.py --draws 200",
        6,
        "random systems with jumps and pulses, right or refused",
    ),
    "missed-events": (
        "missed_events.py",
        15,
        "random flows with known zeros: events missed and invented",
    ),
    "conformance": (
        "conformance.py random",
        25,
        "derivatives of flows through events, against scipy; `rows`, `peers`, `speed`",
    ),
    "strangers": (
        "strangers.py",
        90,
        "estimates from generators that do not import the package",
    ),
    "branches": (
        "branches.py",
        20,
        "branches against single searches, scipy and closed forms",
    ),
    "scale": ("scale.py", 30, "sweeps and experiments on several processes"),
    "motion": ("motion.py", 1, "moves of sliders, first pictures of animations"),
    "boundary": ("boundary.py", 1, "the cost of checking arguments"),
    "truth-chain": ("chain_truth.py", 1, "ground truth, independent of the package"),
    "truth-circuits": ("circuits_truth.py", 1, "ground truth"),
    "truth-neurons": ("neurons_truth.py", 1, "ground truth"),
    "truth-stiff": ("stiff_truth.py", 1, "ground truth"),
    "truth-trot": ("trot_truth.py", 1, "ground truth"),
    "truth-walkers": ("walkers_truth.py", 2, "ground truth"),
}
RELEASE = (
    "speed",
    "gallery",
    "estimation",
    "multipliers",
    "colored",
    "process-noise",
    "designs",
)
HERE = pathlib.Path(__file__).parent


def main(arguments: list[str]) -> int:
    names, _, options = " ".join(arguments).partition("--")
    chosen = RELEASE if names.split() == ["release"] else names.split()
    if not chosen or not set(chosen) <= set(CASES):
        print(__doc__)
        for name, (command, minutes, shows) in CASES.items():
            print(f"  {name:14} {minutes:3} min  {shows}  ({command})")
        return 2 if chosen else 0
    failed = []
    for name in chosen:
        print(f"== {name}", flush=True)
        script, *usual = CASES[name][0].split()
        command = [sys.executable, str(HERE / script), *(options.split() or usual)]
        failed += [name] if subprocess.run(command).returncode else []
    print("failed:", ", ".join(failed) or "none")
    return bool(failed)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
