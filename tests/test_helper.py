"""A process beside this one: order, errors, its end; the same where there is only one core."""

import math
import operator
import os

import pytest

import hybridjax as hj
from hybridjax.apps import helper


@pytest.fixture(scope="module", params=[1, 2])
def beside(request):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(helper, "core_count", lambda: request.param)
        with helper.Helper("math") as process:
            yield process


def test_results_come_in_order(beside):
    beside.begin(math.sqrt, 4.0)
    beside.begin(os.getpid)
    assert beside.result() == 2.0
    assert (beside.result() == os.getpid()) == (beside._process is None)


def test_what_the_work_raises_is_raised(beside):
    with pytest.raises(ZeroDivisionError):
        beside.begin(operator.truediv, 1, 0)
        beside.result()


def test_a_process_that_ends_is_said(monkeypatch):
    monkeypatch.setattr(helper, "core_count", lambda: 2)
    with helper.Helper() as beside:
        beside.begin(os._exit, 1)
        with pytest.raises(hj.ComputationError, match="was ended from outside"):
            beside.result()
        beside._process.join()
        beside.begin(os.getpid)
        with pytest.raises(hj.ComputationError, match="run it again"):
            beside.result()
    assert not beside._process.is_alive()
