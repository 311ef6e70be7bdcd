"""Bench calibration of a camera, kept in the cache: a repeated measurement gives the same bits."""

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
    """Read a calibration from the cache, or make and store it.

    Parameters
    ----------
    camera : CodedCamera
        Camera on the bench: as planned, without neutral density.
    seed : int
        Seed of the laboratory's noise.
    reading_px : int
        Side of the readout window, CCD pixels.
    measure : callable
        Takes the bench's images; called only when the cache has no entry.
    """
    libraries = [platform.python_version(), platform.machine(), *map(version, _LIBRARIES)]
    # Hash all code: a list of the modules that matter would soon be out of date.
    code = hash_files(["optsim/**/*.py"])
    key = hash_of("calibration", camera.model_dump(mode="json"), seed, reading_px, code, libraries)
    kept = Cache().get(key, lambda: calibration_arrays(calibrate_from(measure(), reading_px)))
    return calibration_of({name: np.array(array) for name, array in kept.items()}, f"cache entry {key}")
