"""The collector of cyclic garbage rests inside, and is left as it was."""

import gc
import os
import threading

import pytest

from hybridjax._core.compilation.garbage_collector import uncollected


@pytest.fixture(params=(True, False))
def was_on(request):
    (gc.enable if request.param else gc.disable)()
    yield request.param
    gc.enable()


def test_nested_and_after_an_error(was_on):
    with pytest.raises(KeyError), uncollected:
        with uncollected:
            assert not gc.isenabled()
        assert not gc.isenabled()
        raise KeyError
    assert gc.isenabled() == was_on


def test_the_last_thread_that_leaves_turns_it_on(was_on):
    inside, leave = threading.Event(), threading.Event()

    def other():
        with uncollected:
            inside.set()
            leave.wait()

    thread = threading.Thread(target=other)
    with uncollected:
        thread.start()
        inside.wait()
    assert not gc.isenabled()
    leave.set()
    thread.join()
    assert gc.isenabled() == was_on


@pytest.mark.skipif(not hasattr(os, "fork"), reason="forks")
@pytest.mark.filterwarnings("ignore:.*fork.*")
def test_a_forked_process_has_its_collector_as_it_was(was_on):
    with uncollected:
        child = os.fork()
        if child == 0:  # (Without pytest's own cleaning up.)
            os._exit(0 if gc.isenabled() == was_on and uncollected.inside == 0 else 1)
        _, status = os.waitpid(child, 0)
    assert os.waitstatus_to_exitcode(status) == 0
    assert gc.isenabled() == was_on
