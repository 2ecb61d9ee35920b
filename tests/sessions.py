"""Processes, and sessions in documents: fences of python that run one after the other, and what
they print."""

import pathlib
import re
import subprocess
import sys
import types

import numpy as np


ROOT = pathlib.Path(__file__).parents[1]
STEPS = re.compile(r"after \d+ Newton steps?")
NUMBER = re.compile(r"[+-]?\s?\d+(?:\.\d*)?(?:e[+-]?\d+)?")


def run_python(*arguments, **options) -> str:
    """What a process of its own prints."""
    command = [sys.executable, *map(str, arguments)]
    run = subprocess.run(command, capture_output=True, text=True, **options)
    assert run.returncode == 0, run.stdout + run.stderr
    return run.stdout


def blocks(page: str) -> list[tuple[str, str]]:
    """Language and text of each fence of a document."""
    return fences((ROOT / page).read_text())


def fences(text: str) -> list[tuple[str, str]]:
    """Language and content of each fence in a text."""
    return re.findall(r"^```(\w+)\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)


class Session:
    """A module in which a document's blocks are executed."""

    def __init__(self, page: str, monkeypatch):
        self.page, self.module = page, types.ModuleType(re.sub(r"\W", "_", page))
        monkeypatch.setitem(sys.modules, self.module.__name__, self.module)

    def run(self, code: str) -> None:
        exec(compile(code, self.page, "exec"), vars(self.module))


def same_output(shown: str, printed: str) -> bool:
    """The same words, and the same numbers: to 6 digits, to the last of 6 decimals or more, which
    rounding changes, or small ones to a factor of 5."""
    # (A process that has searched for long has compiled the search, which takes other steps.)
    shown, printed = (STEPS.sub("after some Newton steps", x) for x in (shown, printed))
    words = [NUMBER.sub("#", text).split() for text in (shown, printed)]
    a, b = (
        np.array([float(x.replace(" ", "")) for x in NUMBER.findall(text)])
        for text in (shown, printed)
    )
    if words[0] != words[1] or a.shape != b.shape:
        return False
    close = np.abs(a - b) <= 1e-6 * np.abs(b)
    decimals = np.array(
        [0 if "e" in x else len(x.partition(".")[2]) for x in NUMBER.findall(shown)]
    )
    last = (decimals >= 6) & (np.abs(a - b) < 1.01 * 10.0**-decimals)
    small = (np.abs(a) < 1e-3) & (np.abs(b) < 1e-3)
    rounding = (np.abs(a) < 1e-11) & (np.abs(b) < 1e-11)
    return bool(np.all(close | last | rounding | (small & (b < 5 * a) & (a < 5 * b))))
