"""What designs of several files are for: six sections, two inputs and two outputs."""

import pytest

import hybridjax as hj


NOISE = {"y0": 0.01, "y1": 0.02}


@pytest.fixture(scope="module")
def model():
    return hj.testing.synthetic_ldtp()


@pytest.fixture(scope="module")
def usual(model):
    return hj.multisine(6, 32, band=(0, 3), inputs=model.inputs)
