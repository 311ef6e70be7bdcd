"""Surfaces of models: colour, pictures, maps and how they lie; the same for every format."""

from __future__ import annotations

import functools
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from optsim.core.errors import ConfigError
from optsim.core.foreign import any_size, reading
from optsim.core.quantities import Doubles, Floats, Ints
from optsim.optics.srgb import srgb_to_linear
from optsim.scene.geometry import Mesh
from optsim.scene.pictures import checked_map

_PICTURES = ("PNG", "JPEG", "WEBP", "BMP", "TGA", "GIF")


@dataclass(frozen=True, eq=False)
class Surface:
    """What a file says of a material; by default matt grey."""

    name: str = ""
    colour: Doubles = field(default_factory=lambda: np.full(3, 0.5))  # linear sRGB, 0..1
    picture: Floats | None = None  # (y, x, 3), linear, times the colour; row 0 of all is the lower edge
    cutout: Floats | None = None  # opacity (y, x)
    opacity: float = 1.0
    roughness: float = 1.0
    metallic: float = 0.0
    maps: Mapping[str, Floats] = field(default_factory=dict[str, Floats])  # raw, by keys of pictures.MAPS
    wrap: str = "repeat"  # or clamp, mirror: how all pictures go on beyond coordinates of 0..1
    lost: str = ""  # left out, and the user is told
    refused: str = ""  # an error if it is shown


@dataclass(frozen=True, eq=False)
class SurfacePiece:
    """Triangles of one surface as a file has them; ``colours`` (n, 3) are linear, nothing multiplies them."""

    name: str
    surface: Surface
    points: Doubles
    faces: Ints
    uv: Doubles | None = None
    colours: Floats | None = None
    node: int = -1


@dataclass(frozen=True)
class Placement:
    """How a picture lies: set of texture coordinates, matrix for (u, v up, 1), wrap modes along u and v."""

    coordinates: int = 0
    matrix: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0)
    wraps: tuple[str, str] = ("repeat", "repeat")


def laid(surface: Surface, uv: Doubles | None, places: Sequence[Placement]) -> tuple[Surface, Doubles | None]:
    """Lay the pictures of a surface on texture coordinates; all must lie alike."""
    if not places:
        return surface, uv
    if len(set(places)) > 1:
        said = "pictures that lie differently (texture coordinates, transform or wrap modes)"
        return replace(surface, refused=listed(surface.refused, f"{said}; expected one way for all")), uv
    if uv is None:
        return replace(surface, lost=listed(surface.lost, "a picture without texture coordinates")), None
    rows = np.reshape(places[0].matrix, (2, 3))
    uv = uv @ rows[:, :2].T + rows[:, 2]
    # Along an axis that stays within the picture its wrap mode doesn't count.
    wraps = places[0].wraps
    beyond = [wrap for wrap, axis in zip(wraps, uv.T, strict=True) if (abs(axis - 0.5) > 0.501).any()]
    modes = {*(beyond or wraps[:1])}
    if len(modes) > 1:
        said = f"wrap modes {' and '.join(wraps)} along u and v; expected one"
        return replace(surface, refused=listed(surface.refused, said)), uv
    return replace(surface, wrap=modes.pop()), uv


def tinted(surface: Surface, colours: Doubles | None, *, plain: bool) -> tuple[Surface, Floats | None]:
    """Combine with linear colours (n, 3) at vertices, whose mean counts beside a picture."""
    if colours is None or not len(colours):
        return surface, None
    if not np.isfinite(colours).all():
        said = "colours at vertices that are not 0 to 1, or whole to 255"
        return replace(surface, refused=listed(surface.refused, said)), None
    beyond = np.abs(colours - np.clip(colours, 0, 1)).max() > 1e-6
    colours, own = np.clip(colours, 0, 1), np.ones(3) if plain else surface.colour
    varied, lost = bool(np.ptp(colours, axis=0).max() > 1e-6), surface.lost
    lost = listed(lost, "colours at vertices beyond 0 to 1 (clipped)") if beyond else lost
    if varied and surface.picture is None:
        return replace(surface, colour=np.ones(3), lost=lost), (colours * own).astype(np.float32)
    if varied:
        lost = listed(lost, "colours at vertices beside a picture (their mean counts)")
    return replace(surface, colour=own * colours.mean(axis=0), lost=lost), None


@functools.lru_cache(maxsize=1)
def decoded(content: bytes) -> tuple[NDArray[Any], str]:
    """Read a picture by its own mark, (y, x, 4) of 8 or 16 bits, row 0 below; and what is left out of it."""
    from PIL import Image

    try:
        with any_size(), Image.open(io.BytesIO(content), formats=_PICTURES) as picture:
            turn, lost = picture.getexif().get(274, 1), ""
            if turn != 1:
                lost = f"EXIF orientation {turn} of a picture, which lies as it is stored"
            if getattr(picture, "is_animated", False):
                lost = "pictures of an animation but its first"
            if picture.mode.startswith("I"):
                # Pillow would clip grey of 16 bits at 255.
                grey = np.asarray(picture).astype(np.uint16)[::-1, :, None]
                return np.concatenate([grey, grey, grey, np.full_like(grey, 65535)], axis=2), lost
            return np.ascontiguousarray(np.asarray(picture.convert("RGBA"))[::-1]), lost
    except (OSError, SyntaxError, ValueError) as error:
        why = str(error).partition(" <_io")[0]
        raise ValueError(f"got no {', '.join(_PICTURES)}, or a damaged one: {why}") from None


def linear_colours(values: NDArray[Any]) -> Doubles:
    """Linear colours of sRGB ones, (n, 3): whole numbers to 255 or of 16 bits, or 0 to 1; NaN of others."""
    largest = float(values.max(initial=0))
    whole = values.dtype.kind in "iu" or (largest > 1 and bool((values == np.rint(values)).all()))
    most = float(np.iinfo(values.dtype).max) if values.dtype == np.uint16 else 255.0 if whole else 1.0
    if not (values.min(initial=0) >= 0 and largest <= most):
        return np.full(values.shape, np.nan)
    return srgb_to_linear(values.astype(np.float64) / most)


def with_picture(surface: Surface, key: str, content: bytes, scale: float = 1.0) -> Surface:
    """Add a picture as ``picture``, ``alpha``, ``cutout`` (alpha, else grey) or a map's key."""
    coded, lost = decoded(content)
    surface = replace(surface, lost=listed(surface.lost, lost))
    most = int(np.iinfo(coded.dtype).max)
    shares = (np.arange(most + 1) / most).astype(np.float32)
    if key == "picture":
        return replace(
            surface, picture=srgb_to_linear(shares.astype(np.float64)).astype(np.float32)[coded[..., :3]]
        )
    if key in ("alpha", "cutout"):
        clear = key == "alpha" or bool((coded[..., 3] < most).any())
        return replace(surface, cutout=shares[coded[..., 3 if clear else 1]])
    if key == "normal_map":
        vectors = checked_map(shares[coded[..., :3]], key, "the normal map") - np.float32(0.5)
        vectors *= np.array([scale, scale, 1.0], np.float32)
        length = np.linalg.norm(vectors, axis=-1, keepdims=True)
        values = vectors / np.maximum(2 * length, 1e-6) + np.float32(0.5)
    else:
        # glTF 2.0, section 3.9.2: roughness is green, metal is blue; of grey it is all the same.
        values = shares[coded[..., 1 if key == "roughness_map" else 2]]
    return replace(surface, maps={**surface.maps, key: values})


def beside(path: Path, name: str) -> Path:
    """Where a name in a file leads: as it stands, slashed, percent-decoded, or by its last part alone."""
    slashed, decoded = name.replace("\\", "/"), unquote(name).replace("\\", "/")
    last = decoded.rpartition("/")[2]
    places = [path.parent / each for each in (name, slashed, decoded, last)]
    return next((place for place in places if place.is_file()), places[2]).resolve()


def content_beside(path: Path, name: str) -> bytes:
    """Content of a file that another one names."""
    file = beside(path, name)
    if not file.is_file():
        raise ConfigError(f"{path.name} names {name!r}, but there is no such file; cure: copy it there too")
    with reading(file, "a file that a model names"):
        return file.read_bytes()


def split_by_hand(surface: Surface, mesh: Mesh) -> list[tuple[Surface, Mesh]]:
    """Split where the picture is mirrored: the renderer takes a normal map's y from its x."""
    if "normal_map" not in surface.maps:
        return [(surface, mesh)]
    corners = mesh.uv[mesh.faces]
    (across, up), (further, higher) = (corners[:, 1] - corners[:, 0]).T, (corners[:, 2] - corners[:, 0]).T
    mirrored = across * higher < up * further
    # What is mirrored has its pictures turned over, so that they look the same. Copies: they change here.
    maps = {key: image[:, ::-1].copy() for key, image in surface.maps.items()}
    maps["normal_map"][..., 0] = 1 - maps["normal_map"][..., 0]
    over = replace(
        surface,
        picture=None if surface.picture is None else np.ascontiguousarray(surface.picture[:, ::-1]),
        cutout=None if surface.cutout is None else np.ascontiguousarray(surface.cutout[:, ::-1]),
        maps=maps,
    )
    parts = [
        (surface, replace(mesh, faces=mesh.faces[~mirrored])),
        # By 1 - u, which is right for every wrap mode.
        (over, replace(mesh, faces=mesh.faces[mirrored], uv=mesh.uv * (-1, 1) + (1, 0))),
    ]
    return [part for part in parts if len(part[1].faces)]


def fault(error: Exception) -> str:
    """Text of an error without its cure."""
    return str(error).partition("; cure:")[0]


def listed(*said: str) -> str:
    """Join remarks, without empty ones and repetitions."""
    return ", ".join(dict.fromkeys(each for each in said if each))
