"""Pictures on surfaces: reflectance, and maps of raw numbers (normals, roughness, share of metal)."""

from __future__ import annotations

import functools
import io
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from optsim.core.errors import ConfigError
from optsim.core.foreign import any_size, check_memory, reading
from optsim.core.foreign.exr import light_channels, only_part
from optsim.core.foreign.h273 import BT709, primaries_at
from optsim.core.foreign.png import deep_pixels, png_meaning
from optsim.core.foreign.rgbe import rgbe_pixels
from optsim.core.quantities import Doubles, Floats
from optsim.optics.srgb import srgb_to_linear
from optsim.scene.bands import Channel, in_channel

_WHAT = "a PNG, JPEG, OpenEXR or Radiance picture"
_EXR, _HDR = b"v/1\x01", (b"#?RADI", b"#?RGBE")
_CURVES = (None, "srgb", "linear")
# Share of the largest value down to which negative ones count as 0: Blender's studio lights reach 0.6 %.
_BELOW = 0.01
MAPS = ("normal_map", "roughness_map", "metallic_map")
"""Keys of a material's maps of raw numbers."""
# Channel of a map of one number; glTF 2.0 packs both into one picture. Of grey it is all the same.
_CHANNEL = {"roughness_map": 1, "metallic_map": 2}
# Grey, red, green and blue in all codes.
_RAMPS = (np.arange(256)[:, None] * [[[1, 1, 1]], [[1, 0, 0]], [[0, 1, 0]], [[0, 0, 1]]]).astype(np.uint8)
# Rows turned into light at once; and bytes a pixel, from reading to rendering (measured: 23; of normals 82).
_ROWS = 256
_PIXEL_BYTES, _NORMAL_BYTES = 32.0, 96.0
# Shortest and longest median vector of a normal map; a unit vector in 8 bits is off by at most 1 %.
_LENGTHS = (0.8, 1.2)


def read_picture(path: Path, channel: Channel | None = None) -> Floats:
    """Read a reflectance map of linear light in a channel (else luminance), row 0 at the lower edge."""
    stat = path.stat()
    return _picture(path, channel, stat.st_mtime_ns, stat.st_size)


def read_map(path: Path, key: str) -> Floats:
    """Read a map of raw numbers, 0..1, by its key: (y, x, 3) of normals, else (y, x); row 0 below."""
    stat = path.stat()
    return _map(path, key, stat.st_mtime_ns, stat.st_size)


def checked_map(values: Floats, key: str, where: str) -> Floats:
    """Check a map: (y, x, 3) of unit vectors, 2 values - 1, for normals; (y, x) of 0..1."""
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
        # Of a large map every few texels: its medians are as good.
        step = 1 + int(np.sqrt(values.size / 1e7))
        vectors = 2 * values[::step, ::step].astype(np.float64) - 1
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
    stored, table = _stored(path)
    image = np.empty(stored.shape[:2], np.float32)
    # A few rows at once: light of a whole picture in float64 would take ten times its file.
    for row in range(0, len(image), _ROWS):
        values = stored[row : row + _ROWS]
        light: Doubles = values.astype(np.float64) if table is None else table[values]
        image[row : row + _ROWS] = in_channel(light, channel) if light.shape[2] == 3 else light[..., 0]
    return np.ascontiguousarray(image[::-1])


@functools.lru_cache(maxsize=64)
def _map(path: Path, key: str, _mtime_ns: int, _size: int) -> Floats:
    stored, table = _stored(
        path, raw=True, pixel_bytes=_NORMAL_BYTES if key == "normal_map" else _PIXEL_BYTES
    )
    if key != "normal_map":
        stored = stored[..., _CHANNEL[key] if stored.shape[2] == 3 else 0]
    elif stored.shape[2] != 3:
        raise ConfigError(f"{path}: got one channel, expected red, green and blue; cure: a normal map")
    values = stored if table is None else table.astype(np.float32)[stored]
    return checked_map(np.ascontiguousarray(values[::-1], np.float32), key, str(path))


def is_linear(path: Path) -> bool:
    """Whether a picture is OpenEXR or Radiance, which hold linear light."""
    with reading(path, _WHAT), path.open("rb") as stream:
        return stream.read(6).startswith((_EXR, *_HDR))


def _stored(
    path: Path, *, raw: bool = False, pixel_bytes: float = _PIXEL_BYTES
) -> tuple[NDArray[Any], Doubles | None]:
    """Linear light, (y, x, 1 or 3), row 0 at the upper edge: codes and light of each code, or floats.

    ``raw``: numbers as stored, integers as 0..1.
    """
    if not is_linear(path):
        return _coded(path, raw, pixel_bytes)
    with path.open("rb") as stream:
        exr = stream.read(4) == _EXR
    values = _exr(path, raw) if exr else rgbe_pixels(path)
    return values if raw else _checked(values, path), None


def _checked(values: Floats, path: Path) -> Floats:
    """Refuse light below zero; barely below, as of a filter's ringing, it becomes 0 with a remark."""
    bound = _BELOW * float(values.max())
    wrong = ~(np.isfinite(values) & (values >= -bound))
    if wrong.any():
        row, col, channel = np.argwhere(wrong)[0]
        raise ConfigError(
            f"{path}: got {values[row, col, channel]} in row {row}, column {col}, expected finite values of "
            f"0 or more (those above -{_BELOW:g} times the largest count as 0); cure: repair the picture"
        )
    if values.min() < 0:
        least = -values.min() / values.max()
        warnings.warn(
            f"{path}: values below zero, by {least:.2g} of the largest at most, are taken as 0", stacklevel=2
        )
    return np.maximum(values, 0)


def _exr(path: Path, raw: bool) -> Floats:
    part = only_part(path, "write one part a file")
    channels, names = part.pixels(path), light_channels(part.stored)
    if not names:
        raise ConfigError(
            f"{path}: got the channels {', '.join(sorted(channels))}, expected R, G and B, or Y, or a single "
            "one of light; cure: write these, without a layer's name"
        )
    primaries = primaries_at(np.ravel(part.header.get("chromaticities", BT709))[:6].tolist())
    if len(names) == 3 and primaries != "BT.709" and not raw:
        raise ConfigError(f"{path}: got {primaries}, expected BT.709 (sRGB); cure: convert it to linear sRGB")
    _check_opaque(channels.get("A", np.ones(1)), path)
    return np.stack([channels[name] for name in names], axis=-1, dtype=np.float32, casting="same_kind")


def _check_opaque(alpha: NDArray[Any], path: Path, whole: float = 1.0) -> None:
    if not alpha.min() >= whole * (1 - 1e-3):
        raise ConfigError(
            f"{path}: got alpha down to {alpha.min() / whole:.3g}, expected an opaque picture; cure: flatten "
            "it, or take a model (.glb), whose materials may have cut-outs"
        )


def _coded(path: Path, raw: bool, pixel_bytes: float) -> tuple[NDArray[Any], Doubles]:
    """Codes (y, x, 1 or 3) of PNG or JPEG, and what each code means."""
    from PIL import Image, ImageCms

    with reading(path, _WHAT), any_size(), Image.open(path, formats=("PNG", "JPEG")) as picture:
        size = f"{picture.width} x {picture.height} pixels take"
        needed = pixel_bytes * picture.width * picture.height
        check_memory(path, needed, _WHAT, said=size, cure="a smaller picture, or more memory")
        # First of all: other questions load the pixels.
        mode, stored = picture.mode, str(picture.tile[0].args)
        deep = "16" in stored or mode.startswith("I")
        curve, primaries = png_meaning(path) if picture.format == "PNG" else (None, None)
        turned = picture.getexif().get(274, 1)
        moving = picture.format == "PNG" and getattr(picture, "is_animated", False)
        clear = picture.has_transparency_data
        profile = None if raw or curve is not None else picture.info.get("icc_profile")
        if profile is not None:
            profile = ImageCms.ImageCmsProfile(io.BytesIO(profile))
            # What it does to greys and primaries counts: linear ones, too, are called sRGB.
            if np.abs(_by_profile(Image.fromarray(_RAMPS), profile) / 255 - _RAMPS / 255).max() < 0.01:
                profile = None
        wrong = {
            f"EXIF orientation {turned}": turned != 1,
            "an animation": moving,
            f"colours of kind {mode}": mode not in ("1", "L", "LA", "P", "RGB", "RGBA", "I", "I;16"),
            "16 bits with transparency": deep and clear and not stored.startswith("RGBA"),
            "16 bits with a colour profile": deep and profile is not None,
            "colours with a profile of greys": _of_greys(profile) and mode not in ("1", "L", "LA"),
            f"the curve {curve}": not raw and curve not in _CURVES and not str(curve).startswith("gamma "),
            f"{primaries}": not raw and primaries not in (None, "BT.709"),
        }
        if any(wrong.values()):
            got = ", ".join(name for name, bad in wrong.items() if bad)
            raise ConfigError(
                f"{path}: got {got}, expected one upright grey or sRGB picture; cure: convert it to sRGB and "
                "write it so"
            )
        if clear:
            _check_opaque(np.asarray(picture.convert("RGBA").getchannel("A")), path, 255)
        if deep:
            codes = np.atleast_3d(
                deep_pixels(path, picture)[..., :3] if mode[0] == "R" else np.asarray(picture)
            )
        elif profile is not None:
            codes = _by_profile(picture, profile)
        else:
            codes = np.asarray(picture.convert("RGB"))
    shares = np.arange(65536) / 65535 if deep else np.arange(256) / 255
    if raw or curve == "linear":
        return codes, shares
    exponent = str(curve).partition("gamma ")[2]
    return codes, shares ** float(exponent) if exponent else srgb_to_linear(shares)


def _of_greys(profile: Any) -> bool:
    return profile is not None and profile.profile.xcolor_space.strip() == "GRAY"


def _by_profile(picture: Any, profile: Any) -> NDArray[np.uint8]:
    """Codes of a picture of 8 bits in sRGB, (y, x, 3)."""
    from PIL import ImageCms

    cms: Any = ImageCms
    plain = picture.convert("L" if _of_greys(profile) else "RGB")
    seen = cms.profileToProfile(plain, profile, cms.createProfile("sRGB"), outputMode="RGB")
    return np.asarray(seen)
