"""What long calls say while they run, in a terminal; in Jupyter see tests/plot/test_jupyter.py."""

import io
import sys
import time

import jax.numpy as jnp
import pytest

from hybridjax._core import progress


@pytest.fixture
def shown(monkeypatch):
    monkeypatch.setattr(progress, "_DELAY", 0.01)
    monkeypatch.setattr(progress, "_enabled", True)


def wait_for(capsys, text):
    """All that was written until `text` was."""
    seen = ""
    for _ in range(1000):
        seen += capsys.readouterr().err
        if text in seen:
            return seen
        time.sleep(0.01)
    raise AssertionError(f"'{text}' is not in {seen!r}")


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_a_terminal_is_watched_and_a_log_is_not(monkeypatch):
    """Without a word from the user, and the line is wiped in the end."""
    monkeypatch.setattr(progress, "_DELAY", 0.01)
    terminal = Terminal()
    log = io.StringIO()
    for file in (terminal, log):
        monkeypatch.setattr(sys, "stderr", file)
        with progress.working("call"):
            time.sleep(0.2)
    assert "call, 00:00" in terminal.getvalue()
    assert log.getvalue() == ""
    lines = terminal.getvalue().split("\r")
    assert lines[-2].strip() == ""


def test_the_outermost_call_has_the_line_and_parts_say_what_they_do(capsys, shown):
    with progress.working("outer"):
        wait_for(capsys, "outer, 00:00")
        progress.say("first step")
        wait_for(capsys, "outer: first step, 00:00")
        for k in progress.counted(range(3), "parts", 3):
            wait_for(capsys, f"{k} of 3 parts")
            with progress.working("inner"):
                progress.say("something else")
                wait_for(capsys, "something else")
    assert "inner" not in capsys.readouterr().err


def test_programs_are_said_to_be_compiled_while_they_are():
    from hybridjax._core.compilation import quick_jit

    seen = []
    with progress.working("call") as call:
        twice = quick_jit(lambda x: seen.append(str(call)) or 2 * x)
        twice(jnp.ones(2))
        assert seen == ["(compiling)"]
        assert str(call) == ""
        twice(jnp.zeros(2))
        assert len(seen) == 1
