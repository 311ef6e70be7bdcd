"""Time and peak memory of each stage of a run, as the operating system counts them."""

from __future__ import annotations

import contextlib
import resource
import time
from collections.abc import Generator
from dataclasses import dataclass, field
from pathlib import Path

_CLEAR = Path("/proc/self/clear_refs")
_STATUS = Path("/proc/self/status")


def _reset_peak() -> bool:
    """Ask the kernel to restart this process's peak; Linux only, and not under every sandbox."""
    try:
        _CLEAR.write_text("5")
    except OSError:
        return False
    return True


def _peak_mb() -> float:
    """Peak resident memory since the last reset (or since the start), MB."""
    with contextlib.suppress(OSError):
        for line in _STATUS.read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024 / 1e6
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6


@dataclass
class Stopwatch:
    """Collects wall time, processor time and peak memory a stage; the one mutable thing of a run."""

    stages: list[dict[str, object]] = field(default_factory=list[dict[str, object]])

    @contextlib.contextmanager
    def stage(self, name: str) -> Generator[None, None, None]:
        """Measure the block as one stage."""
        fresh = _reset_peak()
        wall, cpu = time.perf_counter(), time.process_time()
        yield
        self.stages.append(
            {
                "stage": name,
                "wall_s": round(time.perf_counter() - wall, 3),
                "cpu_s": round(time.process_time() - cpu, 3),
                "peak_rss_mb": round(_peak_mb(), 1),
                "peak_is_of_this_stage": fresh,
            }
        )
