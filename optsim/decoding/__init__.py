"""Decoders: coded frames -> Reconstruction, causally, from the calibration alone. One decoder a file."""

from typing import Annotated

from pydantic import Field

from optsim.decoding.average import Average
from optsim.decoding.partial_decoders import (
    GaussianMixture,
    HdrMerge,
    Interpolation,
    MotionDeblurring,
    SparseCoding,
    TotalVariation,
)
from optsim.decoding.union import Union

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
