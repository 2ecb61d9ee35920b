"""The example of docs/how-to/scale.md runs as it stands."""

import pathlib
import re
import subprocess
import sys

import numpy as np
import pytest


PAGE = pathlib.Path(__file__).parents[1] / "docs/how-to/scale.md"


@pytest.mark.slow
def test_the_example_runs_in_processes_of_its_own(tmp_path):
    *_, script = re.findall(r"^```python\n(.*?)^```$", PAGE.read_text(), re.MULTILINE | re.DOTALL)
    (tmp_path / "script.py").write_text(script)
    run = subprocess.run(
        [sys.executable, "script.py"], cwd=tmp_path, capture_output=True, text=True, timeout=300
    )
    assert run.returncode == 0, run.stderr
    scatter, mean = (
        [complex(z) for z in part.strip(" []\n").split()] for part in run.stdout.split("around")
    )
    true = (0.6 + 0.5j) ** 4
    np.testing.assert_allclose(mean, [true, true.conjugate()], atol=1e-3)
    assert 0 < abs(scatter[0]) < 2e-3
