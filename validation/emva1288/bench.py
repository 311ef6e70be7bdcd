"""The bench of EMVA 1288: a uniform lamp at many levels before a simulated sensor, images to files.

Constant exposure time, varied irradiation: pairs in the dark and at 52 levels up to 4 % above the full well
for the photon-transfer curve, and stacks in the dark and at half of the saturation capacity for the fixed
patterns. Light enters as radiant exposure, through the camera's own step from energy to electrons, so that
the quantum efficiency, the pixel's area and the photon's energy are under test too.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import tifffile
from scipy import constants

from optsim.camera.camera import CodedCamera
from optsim.camera.hardware import prototype
from optsim.camera.parts import Ccd

ROWS, COLS = 600, 800
STACK = 50
# Of the full well. Two per cent apart: closer levels differ by less than the noise of their variance, and
# the package, which looks for the peak from the bright end, then stops at the first bump. No more than two
# levels of read noise alone above the well, for the same reason.
LEVELS = np.arange(1, 53) * 0.02
_WAVELENGTH_M = 550e-9


def camera_of(sensor: Ccd, serial_number: int) -> CodedCamera:
    """Return the prototype with a region of interest of a sensor; only its last plane is used."""
    region = sensor.model_copy(update={"rows": ROWS, "cols": COLS})
    return prototype().model_copy(update={"sensor": region, "serial_number": serial_number})


def take_bench(
    folder: Path,
    camera: CodedCamera,
    photons: np.ndarray,
    spatial_photons: float,
    pixel_area_m2: float,
    seed: int,
) -> Path:
    """Write a bench's images and its descriptor, and return the descriptor's path.

    Parameters
    ----------
    folder : Path
        Where to.
    camera : CodedCamera
        With the sensor on the bench.
    photons : ndarray of shape (level,)
        Photons a pixel in an exposure, of each pair.
    spatial_photons : float
        The same, of the bright stack.
    pixel_area_m2 : float
        That the laboratory takes from the data sheet to set the lamp.
    seed : int
        Of all shot and read noise.
    """
    exposure_ns = camera.exposure_s * 1e9
    lines = ["v 4.0", f"n {camera.sensor.bits} {COLS} {ROWS}"]
    streams = iter(np.random.default_rng([seed, 1288]).spawn(2 * (1 + len(photons)) + 2 * STACK))
    sets = [(0.0, 2), *((p, 2) for p in photons), (0.0, STACK), (spatial_photons, STACK)]
    for number, (level, frames) in enumerate(sets):
        lines.append(f"b {exposure_ns:.1f} {level:.6f}" if level else f"d {exposure_ns:.1f}")
        expected = _expected_electrons(camera, level, pixel_area_m2)
        for k in range(frames):
            image, _ = camera.sensor.digitise(
                expected, camera.exposure_s, camera.serial_number, next(streams)
            )
            name = f"{number:02d}_{k:02d}.tif"
            tifffile.imwrite(folder / name, image)
            lines.append(f"i {name}")
    descriptor = folder / "bench.txt"
    descriptor.write_text("\n".join(lines) + "\n")
    return descriptor


def _expected_electrons(camera: CodedCamera, photons: float, pixel_area_m2: float) -> np.ndarray:
    joules = photons * constants.h * constants.c / _WAVELENGTH_M
    energy_j_m2 = np.full((ROWS, COLS), joules / pixel_area_m2)
    return camera.photon_electrons(energy_j_m2) + camera.dark_e
