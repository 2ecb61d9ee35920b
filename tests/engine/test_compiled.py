"""What is compiled: users' functions, and programs with a name, but no single operations."""

import numpy as np
import pytest

import hybridjax as hj

from ..conftest import APEX, OUTPUTS, compiled


# Sections, experiments and periods of which no other test has as many: single operations would be
# compiled for their shapes.
SECTIONS = 7
EXPERIMENTS = 3
PERIODS = 5
FAMILY = hj.KinematicPhase(SECTIONS, "yM", "vM", (1.9, 0.0), (0.3, 1.9), anchor=APEX)
# Kernels, programs (those that are kept have names of their own), and what JAX is asked about
# itself. Then the hopper's period, which is 2 pi over a parameter.
NAMED = {"run", "program", "_bind_program", "_constant", "<lambda>", "true_divide"}


@pytest.mark.slow
def test_no_operation_outside_of_programs_compiles_one():
    u = np.full((EXPERIMENTS, PERIODS * SECTIONS, 1), 1e-3)
    with compiled() as names:
        cycle = hj.find_limit_cycle(hj.models.VerticalHopper(k=10.5))
        model = hj.linearize(cycle, FAMILY, OUTPUTS)
        for start in ("cycle", "periodic"):
            data = hj.run_experiments(cycle, FAMILY, u, OUTPUTS, start=start, discard=0)
        trajectory = cycle.trajectory()
        trajectory(*OUTPUTS)
        placed = hj.sections.place_sections(cycle, FAMILY)
        print(
            cycle,
            model,
            placed,
            data,
            trajectory,
            trajectory.events,
        )
    assert names <= NAMED


def test_harmonic_transfer_functions_compile_nothing():
    ports = {"inputs": ("a", "b"), "outputs": ("a", "b")}
    f = np.arange((SECTIONS + 1) // 2)
    rng = np.random.default_rng(0)
    blocks = rng.normal(size=(4, SECTIONS, 2, 2))
    A, B, C, D = 0.1 * blocks
    model = hj.linear.LDTP(A, B, C, D, **ports)
    with compiled() as names:
        exact = model.htf(f)
        loop = model.feedback(np.eye(2)).inverse()
        size = np.ones(exact.H.shape)
        more = {"n_sections": SECTIONS, **ports}
        dof = np.full(len(f), 4.0)
        variance_dof = hj.linear.VarianceDof(dof, size)
        htf = hj.linear.HTF(
            f,
            exact.H,
            exact.harmonics,
            **more,
            variance=size,
            variance_dof=variance_dof,
        )
        loop_inverse = htf.feedback(exact).inverse()
        print(htf @ exact, loop_inverse, (htf + exact)[0], loop)
        print(htf.error(exact), htf.select(1).confidence_radius())
    assert names <= {"_constant", "stage"}
