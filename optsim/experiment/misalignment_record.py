"""Misalignments for the page of a calibration: as displacements, and the screws that undo them."""

from __future__ import annotations

import math
from collections.abc import Sequence

from optsim.calibration import Bench, Calibration
from optsim.report import words
from optsim.report.calibration_page import Misaligned, Quantity


def misaligned(quantities: Sequence[Quantity], bench: Bench, found: Calibration) -> list[Misaligned]:
    """Turn the misalignments among a calibration's numbers into displacements and screws."""
    rows: list[Misaligned] = []
    for each in (q for q in quantities if q.key in found.misalignment and q.key != "ccd_per_panel_px"):
        scale, half = found.misalignment["ccd_per_panel_px"], each.interval or 0.0
        lever_px = 1 / scale if each.key.startswith("shift") else math.hypot(*found.shape) / 2
        pitch_m = bench.ccd_pitch_m
        lever_m = None if pitch_m is None else lever_px * scale * pitch_m
        rows.append(
            Misaligned(
                key=each.key,
                panel_px=each.value * lever_px,
                panel_half_px=half * lever_px,
                ccd_m=None if lever_m is None else each.value * lever_m,
                ccd_half_m=None if lever_m is None else half * lever_m,
                undo=-each.value,
                screw=_screw(each, pitch_m) if abs(each.value) > half else "none: zero is in the interval",
            )
        )
    return rows


def _screw(found: Quantity, pitch_m: float | None) -> str:
    """Say which part to move, how far and in which direction."""
    key, size, more = found.key, abs(found.value), found.value > 0
    if key.startswith("shift"):
        border = f"{'last' if more else 'first'} {'row' if key == 'shift_y_px' else 'column'}"
        amount = f"{size:.4g} CCD pixels" if pitch_m is None else words.quantity("_m", size * pitch_m)
        return f"move the CCD {amount} towards its {border}"
    if key == "rotation_rad":
        return f"turn the CCD {words.quantity(key, size)} {'' if more else 'anti'}clockwise in its picture"
    change = f"{100 * size:.3g} % {'smaller' if more == (key == 'magnification_error') else 'larger'}"
    if key == "magnification_error":
        return f"move the relay's lenses along the axis until the image is {change}"
    if key == "distortion":
        return "none: a lens's own, which the map takes out"
    line = "row" if key == "keystone_y" else "column"
    return f"tilt the panel or the CCD until the image of the last {line} is {change}"
