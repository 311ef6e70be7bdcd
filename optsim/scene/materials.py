"""Materials: reflection of a surface, by kind; a reflectance is a number, one for each band, or a colour."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal, cast

from pydantic import Discriminator, Field, Tag, field_validator

from optsim.core.config import Part
from optsim.core.errors import ConfigError
from optsim.scene.bands import Colour, ShareByBand
from optsim.scene.fields import Positive, Share
from optsim.scene.textures import check_texture

Roughness = Annotated[float, Field(gt=0, le=1)]


def known_texture(name: str | None) -> str | None:
    """Check a texture name while the part is built, so that the error names the key."""
    try:
        return None if name is None else check_texture(name)
    except ConfigError as error:
        raise ValueError(str(error)) from None


class Diffuse(Part):
    """Lambertian surface, both sides equal; the default kind of a material.

    Parameters
    ----------
    reflectance : float or dict
        Hemispherical reflectance in the band, or a table of it by band; multiplies the texture, if any.
    colour : str, tuple or None
        Instead: an sRGB colour such as ``"#c04020"``, or three linear reflectances for R, G and B. A band
        takes its channel of it, and of the picture; a band without a channel their luminance.
    texture : str or None
        Name in :mod:`optsim.scene.textures`.
    picture : str or None
        File in the scene's folder instead: PNG or JPEG as sRGB reflectance, OpenEXR as linear reflectance.
    normal_map : str or None
        File in the scene's folder with normals in tangent space, raw: 2 values - 1 is the direction, its x
        along the texture's u, its y along v (upwards, as in glTF). It changes what light does, and neither
        the shape nor the normals of passes.
    sha256 : str
        Hash of these files; set when the scene is read.
    tile_m : float
        Length of one texture tile along the surface, m (texture coordinates of movers count as metres).
    """

    kind: Literal["diffuse"] = "diffuse"
    reflectance: ShareByBand = 0.5
    colour: Colour | None = Field(default=None, exclude=True)
    texture: str | None = None
    picture: str | None = Field(default=None, exclude=True)
    normal_map: str | None = Field(default=None, exclude=True)
    sha256: str = ""
    tile_m: Positive = 1.0

    _known = field_validator("texture")(known_texture)


class Plastic(Part):
    """Diffuse base under a smooth or rough clear coat, both sides equal: varnish, paint, wet ground.

    The gloss is polarised if the renderer is; one model serves both (Mitsuba's ``pplastic``, after S.-H. Baek
    et al., "Simultaneous acquisition of polarimetric SVBRDF and normals", ACM TOG 37, 2018). Light reflected
    by the coat back to the base is lost. At normal incidence it returns 0.04 + 0.87 reflectance at an ior of
    1.5, so even a white base returns at most 0.91.

    Parameters
    ----------
    reflectance, colour, texture, picture, sha256, tile_m
        Properties of the base, as for :class:`Diffuse`.
    ior : float
        Refractive index of the coat.
    roughness : float
        Root mean square slope of the coat's facets (Beckmann's alpha).
    """

    kind: Literal["plastic"] = "plastic"
    reflectance: ShareByBand = 0.5
    colour: Colour | None = Field(default=None, exclude=True)
    texture: str | None = None
    picture: str | None = Field(default=None, exclude=True)
    sha256: str = ""
    tile_m: Positive = 1.0
    ior: float = Field(1.5, gt=1, le=3)
    roughness: Roughness = 0.1

    _known = field_validator("texture")(known_texture)


class Principled(Part):
    """Material of models from files: B. Burley, "Physically-based shading at Disney", SIGGRAPH 2012.

    Parameters
    ----------
    reflectance : float or dict
        Base reflectance, multiplies the picture, if any.
    colour : str, tuple or None
        Instead: as for :class:`Diffuse`.
    picture, part, sha256 : str, int, str
        Reflectance map: a picture, or the one of a part of a model; hash of all files.
    vertex_colours : bool
        Whether colours at the vertices of meshes multiply the reflectance; it is set by files that have some.
    normal_map : str or None
        As for :class:`Diffuse`.
    roughness_map, metallic_map : str or None
        Files in the scene's folder with raw numbers, 0..1, which the numbers below multiply: the green and
        the blue channel, as in glTF, or grey.
    tile_m : float
        Length of one texture tile in texture coordinates.
    roughness, metallic, opacity : float
        0..1.
    """

    kind: Literal["principled"] = "principled"
    reflectance: ShareByBand = 0.5
    colour: Colour | None = Field(default=None, exclude=True)
    picture: str | None = Field(default=None, exclude=True)
    normal_map: str | None = Field(default=None, exclude=True)
    roughness_map: str | None = Field(default=None, exclude=True)
    metallic_map: str | None = Field(default=None, exclude=True)
    part: int | None = None
    vertex_colours: bool = False
    sha256: str = ""
    tile_m: Positive = 1.0
    roughness: Roughness = 0.5
    metallic: Share = 0.0
    opacity: Share = 1.0


class Metal(Part):
    """Bare metal, both sides equal; polarised if the renderer is.

    Parameters
    ----------
    metal : str
        Chemical symbol. The complex refractive index is the measured one in the renderer's tables, at the
        wavelength of the band; in a scene without bands it is the mean over the luminous spectrum.
    roughness : float
        Root mean square slope of the facets; 0 is a mirror: lamps cannot be sampled through it, which is
        noisy.
    """

    kind: Literal["metal"] = "metal"
    metal: Literal["Ag", "Al", "Au", "Cr", "Cu", "W"] = "Al"
    roughness: Share = 0.2


class Glass(Part):
    """Clear glass.

    Lamps cannot be sampled through it, so light behind a pane is noisy: measured 18 times the variance for a
    pane in a window. Put a window's loss into the radiance of the outside instead.

    Parameters
    ----------
    ior : float
        Refractive index.
    thin : bool
        A pane without thickness on one sheet of triangles, which doesn't refract. Otherwise the surface of a
        solid; its mesh must be closed and face outward.
    """

    kind: Literal["glass"] = "glass"
    ior: float = Field(1.5, gt=1, le=3)
    thin: bool = True


def _kind_of(value: object) -> str:
    """Kind of a material, by default diffuse."""
    if isinstance(value, Mapping):
        return str(cast("Mapping[str, Any]", value).get("kind", "diffuse"))
    return str(getattr(value, "kind", "diffuse"))


Material = Annotated[
    Annotated[Diffuse, Tag("diffuse")]
    | Annotated[Plastic, Tag("plastic")]
    | Annotated[Principled, Tag("principled")]
    | Annotated[Metal, Tag("metal")]
    | Annotated[Glass, Tag("glass")],
    Discriminator(_kind_of),
]


def polarises(material: Material) -> bool:
    """Whether the renderer polarises a surface's reflection: gloss, metal and solid glass."""
    return isinstance(material, Plastic | Metal) or (isinstance(material, Glass) and not material.thin)
