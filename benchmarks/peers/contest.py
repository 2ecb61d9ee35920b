"""The peers at one job, one after the other: their times, and their errors beside them."""

import math
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from job import Job

from .errors import Unavailable


class Seconds(NamedTuple):
    """Of the processor, and of the clock on the wall."""

    cpu: float
    wall: float


def measure(work: Callable[[], Any], repeat: int = 1) -> tuple[Any, Seconds]:
    """The result, and the least seconds of several calls."""
    seconds = []
    for _ in range(repeat):
        begin = time.process_time(), time.perf_counter()
        result = work()
        seconds.append((time.process_time() - begin[0], time.perf_counter() - begin[1]))
    return result, Seconds(*map(min, zip(*seconds, strict=True)))


class Contest(NamedTuple):
    """A `job` and the exact record (S, n, 2). `show(name, value)` prints. Repeats count the least
    time. `jaxonomy` is the interpreter of the environment that has it."""

    job: Job
    exact: np.ndarray
    show: Callable[[str, Any], None]
    repeat: int = 3
    jaxonomy: str | None = None

    def run(self, names) -> None:
        """Run some of the peers "scipy", "heyoka", "c", "jaxonomy"."""
        for name in names:
            try:
                {"scipy": self._scipy, "heyoka": self._heyoka, "c": self._c}.get(
                    name, self._jaxonomy
                )()
            except Unavailable as reason:
                self.show(f"{self._label(name)}.skipped", f'"{reason}"')

    def _label(self, name):
        return f"{self.job.model}.{self.job.family}.{name}"

    def _result(self, name, record, seconds: Seconds, scale: float = 1.0):
        S, n, _ = record.shape
        self.show(f"{name}.cpu", seconds.cpu * scale)
        self.show(f"{name}.wall", seconds.wall * scale)
        self.show(f"{name}.error", float(np.max(np.abs(record - self.exact[:S, :n]))))

    def _part(self, experiments, cycles=None) -> tuple[Job, float]:
        part = self.job.part(min(experiments, len(self.job.u)), cycles)
        return part, self.job.u.size / part.u.size

    def _c(self):
        from . import c_peer

        loop, compiling = measure(lambda: c_peer.setup(self.job))
        self.show(f"{self._label('c')}.compile", compiling.wall)
        for steps in c_peer.SETTINGS:
            result = measure(
                lambda steps=steps: c_peer.run(self.job, loop, steps), self.repeat
            )
            self._result(f"{self._label('c')}.steps_{steps}", *result)

    def _heyoka(self):
        from . import heyoka_peer

        S = len(self.job.u)
        for tol in heyoka_peer.SETTINGS:
            for kind, batch in {"scalar": 1, "simd": 8, "batch": min(S, 80)}.items():
                name = f"{self._label('heyoka')}.{kind}.tol_{tol:.0e}"
                ready, compiling = measure(
                    lambda t=tol, b=batch: heyoka_peer.setup(self.job, t, b)
                )
                self.show(f"{name}.compile", compiling.cpu)
                job, scale = self._part(8) if batch == 1 else (self.job, 1.0)
                result = measure(
                    lambda j=job, r=ready: heyoka_peer.run(j, r), self.repeat
                )
                self._result(name, *result, scale)

    def _scipy(self):
        from . import scipy_peer

        job, scale = self._part(1, 20)
        charts = scipy_peer.setup(job)
        for rtol in scipy_peer.SETTINGS:
            result = measure(lambda rtol=rtol: scipy_peer.run(job, charts, rtol))
            name = f"{self._label('scipy')}.rtol_{rtol:.0e}"
            self.show(f"{name}.scaled_by", scale)
            self._result(name, *result, scale)

    def _jaxonomy(self):
        from . import jaxonomy_peer

        if self.jaxonomy is None:
            raise Unavailable("no interpreter is named that has it")
        job, scale = self._part(8)
        for rtol in jaxonomy_peer.SETTINGS:
            out = jaxonomy_peer.run(job, self.jaxonomy, rtol)
            name = f"{self._label('jaxonomy')}.rtol_{rtol:.0e}"
            self.show(f"{name}.compile", out.compile_cpu)
            self.show(f"{name}.scaled_by", scale)
            self._result(name, out.record, Seconds(out.run_cpu, out.run_wall), scale)


def jacobians(job: Job, exact: np.ndarray, show, repeat: int = 20) -> None:
    """heyoka's variational equations against the exact derivatives (N, 5, 6) of the sections."""
    from . import heyoka_jacobians

    label = f"{job.model}.{job.family}.heyoka.jacobians"
    try:
        for tol in (1e-6, 1e-9):
            ready, compiling = measure(lambda tol=tol: heyoka_jacobians.setup(job, tol))
            found, seconds = measure(
                lambda ready=ready: heyoka_jacobians.run(job, ready), repeat
            )
            show(f"{label}.tol_{tol:.0e}.compile", compiling.cpu)
            show(f"{label}.tol_{tol:.0e}.cpu", seconds.cpu)
            show(f"{label}.tol_{tol:.0e}.error", float(np.max(np.abs(found - exact))))
    except Unavailable as reason:
        show(f"{label}.skipped", f'"{reason}"')


def sizes(job: Job, exact, show, counts, cycles: int) -> None:
    """Microseconds per section map in batches of several sizes: the C loop, heyoka.

    `exact` is the record of the job's first cycles (S, 32 * cycles, 2)."""
    from . import c_peer, heyoka_peer

    for count in counts:
        part = job.part(count, cycles)
        label = f"{job.model}.{job.family}.size_{count}"
        repeat = math.ceil(1000 / count)
        for name, peer, options in (
            ("c", c_peer, ()),
            ("heyoka.scalar", heyoka_peer, (1e-6, 1)),
            ("heyoka.batch", heyoka_peer, (1e-6, min(count, 80))),
        ):
            try:
                ready = peer.setup(part, *options)
                y, seconds = measure(
                    lambda p=part, r=ready, x=peer: x.run(p, r), repeat
                )
                show(f"{label}.{name}.microseconds", 1e6 * seconds.cpu / part.u.size)
                error = np.abs(y - exact[np.arange(count) % len(exact)])
                show(f"{label}.{name}.error", float(np.max(error)))
            except Unavailable as reason:
                show(f"{label}.{name}.skipped", f'"{reason}"')
