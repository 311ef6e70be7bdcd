"""Shared by all tests: no test reads or fills the user's cache, and none copies a calibration twice."""

import os
from functools import lru_cache

import pytest

# Before numpy is loaded: threads of several tests' BLAS would wait for each other's cores, up to eight times
# as long as the work takes.
if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from optsim.experiment import calibrations


@pytest.fixture(autouse=True, scope="session")
def _own_cache(tmp_path_factory: pytest.TempPathFactory):
    """A cache of the session, so that probing the renderer happens once, not once a test."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("OPTSIM_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(autouse=True, scope="session")
def _true_calibrations_once():
    """True calibrations follow from the camera alone, and take seconds on the small panels of tests."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(calibrations, "true_calibration", lru_cache(maxsize=16)(calibrations.true_calibration))
        yield
