"""Python's collector of cyclic garbage rests while programs are traced.

Tracing makes hundreds of thousands of objects that live until the program is compiled, and the
collector would look at all of them again and again. Without it, the first limit cycle of a process
takes an eighth less time (2.35 instead of 2.69 s of CPU, where the compiled program is found on
disk).

The collector belongs to the whole process, so this is done with care: it goes on after an error as
after success; it rests until the last of several threads is done, and what contexts are nested does
not matter; a process that is forked in the meantime begins with its collector as it was before. A
program that switches the collector itself while another thread is inside has the last word only
after that thread has left. Garbage is kept for as long as tracing takes, seconds.
"""

import gc
import os
import threading


class _Uncollected:
    """A context; it may be entered by several threads at the same time, and again inside of itself.

    The collector goes on, if it was on, when the last of them leaves.
    """

    def __init__(self):
        self.lock, self.inside, self.was_on = threading.Lock(), 0, False
        if hasattr(os, "register_at_fork"):
            os.register_at_fork(after_in_child=self._begin_in_child)

    def __enter__(self):
        with self.lock:
            if self.inside == 0:
                self.was_on = gc.isenabled()
                gc.disable()
            self.inside += 1

    def __exit__(self, *_):
        with self.lock:
            if self.inside == 1 and self.was_on:
                gc.enable()
            self.inside = max(self.inside - 1, 0)

    def _begin_in_child(self):
        """A forked process has none of the other threads; one of them may have held the lock."""
        if self.inside and self.was_on:
            gc.enable()
        self.lock, self.inside = threading.Lock(), 0


uncollected = _Uncollected()
