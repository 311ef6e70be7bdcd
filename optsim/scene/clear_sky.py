"""Radiance of the clear sky and of the sun's disc: the Hosek-Wilkie model, from Mitsuba's tables.

L. Hosek and A. Wilkie, "An analytic model for full spectral sky-dome radiance", ACM Trans. Graph. 31 (2012)
95, and "Adding a solar-radiance function to the Hosek-Wilkie skylight model", IEEE CG&A 33 (2013) 44. Mitsuba
evaluates it as its plugin ``sunsky``, which has no variant of one band, hence this evaluation of its tables.
"""

from __future__ import annotations

import functools
import struct
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from optsim.core.errors import StorageError
from optsim.core.foreign import reading
from optsim.core.quantities import Doubles

# Wavelengths of the tables, nm.
_FIRST_NM, _STEP_NM, _BANDS = 320.0, 40.0, 11
# Steps of the sun's radiance in elevation.
_SUN_STEPS = 45
# Weights of the six control points in elevation (a Bezier curve).
_BINOMIAL = np.array([1.0, 5.0, 10.0, 10.0, 5.0, 1.0])
SUN_RADIUS_RAD = float(np.radians(0.5358 / 2))
"""Radius of the sun's disc."""


def sky_radiance(
    cos_zenith: Doubles,
    cos_sun: Doubles,
    *,
    sun_elevation_rad: float,
    turbidity: float,
    ground_albedo: float,
    wavelength_nm: float,
) -> Doubles:
    """Radiance of the sky without the sun's disc, in a unit that it shares with :func:`sun_radiance`."""
    low, share = _between(wavelength_nm)
    angle = np.arccos(np.clip(cos_sun, -1, 1))
    total = np.zeros(np.broadcast(cos_zenith, cos_sun).shape)
    for band, weight in ((low, 1 - share), (low + 1, share)):
        a, b, c, d, e, f, g, i, h = _at(
            _tables()["sky_params_spec"], turbidity, ground_albedo, sun_elevation_rad
        )[band]
        mean = _at(_tables()["sky_rad_spec"], turbidity, ground_albedo, sun_elevation_rad)[band]
        around = (1 + cos_sun**2) / (1 + h**2 - 2 * h * cos_sun) ** 1.5
        horizon = 1 + a * np.exp(b / (cos_zenith + 0.01))
        glow = c + d * np.exp(e * angle) + f * cos_sun**2 + g * around + i * np.sqrt(cos_zenith)
        total += weight * mean * horizon * glow
    # The fit falls below zero in places when the sun is low.
    return np.maximum(total, 0)


def sun_radiance(sun_elevation_rad: float, turbidity: float, wavelength_nm: float) -> float:
    """Mean radiance of the sun's disc, its darker limb included."""
    low, share = _between(wavelength_nm)
    before = int(np.clip(turbidity - 1, 0, 8))
    table = _tables()["sun_rad_spec"]
    mixed = table[before] + (turbidity - 1 - before) * (table[before + 1] - table[before])
    step = min(int(np.cbrt(2 * sun_elevation_rad / np.pi) * _SUN_STEPS), _SUN_STEPS - 1)
    beyond = sun_elevation_rad - np.pi / 2 * (step / _SUN_STEPS) ** 3
    centre = mixed[step] @ beyond ** np.arange(4)
    # The mean over the disc of the cosine's n-th power is 2 / (n + 2).
    limb = _tables()["sun_ld_spec"] @ (2 / (np.arange(6) + 2))
    return float((1 - share) * centre[low] * limb[low] + share * centre[low + 1] * limb[low + 1])


def _between(wavelength_nm: float) -> tuple[int, float]:
    """Table below a wavelength, and the share of the next one."""
    place = float(np.clip((wavelength_nm - _FIRST_NM) / _STEP_NM, 0, _BANDS - 1))
    low = min(int(place), _BANDS - 2)
    return low, place - low


def _at(table: Doubles, turbidity: float, albedo: float, elevation_rad: float) -> Doubles:
    """Interpolate (turbidity, albedo, elevation, ...): linear in two, a Bezier curve in the third."""
    before = int(np.clip(turbidity - 1, 0, 8))
    mixed = table[before] + (turbidity - 1 - before) * (table[before + 1] - table[before])
    mixed = mixed[0] + albedo * (mixed[1] - mixed[0])
    x = float(np.cbrt(2 * elevation_rad / np.pi))
    powers = np.arange(6)
    weights: Doubles = _BINOMIAL * x**powers * (1 - x) ** (5 - powers)
    return np.einsum("i,i...", weights, mixed)


@functools.cache
def _tables() -> dict[str, Doubles]:
    """Read the doubles of Mitsuba's tensor file: a directory of names, shapes and offsets comes first."""
    found = find_spec("mitsuba")
    if found is None or found.origin is None:
        raise StorageError(
            "the sky's tables come with mitsuba, which is not installed; cure: pip install mitsuba"
        )
    path = Path(found.origin).parent / "data" / "sunsky" / "sunsky_datasets.bin"
    tables: dict[str, Doubles] = {}
    with reading(path, "Mitsuba's tables of the sky", "install the mitsuba version that optsim states"):
        content = path.read_bytes()
        (count,) = struct.unpack_from("<I", content, 14)
        place = 18
        for _ in range(count):
            (length,) = struct.unpack_from("<H", content, place)
            name = content[place + 2 : place + 2 + length].decode()
            place += 2 + length
            n_axes, _kind, offset = struct.unpack_from("<HBQ", content, place)
            shape = struct.unpack_from(f"<{n_axes}Q", content, place + 11)
            place += 11 + 8 * n_axes
            size = int(np.prod(shape))
            tables[name] = np.frombuffer(content, "<f8", size, offset).reshape(shape)
    return tables
