import numpy as np
import pytest

import hybridjax as hj


@pytest.fixture(scope="module")
def branch():
    """The juggler's, from its fold to beyond its flip."""
    return hj.continuation(hj.find_limit_cycle(hj.models.PaddleJuggler()), "A", (0.12, 0.35))


def test_stable_cycles_have_full_lines(branch):
    ax = hj.plot.branch(branch, output="v", labels={"A": "amplitude"}).ax
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("amplitude (m)", "largest v (m/s)")
    lines = [x for x in ax.get_lines() if len(x.get_xdata()) > 1]
    fold, flip = branch.points
    rows = (0, fold.index, flip.index, len(branch) - 1)
    assert [x.get_linestyle() for x in lines] == ["--", "-", "--"]
    for line, a, b in zip(lines, rows, rows[1:], strict=False):
        np.testing.assert_array_equal(line.get_xdata(), branch.values[a : b + 1])
    marks = {x.get_label(): x.get_xydata() for x in ax.get_lines() if x.get_label()[0] != "_"}
    assert set(marks) == {"fold", "flip", "stable", "unstable"}
    for point in branch.points:
        largest = np.max(branch[point.index].trajectory()("v")[1])
        np.testing.assert_allclose(marks[point.kind], [[point.value, largest]])


def test_bad_input(branch):
    with pytest.raises(hj.DefinitionError, match="the same parameter; these have \\[\\]"):
        hj.plot.branch()
    with pytest.raises(hj.DefinitionError, match="no output 'z'"):
        hj.plot.branch(branch, output="z")
