"""Memory of the C library: what is freed stays with the process, since the next array needs it again."""

from __future__ import annotations

import ctypes
import sys
from contextlib import suppress

# Numbers of the parameters in glibc's malloc.h, and the most that an int of 32 bits can say roundly.
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3
_BYTES = 1 << 30


def keep_freed_memory() -> None:
    """Let glibc keep up to 1 GiB of freed memory, and take arrays of less from it.

    Otherwise large arrays are given back and their pages are cleared again for the next one: a seventh of the
    CPU time of a decoder on a virtual machine. Dask's workers set it to give back at once, which costs a
    third. Other C libraries are left as they are.
    """
    if sys.platform != "linux":
        return
    with suppress(OSError, AttributeError):
        library = ctypes.CDLL(None)
        for parameter in (_TRIM_THRESHOLD, _MMAP_THRESHOLD):
            library.mallopt(parameter, _BYTES)
