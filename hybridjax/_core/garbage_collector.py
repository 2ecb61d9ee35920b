"""Python's collector of cyclic garbage rests while programs are traced.

Tracing makes hundreds of thousands of objects that live until the program is compiled, and the
collector would look at all of them again and again: a fifth of the time of a first call whose
compiled program is found on disk.
"""

import gc
import threading


class _Uncollected:
    """A context; it may be entered by several threads at the same time, and again inside of itself.

    The collector goes on, if it was on, when the last of them leaves.
    """

    def __init__(self):
        self.lock, self.inside, self.was_on = threading.Lock(), 0, False

    def __enter__(self):
        with self.lock:
            if self.inside == 0:
                self.was_on = gc.isenabled()
                gc.disable()
            self.inside += 1

    def __exit__(self, *_):
        with self.lock:
            self.inside -= 1
            if self.inside == 0 and self.was_on:
                gc.enable()


uncollected = _Uncollected()
