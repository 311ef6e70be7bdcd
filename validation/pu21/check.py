"""PU21 encoding against published numbers, and against the published equation in decimals."""

from __future__ import annotations

from collections.abc import Callable
from decimal import Decimal, getcontext

import numpy as np

from optsim.metrics.pu21 import pu21_decode, pu21_encode

CLAIM = "PU21 (banding_glare) encodes 0.005 .. 10 000 cd/m^2 as its authors do, and decodes it back"
ORACLE = (
    "end points and values published with other implementations; the published equation, typed again here "
    "from the authors' code and evaluated in 40-digit decimal arithmetic; identity of encode after decode"
)
SOURCE = (
    "Mantiuk and Azimi, PCS 2021, doi:10.1109/PCS50896.2021.9477471; github.com/gfxdisp/pu21 "
    "matlab/pu21_encoder.m (equation, parameters); github.com/VQEG/siti-tools siti_tools/siti.py (end points)"
)
TOLERANCE = 6e-5
REASON = "PU units. The published end points carry four decimals, so half a unit of the last is 5e-5."
FILES = ("optsim/metrics/pu21.py",)

# VQEG siti-tools, p_min and p_max of banding_glare.
PUBLISHED = ((0.005, 5.4705e-10), (10_000.0, 595.3939))
PROBES = ("0.005", "0.02", "0.1", "1", "3.7", "10", "100", "679.55", "1000", "4000", "10000")


def published_equation(luminance: str) -> float:
    """V = p7 (((p1 + p2 Y^p4) / (1 + p3 Y^p4))^p5 - p6), in 40 digits."""
    getcontext().prec = 40
    p1, p2, p3, p4, p5, p6, p7 = map(
        Decimal,
        (
            "0.353487901",
            "0.3734658629",
            "8.277049286e-05",
            "0.9062562627",
            "0.09150303166",
            "0.9099517204",
            "596.3148142",
        ),
    )
    y = Decimal(luminance) ** p4
    return float(p7 * (((p1 + p2 * y) / (1 + p3 * y)) ** p5 - p6))


def deviation(encode: Callable[[float], object]) -> float:
    """Signed deviation of the largest magnitude, PU units."""
    errors = [float(np.asarray(encode(x))) - v for x, v in PUBLISHED]
    errors += [float(np.asarray(encode(float(x)))) - published_equation(x) for x in PROBES]
    values = np.asarray([published_equation(x) for x in PROBES])
    errors += [
        float(np.asarray(encode(float(y)))) - v for y, v in zip(pu21_decode(values), values, strict=True)
    ]
    return max(errors, key=abs)


def measure() -> float:
    return deviation(pu21_encode)


def perturbed() -> float:
    """Luminance in the wrong unit by one part in a thousand: what a forgotten factor would at least do."""
    return deviation(lambda luminance: pu21_encode(1.001 * luminance))
