"""Processes, and sessions in documents: fences of python that run one after the other, and what
they print."""

import pathlib
import re
import subprocess
import sys
import types


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
        self.page = page
        self.module = types.ModuleType(re.sub(r"\W", "_", page))
        monkeypatch.setitem(sys.modules, self.module.__name__, self.module)

    def run(self, code: str) -> None:
        exec(compile(code, self.page, "exec"), vars(self.module))


def decimals(number: str) -> int:
    """The digits after the point, 0 with an exponent."""
    if "e" in number:
        return 0
    return len(number.partition(".")[2])


def same_output(shown: str, printed: str) -> bool:
    """The same words, and the same numbers: to 6 digits, to the last of 6 decimals or more, which
    rounding changes, or small ones to a factor of 5."""
    # (A process that has searched for long has compiled the search, which takes other steps.)
    shown = STEPS.sub("after some Newton steps", shown)
    printed = STEPS.sub("after some Newton steps", printed)
    words = NUMBER.sub("#", shown).split()
    expected = NUMBER.sub("#", printed).split()
    if words != expected:
        return False
    numbers = zip(NUMBER.findall(shown), NUMBER.findall(printed), strict=True)
    return all(same_number(a, b) for a, b in numbers)


def same_number(shown: str, printed: str) -> bool:
    a = float(shown.replace(" ", ""))
    b = float(printed.replace(" ", ""))
    difference = abs(a - b)
    if difference <= 1e-6 * abs(b):
        return True
    digits = decimals(shown)
    if digits >= 6 and difference < 1.01 * 10.0**-digits:
        return True
    if abs(a) < 1e-11 and abs(b) < 1e-11:
        return True
    is_small = abs(a) < 1e-3 and abs(b) < 1e-3
    return is_small and b < 5 * a and a < 5 * b
