"""What the bench finds of a camera, kept in the cache: measuring it again gives the same to the bit."""

from __future__ import annotations

import platform
from collections.abc import Callable
from importlib.metadata import version

import numpy as np

from optsim.calibration import Bench, Calibration, calibrate_from
from optsim.calibration.stored import calibration_arrays, calibration_of
from optsim.camera.camera import CodedCamera
from optsim.core.cache import Cache, hash_of
from optsim.core.code_hash import hash_files

_LIBRARIES = ("numpy", "scipy", "numba")


def bench_calibration(
    camera: CodedCamera, seed: int, reading_px: int, measure: Callable[[], Bench]
) -> Calibration:
    """Recall a calibration, or make it and keep it.

    Parameters
    ----------
    camera : CodedCamera
        On the bench: as planned, without neutral density.
    seed : int
        Of the laboratory's noise.
    reading_px : int
        CCD pixels to a side of the square that is read for a panel pixel.
    measure : callable
        Takes the bench's images; called only when nothing is kept.
    """
    libraries = [platform.python_version(), platform.machine(), *map(version, _LIBRARIES)]
    # Which code decides it changes more often than one remembers to list it: all of it.
    code = hash_files(["optsim/**/*.py"])
    key = hash_of("calibration", camera.model_dump(mode="json"), seed, reading_px, code, libraries)
    kept = Cache().get(key, lambda: calibration_arrays(calibrate_from(measure(), reading_px)))
    return calibration_of({name: np.array(array) for name, array in kept.items()}, f"cache entry {key}")
