"""The notebook's source runs, and the executed notebook belongs to it."""

import json
import pathlib
import re
import sys
import types

import pytest
from matplotlib import pyplot


NOTEBOOKS = pathlib.Path(__file__).parents[1] / "notebooks"


def cells(source):
    """The code cells of a percent-format source, without comments at their ends."""
    parts = re.split(r"^# %%(.*)$", source, flags=re.MULTILINE)[1:]
    return [code.strip() for kind, code in zip(parts[::2], parts[1::2], strict=True)
            if "markdown" not in kind]  # fmt: skip


def test_the_executed_notebook_has_the_code_of_its_source():
    notebook = json.loads((NOTEBOOKS / "paper.ipynb").read_text())
    code = ["".join(c["source"]).strip() for c in notebook["cells"] if c["cell_type"] == "code"]
    assert code == cells((NOTEBOOKS / "paper.py").read_text())
    printed = json.dumps([c.get("outputs") for c in notebook["cells"]])
    assert "Traceback" not in printed and "Warning" not in printed and "stderr" not in printed


@pytest.mark.slow
def test_the_notebook_runs(monkeypatch):
    """As it is: nearly all of the time goes into compiling, whatever the number of experiments."""
    code = (NOTEBOOKS / "paper.py").read_text()
    module = types.ModuleType("notebook")
    monkeypatch.setitem(sys.modules, module.__name__, module)
    exec(compile(code, "paper.py", "exec"), vars(module))
    pyplot.close("all")
    for fit in module.structured.values():
        assert fit.compare(module.cycle.multipliers).max_error < 5e-5
