"""How much memory this process may still take."""

from __future__ import annotations

import resource
from contextlib import suppress
from pathlib import Path


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
