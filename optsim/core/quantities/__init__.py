"""Values that cross rooms: each array has a unit, axes and dtype, and is checked once.

Axes are [row, column], pixel centres at +0.5. Their names, everywhere:

========  =====================================================================================
``t``     truth instants; an instant lasts ``slot_s / instants_per_slot``
``slot``  LCoS slots (36 a coded frame)
``v, u``  panel pixels
``y, x``  fine samples on the modulator plane (3 a panel pixel), or CCD pixels where it says so
========  =====================================================================================

Light is float32, and a negative value is an error. Only a :class:`Video` may have some: its Monte-Carlo
estimates are unbiased and may dip below zero. There negative values stay in every sum.
"""

from optsim.core.quantities.arrays import Bools, Bytes, Doubles, Floats, Ints, Words, checked
from optsim.core.quantities.frames import CodedFrame, ExposureCode, PanelState, Reconstruction
from optsim.core.quantities.passes import Ids, ObjectExtent, ObjectPose, Passes
from optsim.core.quantities.video import (
    Block,
    IrradianceVideo,
    RadianceVideo,
    Segment,
    Timing,
    Video,
    View,
)

__all__ = [
    "Block",
    "Bools",
    "Bytes",
    "CodedFrame",
    "Doubles",
    "ExposureCode",
    "Floats",
    "Ids",
    "Ints",
    "IrradianceVideo",
    "ObjectExtent",
    "ObjectPose",
    "PanelState",
    "Passes",
    "RadianceVideo",
    "Reconstruction",
    "Segment",
    "Timing",
    "Video",
    "View",
    "Words",
    "checked",
]
