"""Execute the notebooks' sources (jupytext's percent format): NAME.py becomes NAME.ipynb.

pip install jupytext nbclient ipykernel && python notebooks/build.py [NAME ...]
"""

import base64
import io
import pathlib
import sys

import jupytext
import nbclient
import nbformat
import numpy as np
from PIL import Image


HERE = pathlib.Path(__file__).resolve().parent


def build(source: pathlib.Path, target: pathlib.Path) -> None:
    notebook = jupytext.read(source)
    kernel = {"name": "python3", "display_name": "Python 3", "language": "python"}
    notebook.metadata = nbformat.from_dict({"kernelspec": kernel})
    nbclient.NotebookClient(notebook, timeout=1200, record_timing=False).execute()
    for number, cell in enumerate(notebook.cells):
        cell.id = f"cell-{number}"
        cell.metadata = {}
    codes = [cell for cell in notebook.cells if cell.cell_type == "code"]
    for count, cell in enumerate(codes, 1):
        cell.execution_count = count
        cell.outputs = [output for output in cell.outputs if output.get("data", True)]
        for output in cell.outputs:
            if "execution_count" in output:
                output.execution_count = count
            if "image/png" in output.get("data", {}):
                output.data["image/png"] = small(output.data["image/png"])
    notebook.metadata = nbformat.from_dict({"kernelspec": kernel})
    nbformat.write(notebook, target)


def small(image: str) -> str:
    """A picture of lines with a palette, in a third of the size; one of many colors as it is."""
    made = io.BytesIO()
    with Image.open(io.BytesIO(base64.b64decode(image))) as picture:
        whole = picture.convert("RGB")
    drawn = whole.quantize(128)
    error = np.subtract(whole, drawn.convert("RGB"), dtype=float)
    few = np.sqrt(np.mean(error**2)) < 2  # of 256 levels
    (drawn if few else whole).save(made, "png", optimize=True)
    return base64.b64encode(made.getvalue()).decode()


if __name__ == "__main__":
    sources = sorted(set(HERE.glob("*.py")) - {pathlib.Path(__file__).resolve()})
    for name in sys.argv[1:] or [source.stem for source in sources]:
        build(HERE / f"{name}.py", HERE / f"{name}.ipynb")
