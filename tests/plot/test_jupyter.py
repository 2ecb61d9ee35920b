"""In a notebook every figure is shown once, also the user's own."""

import nbclient
import nbformat


CELLS = [
    "import hybridjax as hj",
    "hj.plot.multipliers([0.5, 0.2j])",
    "plot = hj.plot.multipliers([0.5, 0.2j])",
    "from matplotlib import pyplot\nlines = pyplot.plot([1, 2])",
]


def test_every_figure_is_shown_once(monkeypatch):
    monkeypatch.delenv("MPLBACKEND", raising=False)  # the kernel sets its own
    notebook = nbformat.v4.new_notebook()
    notebook.cells = [nbformat.v4.new_code_cell(cell) for cell in CELLS]
    nbclient.NotebookClient(notebook, timeout=120, kernel_name="python3").execute()
    images = [
        sum("image/png" in output.get("data", {}) for output in cell.outputs)
        for cell in notebook.cells
    ]
    assert images == [0, 1, 1, 1]
