"""Spectral bands: values that differ by band, the selection of one band, and colours of sRGB."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from typing import Annotated, Any, Literal, cast

import numpy as np
from pydantic import BaseModel, BeforeValidator, Field, TypeAdapter, WrapValidator

from optsim.core.config import Part, PartT
from optsim.core.errors import ConfigError
from optsim.core.units import REC709_Y
from optsim.optics.srgb import srgb_to_linear
from optsim.scene.fields import Positive, Share

# Wavelength of a scene without bands: the scores use the eye's photopic efficacy there.
MONO_NM = 550.0
Channel = Literal["R", "G", "B"]


class Band(Part):
    """A spectral band, narrow enough for constant properties within it.

    Parameters
    ----------
    name : str
        Letters, digits and underscores, at most 16, since it becomes a channel's name.
    wavelength_nm : float
        Centre, nm. Rendering does not use it: materials and lamps have values for the band. The camera works
        at this wavelength. The refractive index of metals and the colour of a clear sky follow it.
    channel : {"R", "G", "B"} or None
        Linear sRGB channel of pictures and colours that counts in this band. None: their luminance.
    """

    name: str = Field(pattern=r"^[A-Za-z][A-Za-z0-9_]{0,15}$")
    wavelength_nm: float = Field(ge=100, le=20_000)
    channel: Channel | None = None

    @property
    def wavelength_m(self) -> float:
        """Centre, m."""
        return self.wavelength_nm / 1e9


# Dominant wavelengths of the primaries to the white point D65, as colour-science computes them.
SRGB = (
    Band(name="R", wavelength_nm=611, channel="R"),
    Band(name="G", wavelength_nm=549, channel="G"),
    Band(name="B", wavelength_nm=464, channel="B"),
)
MONO = Band(name="mono", wavelength_nm=MONO_NM)


def _named_bands(value: object) -> object:
    if isinstance(value, str):
        if value != "srgb":
            raise ValueError('expected "srgb" or a list of bands')
        return SRGB
    return value


Bands = Annotated[tuple[Band, ...], BeforeValidator(_named_bands)]


def _linear(value: object) -> object:
    if isinstance(value, str):
        if re.fullmatch("#[0-9a-fA-F]{6}", value) is None:
            raise ValueError('expected a colour as "#rrggbb", or three linear reflectances')
        return tuple(srgb_to_linear(np.frombuffer(bytes.fromhex(value[1:]), np.uint8) / 255).tolist())
    return value


# Linear reflectances in the sRGB primaries; text as "#rrggbb" is sRGB.
Colour = Annotated[tuple[Share, Share, Share], BeforeValidator(_linear)]


def in_channel(rgb: Any, channel: Channel | None) -> Any:
    """Take a channel of linear RGB (..., 3), or its luminance."""
    return rgb @ np.array(REC709_Y) if channel is None else rgb[..., "RGB".index(channel)]


def colour_by_band(colour: tuple[float, float, float], bands: tuple[Band, ...]) -> float | dict[str, float]:
    """Reflectance of a colour in the bands of a scene, or its luminance without any."""
    table = {
        band.name: min(float(in_channel(np.asarray(colour), band.channel)), 1.0) for band in bands or (MONO,)
    }
    return table if bands else table[MONO.name]


def _number_or_table(
    number: TypeAdapter[float], table: TypeAdapter[dict[str, float]]
) -> Callable[[object, object], float | dict[str, float]]:
    def check(value: object, _: object) -> float | dict[str, float]:
        if isinstance(value, str):
            raise ValueError("expected a plain number (this key has no unit), or a table by band")
        return table.validate_python(value) if isinstance(value, Mapping) else number.validate_python(value)

    return check


# A number for all bands, or a table with one for each band.
ByBand = float | dict[str, float]
ShareByBand = Annotated[
    ByBand, WrapValidator(_number_or_table(TypeAdapter(Share), TypeAdapter(dict[str, Share])))
]
PositiveByBand = Annotated[
    ByBand, WrapValidator(_number_or_table(TypeAdapter(Positive), TypeAdapter(dict[str, Positive])))
]


def taken(part: PartT, band: str) -> PartT:
    """Copy a part, with each table by band replaced by one band's number."""
    numbers = {key: table[band] for key, table in tables(part).items()}
    return part.model_copy(update=numbers) if numbers else part


def tables(part: BaseModel) -> dict[str, dict[str, float]]:
    """Tables by band of a material, a lamp or the sky, by key."""
    found = {key: getattr(part, key, None) for key in ("reflectance", "radiance_w_m2_sr", "irradiance_w_m2")}
    return {key: cast("dict[str, float]", value) for key, value in found.items() if isinstance(value, dict)}


def value_in(value: ByBand, band: Band) -> float:
    """Return the number of a band; see :func:`mono` for a table without it."""
    return value[band.name] if isinstance(value, dict) and band.name in value else mono(value)


def mono(value: ByBand) -> float:
    """Return a number that no band changes.

    Raises
    ------
    ConfigError
        For a table by band: light is rendered one band at a time.
    """
    if isinstance(value, dict):
        raise ConfigError(
            f"bands: got values for {', '.join(value)}, but light is rendered one band at a time; cure: "
            "choose one by Scene.in_band(name), or scene.band in an experiment"
        )
    return value
