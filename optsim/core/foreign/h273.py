"""Names for the meaning of R, G and B in files: codes of ITU-T H.273 (tables 2 and 3), and chromaticities."""

from __future__ import annotations

from collections.abc import Sequence

CURVES = {
    1: "BT.709",
    4: "gamma 2.2",
    5: "gamma 2.8",
    6: "BT.601",
    7: "SMPTE 240M",
    8: "linear",
    9: "log 100:1",
    10: "log 316:1",
    11: "xvYCC",
    12: "BT.1361",
    13: "srgb",
    14: "BT.2020 (10 bits)",
    15: "BT.2020 (12 bits)",
    16: "PQ",
    17: "SMPTE 428",
    18: "HLG",
}
PRIMARIES = {
    1: "BT.709",
    4: "BT.470 (system M)",
    5: "BT.601 (625 lines)",
    6: "BT.601 (525 lines)",
    7: "SMPTE 240M",
    8: "generic film",
    9: "BT.2020",
    10: "XYZ",
    11: "DCI-P3",
    12: "Display P3",
    22: "EBU 3213",
}

BT709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06)
"""Chromaticities of sRGB's primaries: x and y of R, of G and of B."""


def primaries_at(places: Sequence[float]) -> str:
    """Name primaries by their chromaticities: x and y of R, of G and of B."""
    same = max(abs(a - b) for a, b in zip(places, BT709, strict=True)) <= 2e-3
    return "BT.709" if same else f"primaries with red at ({places[0]:.3g}, {places[1]:.3g})"
