"""Decoders: coded frames -> Reconstruction, causally, from the calibration alone. One decoder a file."""

from typing import Annotated

from pydantic import Field

from optsim.reconstruct.average import Average
from optsim.reconstruct.branches import (
    GaussianMixture,
    HdrMerge,
    Interpolation,
    MotionDeblurring,
    SparseCoding,
    TotalVariation,
)
from optsim.reconstruct.union import Union

ALL = (
    HdrMerge,
    SparseCoding,
    GaussianMixture,
    Average,
    Interpolation,
    TotalVariation,
    MotionDeblurring,
    Union,
)
Decoder = Annotated[
    HdrMerge
    | SparseCoding
    | GaussianMixture
    | Average
    | Interpolation
    | TotalVariation
    | MotionDeblurring
    | Union,
    Field(discriminator="kind"),
]

__all__ = [
    "ALL",
    "Average",
    "Decoder",
    "GaussianMixture",
    "HdrMerge",
    "Interpolation",
    "MotionDeblurring",
    "SparseCoding",
    "TotalVariation",
    "Union",
]
