"""Memory of this process: how much more it may take, and freed memory that it retains."""

from __future__ import annotations

import ctypes
import resource
import sys
from contextlib import suppress
from pathlib import Path

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


def available_bytes() -> float:
    """Memory that can be allocated, by the machine's free memory and the limits of container and process."""
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    allowed = (
        float("inf") if limit == resource.RLIM_INFINITY else limit - _kib("/proc/self/status", "VmSize:", 0)
    )
    # The container's whole limit: its usage includes cached files, which are freed on demand.
    found = [allowed, _kib("/proc/meminfo", "MemAvailable:", float("inf"))]
    for path in ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes"):
        # Absent, or "max".
        with suppress(OSError, ValueError):
            found.append(float(Path(path).read_text(encoding="ascii")))
    return max(0.0, min(found))


def _kib(path: str, key: str, otherwise: float) -> float:
    """Read a line such as "VmSize: 123 kB" as bytes."""
    with suppress(OSError):
        for line in Path(path).read_text(encoding="ascii", errors="replace").splitlines():
            if line.startswith(key):
                return 1024 * float(line.split()[1])
    return otherwise
