"""A recording of a plant whose controller is at work, from files to the plant's multipliers."""

import json

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import hybridjax as hj
from hybridjax.apps.cli import main
from hybridjax.errors import FindingWarning


RATE = 100


def field(t, x, u=0.0):
    """x'' + 2 x' + (30 + 8 cos 2 pi t) x = u."""
    wave = np.cos(2 * np.pi * t)
    stiffness = 30 + 8 * wave
    acceleration = u - 2 * x[1] - stiffness * x[0]
    return np.array([x[1], acceleration])


@pytest.fixture(scope="module")
def multipliers():
    ends = [
        solve_ivp(field, (0, 1), x, rtol=1e-10, atol=1e-12).y[:, -1] for x in np.eye(2)
    ]
    return np.linalg.eigvals(np.transpose(ends))


@pytest.fixture(scope="module")
def recording():
    """300 cycles with u = r - 4 x - v, of noisy measurements, and forces that nobody measured."""
    rng = np.random.default_rng(1)
    n = 310 * RATE
    h = 1 / RATE
    command, unknown = (
        hj.experiments.random_input(311, RATE, 8.0, seed=s)[:n, 0] for s in (1, 2)
    )
    sizes = np.array([0.002, 0.01])[:, None]
    noise = sizes * rng.normal(size=(2, n))
    state = np.zeros(2)
    y = np.zeros((2, n))
    u = np.zeros(n)
    for i in range(n):
        y[:, i] = state + noise[:, i]
        x, v = y[:, i]
        u[i] = command[i] - 4 * x - v
        force = u[i] + 0.2 * unknown[i]
        begin = i * h
        for t in (begin, begin + h / 2):  # two steps of the midpoint rule
            slope = field(t, state, force)
            middle = state + h / 4 * slope
            later = t + h / 4
            state = state + h / 2 * field(later, middle, force)
    t = np.arange(n) * h
    clock = np.cos(2 * np.pi * t)
    signals = {
        "time": t,
        "clock": clock,
        "u": u,
        "r": command,
        "x": y[0] + clock,
        "v": y[1],
    }
    is_settled = t >= 10
    return {name: signal[is_settled] for name, signal in signals.items()}


@pytest.mark.slow
def test_the_plant_is_found_from_a_file(recording, multipliers, tmp_path):
    trial = str(tmp_path / "trial.npz")
    out = str(tmp_path / "o")
    np.savez(trial, **recording)
    options = (
        "--inputs u --references r --outputs x,v --crossing clock:rising --sections 16"
    )
    with pytest.warns(FindingWarning):
        arguments = ["identify", trial, *options.split(), "--out", out]
        assert not main(arguments)
    summary = json.loads((tmp_path / "o" / "summary.json").read_text())
    assert summary["references"] == ["r"]
    assert "u" in summary["inputs"]
    assert not any("feedback" in x.lower() for x in summary["warnings"])
    assert "A controller makes u" in (tmp_path / "o" / "report.html").read_text()
    fit = hj.load(tmp_path / "o" / "fit.npz")
    assert fit.contains(multipliers).all()
    assert fit.standard_errors.max() < 0.2
    data = hj.Recording(
        recording["time"], {k: x for k, x in recording.items() if k != "time"}
    )
    with pytest.raises(hj.errors.DefinitionError, match="must name other signals"):
        names = {"inputs": "u", "outputs": "x", "reference": "u"}
        hj.identify_recording(data, hj.Crossing("clock", "rising"), **names)
