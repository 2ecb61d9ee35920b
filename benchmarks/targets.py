"""What was aimed at before the engine was written: numbers of the benchmarks, and their bounds."""

from typing import NamedTuple


PEERS = {"c": "the C loop", "heyoka_batch": "heyoka in batches", "scipy": "scipy"}


class Target(NamedTuple):
    """The number `key`, the least that is asked of it, and what is aimed at. `more` is better, or
    less. `error` is the key of the error beside it."""

    what: str
    key: str
    least: float | None
    aim: float | None = None
    unit: str = ""
    more: bool = False
    error: str | None = None


def _ratio(job: str, peer: str, least: float | None, aim: float) -> tuple[Target, Target]:
    """As it is, and with `enable_loop_kernels`."""
    name = f"experiments.{job}.at_1e-09"
    what = {"run": "experiments", "loops": "experiments, loop kernels"}
    return tuple(
        Target(
            f"{text}, {job.replace('.', ', ')}: times the speed of {PEERS[peer]}",
            f"{name}.ratio_{peer}.{who}", least, aim, more=True, error=f"{name}.{who}.error",
        )
        for who, text in what.items()
    )  # fmt: skip


TARGETS = (
    *_ratio("hopper.isochron", "c", 1, 2.5),
    *_ratio("hopper.isochron", "heyoka_batch", 1, 7),
    *_ratio("hopper.isochron", "scipy", 2000, 5000),
    *_ratio("hopper.kinematic", "c", 1, 3),
    *_ratio("hopper.kinematic", "heyoka_batch", 1, 20),
    *_ratio("hopper.kinematic", "scipy", 1000, 4000),
    *_ratio("bar.isochron", "heyoka_batch", 1, 7),
    *_ratio("bar.isochron", "c", None, 2.5),
    *_ratio("bar.kinematic", "heyoka_batch", 1, 20),
    *_ratio("bar.kinematic", "c", None, 3),
    *(
        Target(
            f"all 32 A, B, {family}", f"jacobians.hopper.{family}.program.rtol_1e-10.cpu", 1e-3,
            3e-4, "s", error=f"jacobians.hopper.{family}.program.rtol_1e-10.error",
        )
        for family in ("kinematic", "isochron")
    ),
    *(
        Target(
            f"gradient, {mode} mode, {family}: multiple of a plain run",
            f"gradients.hopper.{family}.{mode}.times_plain", least, aim,
            error=f"gradients.hopper.{family}.{mode}.error",
        )
        for mode, least, aim in (("reverse", 12, 6), ("forward", 6, 3))
        for family in ("isochron", "kinematic")
    ),
    *(
        Target(
            f"gradient, reverse mode, {family}: memory",
            f"gradients.hopper.{family}.reverse.megabytes", 10, None, "MB",
        )
        for family in ("isochron", "kinematic")
    ),
    Target("10 000 limit cycles and multipliers", "grid.wall", 2, 0.7, "s",
           error="grid.scipy.state_error"),
    Target("... share with residual <= 1e-10", "grid.good", 0.99, 1, more=True),
    *(
        Target(
            f"two cores, {family}, {count} experiments: gain",
            f"cores.hopper.{family}.size_{count}.speedup", 1.7, 1.95, more=True,
        )
        for family in ("isochron", "kinematic")
        for count in (80, 640)
    ),
    *(
        Target(
            f"first call of `{call}`, {family}, {state}", f"compile.{family}.{state}.{call}",
            *((8, 4) if state == "cold" else (3, 1.5)), "s",
        )
        for state in ("cold", "cached")
        for family in ("isochron", "kinematic")
        for call in ("find_limit_cycle", "linearize", "run_experiments")
    ),
    *(
        Target(f"{what}, {family}", f"compile.{family}.{key}", 0, 0)
        for what, key in {
            "programs compiled again for another value": "another_value.compilations",
            "programs with host callbacks": "programs_with_callbacks",
        }.items()
        for family in ("isochron", "kinematic")
    ),
)  # fmt: skip


def verdict(x: Target, value: float) -> str:
    """Which bound a value keeps."""
    sign = -1 if x.more else 1
    if x.aim is not None and sign * value <= sign * x.aim:
        return "aim"
    if x.least is None:
        return "not the aim"
    return "yes" if sign * value <= sign * x.least else "**no**"
