"""How costs grow with the size of a system: a chain of 1 to 32 bouncing masses (2 to 64 states, 1
to 32 guards), each in a process of its own with an empty cache of programs.

Seconds of the processor of the first call and of the same call again: the limit cycle, 16 sections
with the linear model between them, 80 experiments of 20 cycles. `MiB` is the largest memory of the
process. `exponent` is that of the power of the number of states through the last two sizes.

`apart` is the chain with a function of its own for each contact: n programs in place of one.
"""

import dataclasses
import json
import math
import resource
import sys
import tempfile
import time


MASSES = (1, 2, 4, 8, 16, 32)
N, EXPERIMENTS, CYCLES = 16, 80, 20


def run(show, options) -> None:
    from .children import call

    sizes, found = MASSES[:2] if options.quick else MASSES, {}
    for contacts, some in (("together", sizes), ("apart", sizes[-1:])):
        for n in some:
            with tempfile.TemporaryDirectory() as cache:
                values = call("size", str(n), contacts, HYBRIDJAX_CACHE=cache)
            found[contacts, n] = values
            for name, value in values.items():
                show(f"{contacts}.states_{2 * n}.{name}", value)
    half, whole = sizes[-2:]
    for name, value in found["together", whole].items():
        show(f"exponent.{name}", math.log2(value / found["together", half][name]))
        show(f"apart.ratio.{name}", found["apart", whole][name] / value)


def main(n: int, contacts: str) -> None:
    import numpy as np

    import hybridjax as hj

    hj.enable_x64()
    system = (hj.models.BouncingChain if contacts == "together" else apart())(n=n)
    sections, outputs = hj.ClockPhase(N, anchor=0.02), ("y1", f"v{n}")
    u = 1e-3 * np.random.default_rng(0).standard_normal((EXPERIMENTS, CYCLES * N, 1))
    one_core, found = hj.scale.Execution(workers=1), {}

    def twice(name, work):
        for call in ("first", "again"):
            begin = time.process_time()
            result = work()
            found[f"{name}.{call}"] = time.process_time() - begin
        return result

    cycle = twice("cycle", lambda: hj.find_limit_cycle(system))
    twice("linearize", lambda: hj.linearize(cycle, sections, outputs))
    placed = hj.sections.place_sections(cycle, sections)
    experiments = lambda: hj.run_experiments(  # noqa: E731
        cycle, placed, u, outputs, discard=0, execution=one_core
    )
    data = twice("experiments", experiments)
    assert data.ok.all()
    found["MiB"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(json.dumps(found))


def apart():
    """The chain, with a function of its own for each contact."""
    import hybridjax as hj

    def own(function):
        return lambda t, q, u: function(t, q, u)

    class Apart(hj.models.BouncingChain):
        def transitions(self):
            return [
                dataclasses.replace(x, guard=own(x.guard), reset=own(x.reset))
                for x in super().transitions()
            ]

    return Apart


if __name__ == "__main__":
    main(int(sys.argv[1]), sys.argv[2])
