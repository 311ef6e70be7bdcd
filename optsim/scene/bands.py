"""Spectral bands: values that differ by band, and the selection of one band."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Annotated, cast

from pydantic import BaseModel, Field, TypeAdapter, WrapValidator

from optsim.core.config import Part, PartT
from optsim.core.errors import ConfigError
from optsim.scene.fields import Positive, Share

# Wavelength of a scene without bands: the scores use the eye's photopic efficacy there.
MONO_NM = 550.0


class Band(Part):
    """A spectral band, narrow enough for constant properties within it.

    Parameters
    ----------
    name : str
        Letters, digits and underscores, at most 16, since it becomes a channel's name.
    wavelength_nm : float
        Centre, nm. Rendering does not use it: materials and lamps have values for the band. The camera works
        at this wavelength.
    """

    name: str = Field(pattern=r"^[A-Za-z][A-Za-z0-9_]{0,15}$")
    wavelength_nm: float = Field(ge=100, le=20_000)

    @property
    def wavelength_m(self) -> float:
        """Centre, m."""
        return self.wavelength_nm / 1e9


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
