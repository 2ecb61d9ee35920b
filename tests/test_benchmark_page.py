"""The tables of docs/benchmarks.md are those of the baseline."""

import pathlib
import shutil
import subprocess
import sys


ROOT = pathlib.Path(__file__).parents[1]


def test_the_tables_are_those_of_the_baseline(tmp_path):
    page = ROOT / "docs" / "benchmarks.md"
    copy = tmp_path / page.name
    shutil.copy(page, copy)
    code = (
        "import json, pathlib, sys; from tables import fill; "
        "fill(pathlib.Path(sys.argv[1]), json.loads(pathlib.Path('baseline.json').read_text()))"
    )
    subprocess.run([sys.executable, "-c", code, str(copy)], cwd=ROOT / "benchmarks", check=True)
    assert copy.read_text() == page.read_text()
