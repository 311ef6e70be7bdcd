"""Freed memory stays with the process."""

import os
import platform
import subprocess
import sys

import pytest

ARRAYS = """
import resource, sys
import numpy as np
from optsim.core.memory import keep_freed_memory
if sys.argv[1] == "kept":
    keep_freed_memory()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(20):
    np.ones(1_000_000)
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="glibc's parameters")
def test_pages_of_freed_arrays_are_not_cleared_again() -> None:
    """20 arrays of 8 MB are one to the system, although dask tells its workers to give all back."""
    faults: dict[str, int] = {}
    for way in ("as dask says", "kept"):
        told = {**os.environ, "MALLOC_TRIM_THRESHOLD_": "65536"}
        shown = subprocess.run(
            [sys.executable, "-c", ARRAYS, way], env=told, capture_output=True, text=True, check=True
        )
        faults[way] = int(shown.stdout)
    # Pages have 4 KiB or more, or huge ones come in their place.
    assert faults["kept"] < faults["as dask says"] / 5
