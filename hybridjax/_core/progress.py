"""The progress line of long calls: it appears after a second and vanishes at the end.

The line is shown in terminals and in Jupyter, not in logs, pipes and tests. There a report of
progress costs next to nothing.

`working` marks a call, `counted` and `say` its step. If a line stays or is missing, look at `_keep`
(its thread) and `_is_watched` (where it is shown).
"""

import contextlib
import contextvars
import dataclasses
import io
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from typing import Any, TypeVar

from tqdm import tqdm

from .boundary.checked import checked


Item = TypeVar("Item")

# Seconds until the line appears, and between updates. Less: the line flickers in short calls. More:
# long waits without a line.
_DELAY = 1.0
_LINE = "{desc}, {elapsed}"
_COUNTED = "{desc} {bar:20} {elapsed}, {remaining} left"


@dataclasses.dataclass(eq=False)
class Call:
    """A call that is running, or a part of one."""

    name: str
    total: int | None = None
    done: int = 0
    step: str = ""
    compiling: bool = False

    def __str__(self) -> str:
        """The current step."""
        if self.total is None:
            step = self.step
        else:
            step = f"{self.done} of {self.total} {self.name}"
        return " ".join(filter(None, (step, "(compiling)" if self.compiling else "")))


# The calls that are running, each inside of the one before.
_running: list[Call] = []
_enabled: bool | None = None


@checked
def enable_progress(enabled: bool = True) -> None:
    """Print the current step of long calls to standard error, or with `False` do not print it.

    If this function is not called, steps are printed in terminals and in Jupyter only.

    **Arguments:**

    - `enabled`: whether steps are printed. Default: True.

    **Returns:** None.

    **Example:**

    ```python
    hj.scale.enable_progress(False)
    ```

    **After:** `hj.run_experiments`, `hj.sweep` and other long calls.
    """
    global _enabled
    _enabled = enabled


@contextlib.contextmanager
def working(name: str, total: int | None = None) -> Iterator[Call]:
    """While this is open a call is running, or a part of one where another is open.

    **Arguments:** `name` of the function; or of the things of which there are `total`, whose number
    `done` is for the caller to raise.
    """
    call = Call(name, total)
    outermost = not _running
    _running.append(call)
    try:
        with _line() if outermost and _is_watched() else contextlib.nullcontext():
            yield call
    finally:
        _running.remove(call)


def counted(items: Iterable[Item], name: str, total: int | None) -> Iterator[Item]:
    """Items one after the other, of which so many are done."""
    with working(name, total) as call:
        for item in items:
            yield item
            call.done += 1


def say(step: str) -> None:
    """Set the step of the innermost call."""
    if _running:
        _running[-1].step = step


def say_compiling(compiling: bool) -> None:
    """Set whether the innermost call waits for a program to be compiled."""
    if _running:
        _running[-1].compiling = compiling


def _is_watched() -> bool:
    if _enabled is None:
        return _display() is not None or sys.stderr.isatty()
    return _enabled


def _display() -> Callable[..., Any] | None:
    """IPython's `display`; `None` outside of Jupyter."""
    ipython = sys.modules.get("IPython")
    shell = None if ipython is None else ipython.get_ipython()
    if ipython is None or not hasattr(shell, "kernel"):
        return None
    return ipython.display.display


@contextlib.contextmanager
def _line() -> Iterator[None]:
    """The line, kept by a thread of its own: compiled programs let it run."""
    ended = threading.Event()
    # (In its context a kernel finds the cell to which output belongs.)
    run = contextvars.copy_context().run
    thread = threading.Thread(target=run, args=(_keep, ended), daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def _keep(ended: threading.Event) -> None:
    if ended.wait(_DELAY):
        return
    display = _display()
    file = sys.stderr if display is None else _Cell(display)
    about = {"desc": "", "bar_format": "{desc}", "leave": False, "dynamic_ncols": True}
    with tqdm(file=file, **about) as bar:
        bar.start_t -= _DELAY
        while True:
            running = list(_running)
            counted = next((call for call in running if call.total), None)
            bar.n, bar.total = (counted.done, counted.total) if counted else (0, None)
            bar.bar_format = _COUNTED if counted else _LINE
            name, *steps = [running[0].name, *filter(None, map(str, running))]
            bar.set_description_str(f"{name}: {', '.join(steps)}" if steps else name)
            if ended.wait(_DELAY):
                return


class _Cell(io.StringIO):
    """A line of a cell's output that is written over; what it leaves in the end is empty, and
    nothing is drawn for it."""

    def __init__(self, display: Callable[..., Any]):
        super().__init__()
        self._display = display
        self._handle = None
        self._shown = ""

    def write(self, text: str) -> int:
        shown = text.strip()
        data = {"text/plain": shown} if shown else {}
        if self._handle is not None and shown != self._shown:
            self._handle.update(data, raw=True)
        elif self._handle is None and shown:
            self._handle = self._display(data, raw=True, display_id=True)
        self._shown = shown
        return len(text)
