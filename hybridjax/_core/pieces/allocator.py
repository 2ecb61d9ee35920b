"""The allocator of memory of a Dask worker."""

import contextlib
import ctypes


# Options of mallopt, and bytes up to which what is freed is kept. Doubled: a worker holds up to
# twice as much that it does not use.
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3
_KEPT = 2**28


def keep_freed_memory() -> None:
    """Use memory again rather than give it back after each array: the system would fill every page
    with zeros again, a fifth of the time of a sweep.

    Dask's nanny starts workers with MALLOC_TRIM_THRESHOLD_ = 65536, which does that. Where the C
    library is not glibc's nothing happens.
    """
    with contextlib.suppress(AttributeError, OSError):
        library = ctypes.CDLL(None)
        library.mallopt(_MMAP_THRESHOLD, _KEPT)
        library.mallopt(_TRIM_THRESHOLD, _KEPT)
