"""Light from the sky: a latitude-longitude picture from a file, or a clear sky with its sun.

Both become a map of radiance. Its first row is the zenith and its last one the nadir, exactly. Its columns
run clockwise seen from above, and its middle looks to the sky's azimuth. Azimuth is counted from +x to +y.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal, cast

import numpy as np
from pydantic import Field

from optsim.core.config import Part, Table
from optsim.core.errors import ConfigError
from optsim.core.files import content_hash
from optsim.core.quantities import Doubles, Floats
from optsim.scene.bands import MONO, Band, PositiveByBand, mono, value_in
from optsim.scene.clear_sky import SUN_RADIUS_RAD, sky_radiance, sun_radiance
from optsim.scene.fields import Positive, Share
from optsim.scene.models import inside
from optsim.scene.pictures import is_linear, read_picture

# A texel is a third of the sun's disc.
_ROWS, _COLS = 1025, 2048
# Points a side of a texel where the sun's rim crosses it.
_FINE = 8


class PictureSky(Part):
    """Sky from a latitude-longitude picture, twice as wide as high, of linear light.

    Parameters
    ----------
    file : str
        OpenEXR or Radiance (``.hdr``) in the scene's folder; of a colour picture the band's channel is taken,
        or the luminance. The upper row is the zenith.
    radiance_w_m2_sr : float or dict
        Radiance of the picture's 1, or a table of it by band.
    rotation_rad : float
        Azimuth of the picture's middle column, from +x to +y.
    sampling_weight : float
        Share of light samples, as of a lamp.
    lit : bool
        Whether it emits; otherwise the sky is black.
    sha256 : str
        Hash of the file; set when the scene is read.
    """

    kind: Literal["picture"] = "picture"
    file: str = Field(exclude=True)
    radiance_w_m2_sr: PositiveByBand
    rotation_rad: float = 0.0
    sampling_weight: Positive = 1.0
    lit: bool = True
    sha256: str = ""

    @property
    def turn_rad(self) -> float:
        """Azimuth of the map's middle column."""
        return self.rotation_rad

    def radiance(self, band: Band = MONO) -> Floats:
        """Map of radiance (y, x), W m^-2 sr^-1."""
        return _read(Path(self.file), band) * np.float32(value_in(self.radiance_w_m2_sr, band))

    def dimmed(self, factor: float) -> PictureSky:
        """Return the same sky, this many times as bright."""
        return self.model_copy(update={"radiance_w_m2_sr": mono(self.radiance_w_m2_sr) * factor})


class SunSky(Part):
    """Clear sky and sun by the model of Hosek and Wilkie; below the horizon lies matt ground in their light.

    Parameters
    ----------
    irradiance_w_m2 : float or dict
        What sky and sun together give an unshadowed horizontal plane, in the band; or a table by band. The
        model decides how it is shared between sun and sky at the band's wavelength.
    azimuth_rad, elevation_rad : float
        Place of the sun: azimuth from +x to +y, and height above the horizon.
    turbidity : float
        Haze: 1 is pure air, 2 very clear, 3 clear, 6 hazy, 10 the end of the model.
    ground_albedo : float
        Reflectance of the far ground: it brightens the sky, and is seen below the horizon.
    sampling_weight, lit
        As of a picture.
    """

    kind: Literal["sunsky"] = "sunsky"
    irradiance_w_m2: PositiveByBand
    azimuth_rad: float = 0.0
    elevation_rad: float = Field(ge=0.01, le=np.pi / 2)
    turbidity: float = Field(3.0, ge=1, le=10)
    ground_albedo: Share = 0.2
    sampling_weight: Positive = 1.0
    lit: bool = True

    @property
    def turn_rad(self) -> float:
        """Azimuth of the map's middle column: the sun's."""
        return self.azimuth_rad

    def radiance(self, band: Band = MONO) -> Floats:
        """Map of radiance (y, x), W m^-2 sr^-1."""
        unit = _sunsky(self.elevation_rad, self.turbidity, self.ground_albedo, band.wavelength_nm)
        return unit * np.float32(value_in(self.irradiance_w_m2, band))

    def dimmed(self, factor: float) -> SunSky:
        """Return the same sky, this many times as bright."""
        return self.model_copy(update={"irradiance_w_m2": mono(self.irradiance_w_m2) * factor})


Sky = Annotated[PictureSky | SunSky, Field(discriminator="kind")]


def looked_up(sky: PictureSky | SunSky, directions: Doubles, band: Band) -> Doubles:
    """Radiance of a sky in some directions (..., 3) in the world, of the nearest texel."""
    image = sky.radiance(band)
    rows, cols = image.shape
    x, y, z = np.moveaxis(directions / np.linalg.norm(directions, axis=-1, keepdims=True), -1, 0)
    row = np.rint(np.arccos(np.clip(z, -1, 1)) / np.pi * (rows - 1)).astype(int)
    turns = (sky.turn_rad - np.arctan2(y, x)) / (2 * np.pi) + 0.5
    return image[row, np.floor(turns * cols).astype(int) % cols].astype(np.float64)


def irradiance(image: Floats) -> float:
    """Irradiance of a horizontal plane under a map of radiance, W m^-2."""
    zenith = np.linspace(0, np.pi, len(image))
    weight = np.maximum(np.cos(zenith), 0) * np.sin(zenith) * np.pi / (len(image) - 1)
    return float(2 * np.pi * weight @ image.mean(axis=1, dtype=np.float64))


def with_sky(table: Table, folder: Path, where: str) -> Table:
    """Table of a scene with the path and the hash of its sky's picture, which is checked."""
    sky = table.get("sky")
    if not isinstance(sky, Mapping) or cast("Table", sky).get("kind") != "picture":
        return table
    stated = cast("Table", sky)
    file = inside(folder, str(stated.get("file", "")), f"{where}: sky.file")
    _check(file, f"{where}: sky.file")
    return {**table, "sky": {**stated, "file": str(file), "sha256": content_hash(file)}}


def _check(path: Path, where: str) -> None:
    """Check a sky's picture."""
    if not is_linear(path):
        raise ConfigError(
            f"{where}: got {path.name!r}, expected OpenEXR or Radiance (.exr, .hdr); cure: convert it to .exr"
        )
    try:
        image = _read(path)
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}") from None
    rows, cols = image.shape
    if abs(cols - 2 * rows) > 1 or rows < 3:
        raise ConfigError(
            f"{where}: got {cols} x {rows} pixels, expected twice as wide as high: all directions by azimuth "
            "and latitude; cure: export the panorama as equirectangular"
        )
    if not image.any():
        raise ConfigError(f"{where}: got a black picture, expected light; cure: another file")


def _read(path: Path, band: Band = MONO) -> Floats:
    """Picture in a band, zenith first."""
    return np.ascontiguousarray(read_picture(path, band.channel)[::-1])


@functools.lru_cache(maxsize=4)
def _sunsky(elevation_rad: float, turbidity: float, ground_albedo: float, wavelength_nm: float) -> Floats:
    """Map of a clear sky and its sun, which gives a horizontal plane 1 W m^-2."""
    zenith = np.linspace(0, np.pi, _ROWS)[:, None]
    azimuth = (np.arange(_COLS) + 0.5 - _COLS / 2) * 2 * np.pi / _COLS
    above = zenith[: _ROWS // 2 + 1]
    sky = sky_radiance(
        np.maximum(np.cos(above), 0),
        _cos_sun(above, azimuth, elevation_rad),
        sun_elevation_rad=elevation_rad,
        turbidity=turbidity,
        ground_albedo=ground_albedo,
        wavelength_nm=wavelength_nm,
    )
    image = np.zeros((_ROWS, _COLS))
    image[: len(sky)] = sky
    image += sun_radiance(elevation_rad, turbidity, wavelength_nm) * _sun_cover(elevation_rad)
    image /= irradiance(image.astype(np.float32))
    image[len(sky) :] = ground_albedo / np.pi
    return image.astype(np.float32)


def _cos_sun(zenith: Doubles, azimuth: Doubles, elevation_rad: float) -> Doubles:
    return np.cos(zenith) * np.sin(elevation_rad) + np.sin(zenith) * np.cos(azimuth) * np.cos(elevation_rad)


def _sun_cover(elevation_rad: float) -> Doubles:
    """Share of each texel that the sun's disc covers, scaled so that the disc's solid angle is exact."""
    step = np.pi / (_ROWS - 1)
    reach = SUN_RADIUS_RAD + 2 * step
    cover = np.zeros((_ROWS, _COLS))
    fine = (np.arange(_FINE) + 0.5) / _FINE - 0.5
    first = max(0, int((np.pi / 2 - elevation_rad - reach) / step))
    rows = np.arange(first, min(int((np.pi / 2 - elevation_rad + reach) / step) + 2, _ROWS // 2 + 1))
    azimuth = ((np.arange(_COLS * _FINE) + 0.5) / _FINE - _COLS / 2) * 2 * np.pi / _COLS
    for row in rows:
        inside = _cos_sun((row + fine[:, None]) * step, azimuth, elevation_rad) >= np.cos(SUN_RADIUS_RAD)
        cover[row] = inside.mean(axis=0).reshape(_COLS, _FINE).mean(axis=1)
    solid = float(np.sin(np.arange(_ROWS) * step) @ cover.sum(axis=1)) * step * 2 * np.pi / _COLS
    return cover * 2 * np.pi * (1 - np.cos(SUN_RADIUS_RAD)) / solid
