"""Wrong values end in a sentence of this package, at the call that was wrong."""

import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose

import hybridjax as hj
from hybridjax.recordings.sampling import without_drift


class Leaky(hj.Chart):
    states = ("v",)

    def field(self, t, q, u):
        return (1.2 - q[0] + u[0],)


class Neuron(hj.HybridSystem):
    def charts(self):
        return {"below": Leaky()}

    def transitions(self):
        def threshold(t, q, u):
            return 1 - q[0]

        def after(t, q, u):
            return (0.0,)

        return [hj.Transition("spike", "below", "below", guard=threshold, reset=after)]


def refused(match, call):
    with pytest.raises(hj.errors.DefinitionError, match=match):
        call()


@pytest.mark.parametrize(
    "call",
    [
        lambda: hj.systems.Drawing(3),
        lambda: hj.systems.Drawing([[0, 0], [1, 1]]),
        lambda: hj.systems.Drawing({1: [[0, 0], [1, 1]]}),
        lambda: hj.systems.Drawing({"leg": "x"}),
        lambda: hj.systems.Drawing({"leg": None}),
        lambda: hj.systems.Drawing({"leg": [[0, 0], [1]]}),
        lambda: hj.systems.Drawing({}, circles=3),
        lambda: hj.systems.Drawing({}, velocity="x"),
        lambda: hj.systems.Drawing({}, body=["x"]),
        lambda: hj.systems.Drawing.spring("a", (1, 2)),
        lambda: hj.systems.Drawing.spring((0, 0), (1, 2), "wide"),
        lambda: hj.systems.Drawing.spring((0, 0, 0), (1, 2, 3)),
    ],
)
def test_drawings(call):
    refused("Drawing: ", call)


@pytest.mark.parametrize("amplitude", [{}, [], "x", lambda f: {}, lambda f: f[:2]])
def test_amplitudes(amplitude):
    refused("`amplitude` must", lambda: hj.multisine(4, 8, amplitude=amplitude))


@pytest.mark.parametrize("solver", [3, [], {"below": 3}, np.zeros(3), hj.systems.Radau])
def test_solvers(solver):
    class Stiff(Leaky):
        pass

    class Other(Neuron):
        def charts(self):
            return {"below": Stiff()}

    Stiff.solver = solver
    for system in (lambda: Neuron(solver=solver), Other):
        refused(
            "a solver must be `hj.systems.Radau",
            lambda system=system: hj.find_limit_cycle(
                system(), hj.Guess("below", (0.5,))
            ),
        )


def test_sweeps_of_systems_without_parameters():
    guess = hj.Guess("below", (0.5,))
    cycle = hj.find_limit_cycle(Neuron(), guess)
    for systems in ([Neuron(), Neuron()], Neuron()):
        refused(
            "Neuron has no parameters",
            lambda x=systems: hj.orbits.find_limit_cycles(x, cycle),
        )


def test_names_that_no_file_can_have(tmp_path):
    name = tmp_path / ("n" * 300)
    htf = hj.testing.synthetic_ldtp().htf([0.1, 0.2])
    for call in (
        lambda: hj.read_recording(f"{name}.csv"),
        lambda: hj.load(f"{name}.npz"),
        lambda: hj.save(f"{name}.npz", htf),
        lambda: hj.plot.bode(htf).save(name),
    ):
        refused("cannot (read|write) .*: File name too long", call)


def test_bandwidths_and_drifts_beyond_all_records():
    time = np.arange(4000) / 100
    x = 1 + np.sin(2 * np.pi * time)
    drifting = x + 0.01 * time
    recording = hj.Recording(time, {"x": drifting})
    crossing = hj.Crossing("x", "rising", 1.2)
    phase = hj.recordings.estimate_phase(recording, crossing)
    flat = [
        without_drift(recording, phase, "x", cycles).trials[0].values
        for cycles in (1e9, 1e300)
    ]
    assert_allclose(*flat, rtol=1e-6)  # a straight line is left out
    sides = (flat[1][:, 0], x)
    slopes = (np.polyfit(time, values, 1)[0] for values in sides)
    assert_allclose(*slopes, atol=2e-4)
    refused(
        "`drift` must be two cycles or more",
        lambda: hj.experiments.SectionSeries(
            np.ones((8, 1)), np.ones((8, 1)), n_sections=4, drift=1e-20
        ),
    )


@pytest.mark.slow
def test_settings_of_jax_for_the_lines_of_users():
    """A user may forbid that JAX broadcasts and converts; lines of this package do both."""

    def results():
        cycle = hj.find_limit_cycle(hj.models.VerticalHopper())
        model = hj.linearize(cycle, hj.ClockPhase(4), outputs="yM")
        whole = hj.multisine(4, 8, (0, 1.9))
        design = whole.scaled(0.001)
        data = hj.run_experiments(cycle, hj.ClockPhase(4), design, "yM")
        estimate = hj.estimate_htf(data, harmonics=0)
        print(cycle, model, data.summary())
        return cycle.multipliers, model.htf([0.1, 0.3]).H, estimate.H

    expected = results()
    with jax.numpy_rank_promotion("raise"), jax.numpy_dtype_promotion("strict"):
        for x, y in zip(results(), expected, strict=True):
            assert_allclose(x, y, rtol=1e-9, atol=1e-12)
