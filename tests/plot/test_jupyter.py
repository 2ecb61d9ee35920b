"""What a notebook shows, in a real kernel: every figure once, also the user's own, with enough
points; and nothing in the end of what long calls say."""

import base64
import struct

import nbclient
import nbformat
import pytest

from hybridjax.plot.look import COLUMN


CELLS = [
    "import hybridjax as hj",
    "hj.plot.multipliers([0.5, 0.2j])",
    "plot = hj.plot.multipliers([0.5, 0.2j])",
    "from matplotlib import pyplot\nlines = pyplot.plot([1, 2])",
    "import time\nfrom hybridjax._core import progress\nprogress._DELAY = 0.0",
    "with progress.working('long call'):\n    time.sleep(0.3)\nprint('result')",
]


@pytest.fixture(scope="module")
def outputs():
    """Of each cell."""
    notebook = nbformat.v4.new_notebook()
    notebook.cells = [nbformat.v4.new_code_cell(cell) for cell in CELLS]
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("MPLBACKEND", raising=False)  # the kernel sets its own
        nbclient.NotebookClient(notebook, timeout=120, kernel_name="python3").execute()
    return [cell.outputs for cell in notebook.cells]


def images(cell):
    return [x.data["image/png"] for x in cell if "image/png" in x.get("data", {})]


def test_every_figure_is_shown_once(outputs):
    counts = [len(images(cell)) for cell in outputs[:4]]
    assert counts == [0, 1, 1, 1]


def test_a_column_has_150_points_per_inch(outputs):
    head = base64.b64decode(images(outputs[1])[0])[
        16:20
    ]  # of a PNG: where its width is
    width = struct.unpack(">I", head)[0]
    assert width > 0.9 * 150 * COLUMN


def test_what_a_long_call_says_is_gone_when_it_ends(outputs):
    line, text = outputs[5]
    assert line.output_type == "display_data"
    assert line.data == {}
    assert text.name == "stdout"
    assert text.text == "result\n"
