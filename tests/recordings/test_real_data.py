"""The measured recordings of the notebooks are whole, and read as they were."""

import pathlib

import numpy as np


DATA = pathlib.Path(__file__).parents[2] / "notebooks/data"


def test_the_neurons_are_those_that_were_measured():
    a = np.load(DATA / "pacemaker_neurons.npz")
    assert len(a["cell6_steps"]) == 46311 and len(a["cell8_steps"]) == 51105
    assert len(a["cell8_counts"]) == 100 and a["cell8_counts"].sum() == 51105
    np.testing.assert_allclose(a["cell8_published"].mean(), 1.0258, atol=1e-4)


def test_the_runs_and_strides_are_all_there():
    a = np.load(DATA / "compass_gait_robot.npz")
    assert len(np.unique(a["run"])) == 12 and len(a["time"]) == 13788
    a = np.load(DATA / "human_walk.npz")
    assert len(a["left0"]) == 44 and len(a["left1"]) == 45 and len(a["names"]) == 6


def test_they_are_small_and_their_licenses_beside_them():
    assert sum(path.stat().st_size for path in DATA.iterdir()) < 3e6
    text = (DATA / "README.md").read_text()
    assert all(path.name in text for path in DATA.glob("*.npz")) and "CC BY 4.0" in text
