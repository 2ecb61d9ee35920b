"""First calls in fresh processes on two cores, without and with a cache of compiled programs.

Seconds of the wall's clock after the import, for each call in turn: `find_limit_cycle`,
`linearize`, `run_experiments` (80 experiments, 84 cycles). `cold` begins with an empty cache,
`cached` with the one that the cold process left. A third process changes a parameter and counts
what is traced or compiled again, and looks for host callbacks in all programs.
"""

import json
import pathlib
import re
import sys
import tempfile
import time

import one_thread


CORES = 2


def run(show, options) -> None:
    from .children import call
    from .problems import HOPPER

    for _, family in HOPPER[:1] if options.quick else HOPPER:
        with tempfile.TemporaryDirectory() as cache:
            for state in ("cold", "cached"):
                for name, value in call("compile", family, HYBRIDJAX_CACHE=cache).items():
                    show(f"{family}.{state}.{name}", value)
            folder = str(pathlib.Path(cache, "programs"))
            found = call("compile", family, folder, HYBRIDJAX_CACHE=cache)
        for name, value in found.items():
            show(f"{family}.{name}", value)


def first_calls(family: str, repetition: int = 0):
    """The calls with the seconds that each takes, for a hopper with its own stiffness."""
    import hybridjax as hj

    from .problems import OUTPUTS, sections

    seconds = {}
    hopper = hj.models.VerticalHopper(k=10 + 1e-3 * repetition)
    own, outputs, design = sections("hopper", family), OUTPUTS["hopper"], hj.paper_design()

    def timed(name, work):
        begin = time.perf_counter()
        result = work()
        seconds[name] = time.perf_counter() - begin
        return result

    cycle = timed("find_limit_cycle", lambda: hj.find_limit_cycle(hopper))
    timed("linearize", lambda: hj.linearize(cycle, own, outputs))
    data = timed("run_experiments", lambda: hj.run_experiments(cycle, own, design, outputs))
    assert data.ok.all()
    return seconds


def main(family: str, folder: str | None) -> None:
    cores = one_thread.unpin(CORES)
    import jax
    import jax.monitoring

    import hybridjax as hj

    hj.enable_x64()
    hj.enable_compilation_cache()
    from . import problems  # noqa: F401  (imports count as such)

    if folder is None:
        print(json.dumps({"cores": cores, **first_calls(family)}))
        return
    pathlib.Path(folder).mkdir()
    jax.config.update("jax_dump_ir_to", folder)
    seen = {"jaxpr_trace": [], "backend_compile": []}

    def listen(event, *_, fun_name="", **__):
        for name, functions in seen.items():
            if name in event:
                functions.append(fun_name)

    first_calls(family)
    jax.monitoring.register_event_duration_secs_listener(listen)
    first_calls(family)
    same = {name: len(functions) for name, functions in seen.items()}
    again = first_calls(family, 1)
    texts = [x.read_text() for x in pathlib.Path(folder).iterdir() if x.is_file()]
    callbacks = [x for x in texts if re.search(r"custom_call.*callback", x)]
    found = {
        # Calls of JAX outside of compiled programs trace small functions at every call.
        "same_value.traces": same["jaxpr_trace"],
        "same_value.compilations": same["backend_compile"],
        "another_value.traces": len(seen["jaxpr_trace"]) - same["jaxpr_trace"],
        "another_value.traced": " ".join(seen["jaxpr_trace"][same["jaxpr_trace"] :]),
        "another_value.compilations": len(seen["backend_compile"]) - same["backend_compile"],
        "programs": len(texts),
        "programs_with_callbacks": len(callbacks),
    }
    found |= {f"another_value.{name}": value for name, value in again.items()}
    print(json.dumps(found))


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2] if len(sys.argv) > 2 else None)
