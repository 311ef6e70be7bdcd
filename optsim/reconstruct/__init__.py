"""Decoders: coded frames -> Reconstruction, causally, from the calibration alone. One decoder a file."""

from typing import Annotated

from pydantic import Field

from optsim.reconstruct.branches import HdrMerge, SparseCoding
from optsim.reconstruct.union import Union

ALL = (HdrMerge, SparseCoding, Union)
Decoder = Annotated[HdrMerge | SparseCoding | Union, Field(discriminator="kind")]

__all__ = ["ALL", "Decoder", "HdrMerge", "SparseCoding", "Union"]
