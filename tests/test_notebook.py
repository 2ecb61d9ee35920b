"""The notebooks' sources run, and the executed notebooks belong to them."""

import json
import pathlib
import re
import sys
import types

import numpy as np
import pytest


NOTEBOOKS = pathlib.Path(__file__).parents[1] / "notebooks"
NAMES = sorted(path.stem for path in NOTEBOOKS.glob("*.ipynb"))


def cells(source):
    """The code cells of a percent-format source, without comments at their ends."""
    parts = re.split(r"^# %%(.*)$", source, flags=re.MULTILINE)[1:]
    return [
        code.strip()
        for kind, code in zip(parts[::2], parts[1::2], strict=True)
        if "markdown" not in kind
    ]


def test_every_source_was_executed():
    assert NAMES == sorted(
        path.stem for path in NOTEBOOKS.glob("*.py") if path.stem != "build"
    )


@pytest.mark.parametrize("name", NAMES)
def test_the_executed_notebook_has_the_code_of_its_source(name):
    text = (NOTEBOOKS / f"{name}.ipynb").read_text()
    notebook = json.loads(text)
    code = [
        "".join(c["source"]).strip()
        for c in notebook["cells"]
        if c["cell_type"] == "code"
    ]
    script = (NOTEBOOKS / f"{name}.py").read_text()
    assert code == cells(script)
    printed = json.dumps([c.get("outputs") for c in notebook["cells"]])
    assert "Traceback" not in printed
    assert "Warning" not in printed
    assert "stderr" not in printed


def how_to_push(found):
    assert found.study.done
    assert found.study.cycles[-1] <= found.budget
    assert found.study.fit.contains(found.cycle.multipliers, 0.999).all()


def paper(found):
    for fit in found.structured.values():
        assert fit.compare(found.cycle.multipliers).max_error < 5e-5


def strides(found):
    for fit in (found.fit, found.series):
        assert fit.contains(found.truth, 0.999).all()


def own_system(found):
    error = abs(found.slope - found.cycle.multipliers[0])
    assert error < 1e-7
    assert found.fit.compare(found.cycle.multipliers).max_error < 1e-5


def fit(found):
    assert found.fit.identifiability.rank == 5
    assert found.fit.contains(found.truth, 0.999)
    difference = found.found.multipliers - found.real.multipliers
    error = np.abs(difference).max()
    difference_before = found.guess.multipliers - found.real.multipliers
    before = np.abs(difference_before).max()
    assert error < 2e-3 < before


def play(found):
    for cycle in (found.hopper, found.wheel, found.juggler):
        assert (np.abs(cycle.multipliers) < 1).all()


def sweep(found):
    largest = np.abs(found.best.multipliers).max()
    error = abs(largest - found.winner[2])
    assert error < 1e-3


def recording(found):
    assert found.fit.contains(found.cycle.multipliers, 0.999).all()


def neurons(found):
    assert found.found.left_out > found.found.left_out_flat + 0.02
    above = found.low <= found.true
    below = found.true <= found.high
    assert np.mean(above & below) > 0.7


def responses(found):
    # The regulator follows slow changes of its reference.
    modulus = abs(found.htf[0][0, 0, 0])
    error = abs(modulus - 1)
    assert error < 0.05


def robot(found):
    low, high = found.natural.interval()[0]
    assert high - low > 0.3
    assert "feedback" in {f.cause for f in found.looked.findings}


def walking(found):
    error = abs(found.known.multipliers[0] - 0.6)
    assert error < 0.2


def population(found):
    low = found.test["low"][0]
    high = found.test["high"][0]
    second = np.mean(found.true[6:])
    difference = second - np.mean(found.true[:6])
    assert low < difference < high < 0


def in_the_loop(found):
    for fit in (found.fit, found.series):
        assert fit.contains(found.cycle.multipliers, 0.999).all()
    truth = found.controller.htf(found.frequencies).H
    held = (
        np.abs(found.loop.controller.H - truth)
        <= found.loop.controller.confidence_radius()
    )
    assert held.mean() > 0.9


def simulator(found):
    leading = found.returns.multipliers[:2]
    assert found.fit.contains(leading).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_the_notebook_runs(name, monkeypatch):
    """As it is: nearly all of the time goes into compiling, whatever the number of experiments."""
    code = (NOTEBOOKS / f"{name}.py").read_text()
    module = types.ModuleType(name)
    monkeypatch.setitem(sys.modules, module.__name__, module)
    exec(compile(code, f"{name}.py", "exec"), vars(module))
    globals()[name](module)  # the function above of the same name
