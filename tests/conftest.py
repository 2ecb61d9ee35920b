import pathlib

import numpy as np
import pytest

import hybridjax as hj


hj.enable_x64()

DATA = pathlib.Path(__file__).parent / "data"


@pytest.fixture(scope="session")
def reference():
    """Independent high-precision results for the paper's hopper; see tests/data/README.md."""

    def load(name):
        with np.load(DATA / f"{name}.npz") as file:
            return dict(file)

    return load
