"""What is compiled: users' functions, and programs with a name, but no single operations."""

import contextlib
import re

import jax
import numpy as np
import pytest

import hybridjax as hj
from hybridjax._core import compilation

from ..conftest import APEX, OUTPUTS


# Sections, experiments and periods of which no other test has as many: single operations would be
# compiled for their shapes.
SECTIONS, EXPERIMENTS, PERIODS = 7, 3, 5
FAMILY = hj.KinematicPhase(SECTIONS, "yM", "vM", (1.9, 0.0), (0.3, 1.9), anchor=APEX)
# Kernels, programs (those that are kept have names of their own), and what JAX is asked about
# itself.
# Then the hopper's period, which is 2 pi over a parameter.
NAMED = {"run", "program", "_bind_program", "_constant", "<lambda>", "true_divide"}


@contextlib.contextmanager
def compiled():
    """The names of all that is compiled in this context."""
    names = set()

    def listen(event, *_, fun_name="", **__):
        if "backend_compile" in event:
            names.add(re.sub(r"^jit\(|_[0-9a-f]{32}|\)$", "", fun_name))

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        yield names
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)


@pytest.mark.slow
def test_no_operation_outside_of_programs_compiles_one(monkeypatch):
    # (However much the host has done in tests before.)
    monkeypatch.setattr(compilation, "WORTH_COMPILING", np.inf)
    u = np.full((EXPERIMENTS, PERIODS * SECTIONS, 1), 1e-3)
    with compiled() as names:
        cycle = hj.find_limit_cycle(hj.models.VerticalHopper(k=10.5))
        model = hj.linearize(cycle, FAMILY, OUTPUTS)
        for start in ("cycle", "periodic"):
            data = hj.run_experiments(cycle, FAMILY, u, OUTPUTS, start=start, discard=0)
        trajectory = cycle.trajectory()
        trajectory(*OUTPUTS)
        print(cycle, model, hj.place_sections(cycle, FAMILY), data, trajectory, trajectory.events)
    assert names <= NAMED
