"""Pictures on surfaces: reflectance, and maps of raw numbers (normals, roughness, share of metal)."""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np

from optsim.core.errors import ConfigError
from optsim.core.foreign import reading
from optsim.core.foreign.rgbe import rgbe_pixels
from optsim.core.quantities import Doubles, Floats
from optsim.optics.srgb import srgb_to_linear
from optsim.scene.bands import Channel, in_channel

LINEAR = (".exr", ".hdr")
"""Suffixes of pictures of linear light: OpenEXR and Radiance."""
MAPS = ("normal_map", "roughness_map", "metallic_map")
"""Keys of a material's maps of raw numbers."""
# Channel of a map of one number; glTF 2.0 packs both into one picture. Of grey it is all the same.
_CHANNEL = {"roughness_map": 1, "metallic_map": 2}
# Shortest and longest median vector of a normal map; a unit vector in 8 bits is off by at most 1 %.
_LENGTHS = (0.8, 1.2)


def read_picture(path: Path, channel: Channel | None = None) -> Floats:
    """Read a reflectance map: PNG and JPEG as sRGB, OpenEXR and Radiance as linear; row 0 at the lower edge.

    Without a channel it is that of the luminance.

    Raises
    ------
    StorageError
        For a file that is no such picture.
    """
    stat = path.stat()
    return _picture(path, channel, stat.st_mtime_ns, stat.st_size)


def read_map(path: Path, key: str) -> Floats:
    """Read a map of raw numbers, 0..1: no transfer function; row 0 at the lower edge.

    Parameters
    ----------
    path : Path
        PNG, JPEG or OpenEXR.
    key : str
        One of :data:`MAPS`: of a normal map all three channels (y, x, 3), of roughness the green, of metal
        the blue one (y, x), as in glTF.

    Raises
    ------
    ConfigError
        For values outside of 0..1, or a normal map that has no unit vectors.
    StorageError
        For a file that is no such picture.
    """
    stat = path.stat()
    return _map(path, key, stat.st_mtime_ns, stat.st_size)


def checked_map(values: Floats, key: str, where: str) -> Floats:
    """Check a map: (y, x, 3) of unit vectors, 2 values - 1, for normals; (y, x) of 0..1.

    Raises
    ------
    ConfigError
        With the first pixel that is wrong, counted from the picture's upper left.
    """
    flat = values if values.ndim == 2 else values.max(axis=2)
    # So written, NaN is wrong too.
    inside = np.logical_and(flat <= 1, (values if values.ndim == 2 else values.min(axis=2)) >= 0)
    wrong = np.logical_not(inside)
    if wrong.any():
        row, col = np.argwhere(wrong[::-1])[0]
        raise ConfigError(
            f"{where}: got {flat[::-1][row, col]:g} in row {row}, column {col}, expected 0 to 1; "
            "cure: write the map anew"
        )
    if key == "normal_map":
        vectors = 2 * values.astype(np.float64) - 1
        length = float(np.median(np.linalg.norm(vectors, axis=2)))
        ahead = float(np.median(vectors[..., 2]))
        if not (_LENGTHS[0] < length < _LENGTHS[1] and ahead > 0):
            raise ConfigError(
                f"{where}: got vectors of length {length:.2f}, {ahead:.2f} along the normal (medians), "
                "expected about 1 and more than 0; cure: a normal map in tangent space, mostly light blue"
            )
    return values


@functools.lru_cache(maxsize=64)
def _picture(path: Path, channel: Channel | None, _mtime_ns: int, _size: int) -> Floats:
    values = _values(path)
    if path.suffix.lower() not in LINEAR:
        values = srgb_to_linear(values)
    image = in_channel(values, channel) if values.shape[2] == 3 else values[..., 0]
    return np.ascontiguousarray(image[::-1], np.float32)


@functools.lru_cache(maxsize=64)
def _map(path: Path, key: str, _mtime_ns: int, _size: int) -> Floats:
    values = _values(path)
    if key != "normal_map":
        values = values[..., _CHANNEL[key] if values.shape[2] == 3 else 0]
    elif values.shape[2] != 3:
        raise ConfigError(f"{path}: got one channel, expected red, green and blue; cure: a normal map")
    return checked_map(np.ascontiguousarray(values[::-1], np.float32), key, str(path))


def _values(path: Path) -> Doubles:
    """Values as stored, (y, x, 1 or 3), row 0 at the upper edge; of 8 or 16 bits over their largest."""
    if path.suffix.lower() == ".exr":
        from optsim.core.files import read_exr

        channels, _ = read_exr(path)
        names = [name for name in ("R", "G", "B") if name in channels]
        chosen = names if len(names) == 3 else list(channels)[:1]
        return np.stack([channels[name] for name in chosen], axis=-1).astype(np.float64)
    if path.suffix.lower() == ".hdr":
        return rgbe_pixels(path).astype(np.float64)
    from PIL import Image

    with reading(path, "a PNG, JPEG, OpenEXR or Radiance picture"), Image.open(path) as picture:
        if picture.mode.startswith("I"):
            # Pillow would clip grey of 16 bits at 255.
            return np.asarray(picture, np.float64)[..., None] / 65535
        return np.asarray(picture.convert("RGB"), np.float64) / 255
