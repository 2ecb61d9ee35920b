"""First calls in fresh processes on two cores, without and with a cache of compiled programs.

Seconds of the wall's clock after the import, for each call in turn: `find_limit_cycle`,
`linearize`, `run_experiments` (80 experiments, 84 cycles), `find_limit_cycle` again. `cold` begins
with an empty cache, `cached` with the one that the cold process left, `later` after a process
that has made programs be compiled thoroughly. A third process changes a parameter and counts what
is traced or compiled again, and looks for host callbacks in all programs.

`own` is the hopper again, of classes that are defined in `__main__`, as in a notebook, on kinematic
sections; `bar` is the bar, with its four charts, on both families (`times_hopper`: as multiples of
the hopper's).

`derivatives`: the gradient of a coefficient of the characteristic polynomial by the hopper's nine
parameters, in reverse mode and outside of `jit`, and a fit of two parameters to HTFs; `again`: the
second of each. `responses`: the first `cycle.responses()` of the hopper and of a neuron, and the
hopper's `cycle.htf` at 620 frequencies again. `cycles`: `find_limit_cycles` of 50 x 50 hoppers, and
the same by the sweep in C (`c`; `times_c`: as multiples of it). `sweep`: `hj.sweep` of the same;
`branch`: README's continuation; each a second time. `repeats`: `find_limit_cycle` with
the arguments of an earlier call (`same`), and from a known cycle after a small change of a
parameter: an early call, the call that compiles, and a later one. `in_program`:
inside of `jit`, the gradient of the square of the monodromy's trace by the hopper's nine
parameters; `linearized`: that of the matrices between sections; `..._quick`: with an option of the
compiler. `neurons`, `bucks`, `compasses`: `find_limit_cycles` of 2500 of each (`found`: the
share). Calls of these and of `cycles` again count by the least time of three.
`second_process`: the sweep in a process that finds the compiled programs of another. `walkers`: a
cycle of the hopper and of the five-link biped, and 80 experiments on a kneed walker (32 cycles, 16
sections, steady start), each a second time.

The same in seconds of the processor (`cpu`), and as multiples of a yardstick that is measured
beside them, `diffeqsolve.cpu`: the first call, in a fresh process, of `diffrax.diffeqsolve` for the
hopper's flight up to its touchdown.
"""

import inspect
import json
import os
import pathlib
import re
import sys
import tempfile
import time
from collections.abc import Callable

import numpy as np
import one_thread


CORES = 2
JOBS = (
    "derivatives",
    "responses",
    "cycles",
    "sweep",
    "second_process",
    "branch",
    "walkers",
    "repeats",
    "in_program",
    "in_program_quick",
    "linearized",
    "linearized_quick",
    "neurons",
    "bucks",
    "compasses",
)
# A plane of 50 x 50 hoppers. Where k is small, the clock's phase 0.5 lies in flight.
AXES = {"k": np.linspace(8, 13, 50), "b": np.linspace(3, 7, 50)}
# Planes of 50 x 50 systems of other models, so small that events keep their order.
PLANES = {
    "neurons": (
        "FitzHughNagumo",
        {"current": np.linspace(0.49, 0.51, 50), "a": np.linspace(0.698, 0.701, 50)},
    ),
    "bucks": (
        "BuckConverter",
        {"Vin": np.linspace(19, 21, 50), "R": np.linspace(21, 23, 50)},
    ),
    "compasses": (
        "CompassGait",
        {"mH": np.linspace(9.5, 10.5, 50), "m": np.linspace(4.9, 5.1, 50)},
    ),
}
# Further calls of the short jobs, the least time of which counts.
REPEAT = 3
# Not seconds: shares, and ratios to the sweep in C.
UNITLESS = ("found", "times_c")


def run(show, options) -> None:
    from .children import call
    from .problems import ALL, HOPPER

    yardstick = call("compile", "diffeqsolve")
    show("diffeqsolve.cpu", yardstick)
    seconds = {}

    def calls(label: str, state: str, *job: str, cache: str) -> None:
        for name, value in call("compile", *job, HYBRIDJAX_CACHE=cache).items():
            show(f"{label}.{state}.{name}", value)
            if not name.endswith(".cpu"):
                continue
            what = name.removesuffix(".cpu")
            show(f"{label}.{state}.{what}.times_diffeqsolve", value / yardstick)
            seconds[label, state, what] = value
            if label.startswith("bar."):
                hopper = seconds[label.removeprefix("bar."), state, what]
                show(f"{label}.{state}.{what}.times_hopper", value / hopper)

    for job in JOBS:
        for name, value in call("compile", job).items():
            if name.endswith(UNITLESS):
                show(f"{job}.{name}", value)
                continue
            show(f"{job}.{name}.cpu", value)
            show(f"{job}.{name}.times_diffeqsolve", value / yardstick)
    for _, family in HOPPER[:1] if options.quick else HOPPER:
        with tempfile.TemporaryDirectory() as cache:
            for state in ("cold", "cached", "later"):
                if state == "later":
                    call(
                        "compile", "hopper", family, "thoroughly", HYBRIDJAX_CACHE=cache
                    )
                calls(family, state, "hopper", family, cache=cache)
            folder = str(pathlib.Path(cache, "modules"))
            found = call("compile", "hopper", family, folder, HYBRIDJAX_CACHE=cache)
        for name, value in found.items():
            show(f"{family}.{name}", value)
    others = [
        ("own", "own", "kinematic"),
        *((f"bar.{x}", "bar", x) for m, x in ALL if m == "bar"),
    ]
    for label, *job in [] if options.quick else others:
        with tempfile.TemporaryDirectory() as cache:
            for state in ("cold", "cached"):
                calls(label, state, *job, cache=cache)


def first_calls(model: str, family: str, repetition: int = 0):
    """The calls with the seconds that each takes, for a hopper with its own stiffness, or a bar."""
    import hybridjax as hj

    from .problems import OUTPUTS, sections

    seconds = {}
    if model == "bar":
        system = hj.models.TwoLeggedBar()
    else:
        make = hj.models.VerticalHopper if model == "hopper" else defined_here()
        system, model = make(k=10 + 1e-3 * repetition), "hopper"
    own, outputs, design = (
        sections(model, family),
        OUTPUTS[model],
        hj.experiments.paper_design(),
    )

    def timed(name, work):
        begin, processor = time.perf_counter(), time.process_time()
        result = work()
        seconds[name] = time.perf_counter() - begin
        seconds[f"{name}.cpu"] = time.process_time() - processor
        return result

    cycle = timed("find_limit_cycle", lambda: hj.find_limit_cycle(system))
    timed("linearize", lambda: hj.linearize(cycle, own, outputs))
    data = timed(
        "run_experiments", lambda: hj.run_experiments(cycle, own, design, outputs)
    )
    assert data.ok.all()
    timed("find_limit_cycle_again", lambda: hj.find_limit_cycle(system))
    return seconds


def defined_here() -> type:
    """The class of the hopper as if it had been written in this process's main module."""
    from hybridjax.models import hoppers

    main = sys.modules["__main__"].__dict__
    exec(inspect.getsource(hoppers).replace("from ..", "from hybridjax."), main)
    return main["VerticalHopper"]


def derivatives() -> dict[str, float]:
    """CPU seconds of a gradient and a fit, after the cycle was found: of the first call and the
    second, and of fits after the fifth."""
    import equinox as eqx

    import hybridjax as hj

    from .problems import OUTPUTS, sections

    hj.enable_x64()
    hopper, outputs = hj.models.VerticalHopper(), OUTPUTS["hopper"]
    family, cycle = sections("hopper", "kinematic"), hj.find_limit_cycle(hopper)
    htf = hj.linearize(cycle, family, outputs).htf(
        np.linspace(0.01, 0.49, 40), (-1, 0, 1)
    )

    def coefficient(system):
        neighbor = hj.find_limit_cycle(system, cycle)
        return hj.linearize(neighbor, family, outputs).characteristic_polynomial()[2]

    near, observed = (
        hj.models.VerticalHopper(k=10.8, b=4.75),
        hj.fitting.ObservedHTF(htf, family),
    )

    def fit():
        hj.fit_model(near, observed, ("k", "b"), guesses=4)

    gradient = twice(gradient=lambda: eqx.filter_grad(coefficient)(hopper).k.item())
    first = twice(fit=fit)
    # (The fifth fit compiles, see `fitting/beside.py`.)
    later = twice(fit_compiled=fit, repeat=6)
    return gradient | first | {"fit_later": later["fit_compiled_again"]}


def twice(*, repeat: int = 1, **jobs: Callable[[], object]) -> dict[str, float]:
    """CPU seconds of the first call of each job, and the least of `repeat` further ones."""
    seconds = {}
    for name, job in jobs.items():
        calls = []
        for _ in range(1 + repeat):
            begin = time.process_time()
            job()
            calls.append(time.process_time() - begin)
        seconds |= {name: calls[0], f"{name}_again": min(calls[1:])}
    return seconds


def cycles() -> dict[str, float]:
    """CPU seconds of the cycles of 50 x 50 hoppers, after that of one was found, and those of C."""
    import equinox as eqx

    import hybridjax as hj

    from .problems import hoppers_in_c

    hj.enable_x64()
    make = eqx.filter_vmap(lambda k, b: hj.models.VerticalHopper(k=k, b=b))
    k, b = np.meshgrid(*AXES.values(), indexing="ij")
    systems = make(k.ravel(), b.ravel())
    cycle = hj.find_limit_cycle(hj.models.VerticalHopper())
    found = {}

    def find():
        found["cycles"] = hj.orbits.find_limit_cycles(systems, cycle)

    seconds = twice(find_limit_cycles=find, repeat=REPEAT)
    share = float(found["cycles"].ok.mean())
    c = hoppers_in_c(cycle, k, b, repeat=5)
    if c is None:
        return seconds | {"found": share}
    ratio = seconds["find_limit_cycles_again"] / c.seconds.cpu
    return seconds | {"found": share, "c": c.seconds.cpu, "again.times_c": ratio}


def sweep() -> dict[str, float]:
    """CPU seconds of `hj.sweep` of as many, with nothing before."""
    import hybridjax as hj

    hj.enable_x64()
    if "HYBRIDJAX_CACHE" in os.environ:
        hj.scale.enable_compilation_cache()
    return twice(sweep=lambda: hj.sweep(hj.models.VerticalHopper(), AXES))


def second_process() -> dict[str, float]:
    """CPU seconds of `sweep` in a process that finds the compiled programs of another."""
    from .children import call

    with tempfile.TemporaryDirectory() as cache:
        call("compile", "sweep", HYBRIDJAX_CACHE=cache)
        return {"sweep": call("compile", "sweep", HYBRIDJAX_CACHE=cache)["sweep"]}


def branch() -> dict[str, float]:
    """CPU seconds of README's continuation of a buck converter, after the cycle was found."""
    import hybridjax as hj

    hj.enable_x64()
    buck = hj.find_limit_cycle(hj.models.BuckConverter())
    return twice(continuation=lambda: hj.continuation(buck, "Vin", (20.0, 26.0)))


def walkers() -> dict[str, float]:
    """CPU seconds of cycles of the hopper and the biped, and of experiments on a kneed walker."""
    import hybridjax as hj

    from .kneed import KneedWalker

    hj.enable_x64()
    cycle = hj.find_limit_cycle(KneedWalker())
    angles = [hj.Crossing("stance", "rising", x) for x in np.linspace(-0.15, 0.25, 15)]
    placed = hj.sections.place_sections(cycle, [hj.AtEvent("heelstrike"), *angles])
    u = 1e-3 * np.random.default_rng(0).standard_normal((80, 32 * 16, 1))
    return twice(
        hopper=lambda: hj.find_limit_cycle(hj.models.VerticalHopper()),
        biped=lambda: hj.find_limit_cycle(hj.models.FiveLinkBiped()),
        kneed=lambda: hj.run_experiments(cycle, placed, u, "stance", start="steady"),
    )


def repeats() -> dict[str, float]:
    """CPU seconds of the same call again, and of cycles near known ones with new values of a
    parameter: of the first calls, which search, and of later ones, which are compiled."""
    import hybridjax as hj

    hj.enable_x64()
    seconds = {}
    cases = {
        "hopper": (hj.models.VerticalHopper, "k", 10.0),
        "neuron": (hj.models.FitzHughNagumo, "current", 0.5),
        "biped": (hj.models.FiveLinkBiped, "lean", 0.2),
    }
    for name, (make, parameter, value) in cases.items():
        cycle = hj.find_limit_cycle(make())
        begin = time.process_time()
        hj.find_limit_cycle(make())
        seconds[f"{name}.same"] = time.process_time() - begin
        calls = []
        for i in range(1, 80):
            system = make(**{parameter: value * (1 + 1e-4 * i)})
            begin = time.process_time()
            hj.find_limit_cycle(system, cycle)
            calls.append(time.process_time() - begin)
        seconds[f"{name}.first"] = calls[1]
        seconds[f"{name}.compiling"] = max(calls)
        seconds[f"{name}.later"] = min(calls[-4:])
    return seconds


def in_program() -> dict[str, float]:
    """CPU seconds of a gradient by nine parameters inside of `jit`, after the cycle was found."""
    return gradient_inside(multiplied_factors)


def in_program_quick() -> dict[str, float]:
    """The same by XLA's older generator of code (docs/how-to/speed-up.md)."""
    return gradient_inside(multiplied_factors, xla_cpu_use_fusion_emitters=False)


def linearized() -> dict[str, float]:
    """The same of the matrices between eight sections."""
    return gradient_inside(multiplied_matrices)


def linearized_quick() -> dict[str, float]:
    """The same by XLA's older generator of code."""
    return gradient_inside(multiplied_matrices, xla_cpu_use_fusion_emitters=False)


def multiplied_factors(cycle):
    """The monodromy matrix of the cycle."""
    import jax.numpy as jnp

    return jnp.linalg.multi_dot(list(cycle.factors[::-1]))


def multiplied_matrices(cycle):
    """The same on sections of a clock."""
    import jax.numpy as jnp

    import hybridjax as hj

    sections = hj.ClockPhase(8, anchor=hj.Crossing("vM", "falling"))
    model = hj.linearize(cycle, sections, outputs=("yM", "vM"))
    return jnp.linalg.multi_dot(list(model.A[::-1]))


def gradient_inside(monodromy: Callable, **options: object) -> dict[str, float]:
    """CPU seconds of the gradient of a number of a hopper's cycle by its nine parameters.

    **Arguments:** `options`: of the compiler.
    """
    import equinox as eqx
    import jax
    import jax.numpy as jnp

    import hybridjax as hj

    hj.enable_x64()
    hopper = hj.models.VerticalHopper()
    cycle = hj.find_limit_cycle(hopper)

    def square(system):
        """Of the sum of the multipliers, which has derivatives where two of them meet, too."""
        found = hj.find_limit_cycle(system, cycle)
        return jnp.trace(monodromy(found)) ** 2

    gradient = eqx.filter_jit(eqx.filter_grad(square), compiler_options=options or None)
    return twice(
        gradient=lambda: jax.block_until_ready(gradient(hopper)), repeat=REPEAT
    )


def neurons() -> dict[str, float]:
    """CPU seconds of the cycles of 50 x 50 neurons, after that of one was found."""
    return plane("neurons")


def bucks() -> dict[str, float]:
    """The same of buck converters."""
    return plane("bucks")


def compasses() -> dict[str, float]:
    """The same of compass walkers."""
    return plane("compasses")


def plane(name: str) -> dict[str, float]:
    """CPU seconds of the cycles of 50 x 50 systems, after that of one, and the share found."""
    import equinox as eqx

    import hybridjax as hj

    hj.enable_x64()
    model, axes = PLANES[name]
    make = getattr(hj.models, model)
    many = eqx.filter_vmap(lambda *values: make(**dict(zip(axes, values, strict=True))))
    systems = many(*map(np.ravel, np.meshgrid(*axes.values())))
    cycle = hj.find_limit_cycle(make())
    found = {}

    def find():
        found["cycles"] = hj.orbits.find_limit_cycles(systems, cycle)

    seconds = twice(find_limit_cycles=find, repeat=REPEAT)
    return seconds | {"found": float(found["cycles"].ok.mean())}


def responses() -> dict[str, float]:
    """CPU seconds of first responses, after the cycle was found, and of HTFs again."""
    import hybridjax as hj

    hj.enable_x64()
    hopper, seconds = hj.find_limit_cycle(hj.models.VerticalHopper()), {}
    neuron, f = (
        hj.find_limit_cycle(hj.models.FitzHughNagumo()),
        np.linspace(0.013, 9.987, 620),
    )
    htf = lambda: hopper.htf(f, range(-2, 3), ("yM", "vM"))  # noqa: E731
    jobs = {"hopper": hopper.responses, "neuron": neuron.responses, "htf_first": htf}
    for name, job in (jobs | {f"htf_again_{k}": htf for k in range(30)}).items():
        begin = time.process_time()
        job()
        seconds[name] = time.process_time() - begin
    again = [seconds.pop(f"htf_again_{k}") for k in range(30)]
    return seconds | {"htf_again": min(again)}


def diffeqsolve() -> float:
    """CPU seconds of the yardstick."""
    import diffrax
    import jax
    import jax.numpy as jnp
    import optimistix as optx

    import hybridjax as hj

    hj.enable_x64()
    hopper = hj.models.VerticalHopper()
    flight, u = hopper.charts()["flight"], jnp.zeros(1)
    term = diffrax.ODETerm(lambda t, q, _: jnp.stack(flight.field(t, q, u)))
    newton = optx.Newton(rtol=1e-10, atol=1e-10)
    touchdown = diffrax.Event(lambda t, y, args, **_: y[2], newton)
    start = jnp.array([2.0, 1.9, 0.0, 0.5])
    begin = time.process_time()
    found = diffrax.diffeqsolve(
        term,
        diffrax.Dopri8(),
        0.0,
        1.0,
        0.01,
        start,
        stepsize_controller=diffrax.PIDController(rtol=1e-10, atol=1e-10),
        saveat=diffrax.SaveAt(t1=True),
        event=touchdown,
    )
    jax.block_until_ready(found.ys)
    return time.process_time() - begin


def main(model: str, family: str, folder: str | None) -> None:
    cores = one_thread.unpin(CORES)
    import jax
    import jax.monitoring

    import hybridjax as hj
    from hybridjax.experiments import run as batched

    hj.enable_x64()
    hj.scale.enable_compilation_cache()
    from . import problems  # noqa: F401  (imports count as such)

    if folder is None:
        print(json.dumps({"cores": cores, **first_calls(model, family)}))
        return
    if folder == "thoroughly":
        batched._LARGE = 0  # more is not needed for a job to wait
        print(json.dumps(first_calls(model, family)))
        return
    pathlib.Path(folder).mkdir()
    jax.config.update("jax_dump_ir_to", folder)
    seen = {"jaxpr_trace": [], "backend_compile": []}

    def listen(event, *_, fun_name="", **__):
        for name, functions in seen.items():
            if name in event:
                functions.append(fun_name)

    first_calls(model, family)
    jax.monitoring.register_event_duration_secs_listener(listen)
    first_calls(model, family)
    same = {name: len(functions) for name, functions in seen.items()}
    again = first_calls(model, family, 1)
    texts = [x.read_text() for x in pathlib.Path(folder).iterdir() if x.is_file()]
    callbacks = [x for x in texts if re.search(r"custom_call.*callback", x)]
    found = {
        # Calls of JAX outside of compiled programs trace small functions at every call.
        "same_value.traces": same["jaxpr_trace"],
        "same_value.compilations": same["backend_compile"],
        "another_value.traces": len(seen["jaxpr_trace"]) - same["jaxpr_trace"],
        "another_value.traced": " ".join(seen["jaxpr_trace"][same["jaxpr_trace"] :]),
        "another_value.compilations": len(seen["backend_compile"])
        - same["backend_compile"],
        "programs": len(texts),
        "programs_with_callbacks": len(callbacks),
    }
    found |= {f"another_value.{name}": value for name, value in again.items()}
    print(json.dumps(found))


if __name__ == "__main__":
    if sys.argv[1] in ("diffeqsolve", *JOBS):
        print(json.dumps(globals()[sys.argv[1]]()))
    else:
        main(*sys.argv[1:3], sys.argv[3] if len(sys.argv) > 3 else None)
