"""Check that the parts fit together: the panel's image on the CCD, and the loop in time."""

from __future__ import annotations

import math
from dataclasses import dataclass

from optsim.core.errors import GeometryError

# One frame of the DVI link at 60 Hz: patterns are packed three to a frame (DDWG, DVI 1.0, 1999; the panel's
# field rate of 180 Hz is the paper's).
DVI_FRAME_S = 1 / 60
# No source: common sustained rate of USB 3.0 cameras.
LINK_BYTES_S = 350e6


@dataclass(frozen=True)
class GeometryReport:
    """Position of the panel's image on the CCD; lengths in CCD pixels unless named otherwise."""

    panel_rows: int  # Panel pixels used.
    panel_cols: int
    modulator_rows: int  # Panel pixels of the whole panel.
    modulator_cols: int
    ccd_rows: int  # CCD pixels read out.
    ccd_cols: int
    ratio: float  # CCD pixels per panel pixel.
    footprint_rows_px: float  # Extent of the panel's image, with rotation, keystone and distortion.
    footprint_cols_px: float
    margin_rows_px: float  # On the narrower side; negative where the image falls off.
    margin_cols_px: float
    # Panel pixels after which the offset between pixel centres repeats; None for an integer ratio.
    moire_period_px: float | None
    largest_panel_rows: int  # Panel pixels that fit at this ratio if aligned and undistorted.
    largest_panel_cols: int
    relay_accepts: float  # Share of the light cone from the panel that passes the relay's stop.

    @property
    def fits(self) -> bool:
        """Whether every panel pixel exists and lands on the CCD."""
        return not self._problems()

    def check(self) -> None:
        """Refuse parts that don't fit, with the keys to change."""
        problems = self._problems()
        if problems:
            raise GeometryError("; ".join(problems))

    def _problems(self) -> list[str]:
        problems: list[str] = []
        rows = (self.panel_rows, self.modulator_rows, self.ccd_rows, self.margin_rows_px)
        cols = (self.panel_cols, self.modulator_cols, self.ccd_cols, self.margin_cols_px)
        for axis, (used, there, ccd, margin), largest in (
            ("rows", rows, self.largest_panel_rows),
            ("cols", cols, self.largest_panel_cols),
        ):
            if used > there:
                problems.append(f"camera.panel_{axis} = {used}: camera.modulator.{axis} has only {there}")
            if margin < -1e-6:
                problems.append(
                    f"camera.panel_{axis} = {used} at {self.ratio:.4g} CCD pixels a panel pixel needs "
                    f"{used * self.ratio:.1f} {axis} and falls {-margin:.1f} off a side of "
                    f"camera.sensor.{axis} = {ccd}; at most {largest} fit when centred and "
                    "upright: take fewer, or lower camera.relay.magnification, shift, rotation, keystone or "
                    "distortion"
                )
        return problems


def geometry_report(
    *,
    panel: tuple[int, int],
    modulator: tuple[int, int],
    ccd: tuple[int, int],
    ratio: float,
    extent_px: tuple[float, float, float, float],
    relay_accepts: float,
) -> GeometryReport:
    """Compute the position of the panel's image; pairs are (rows, columns), ``extent_px`` its four sides."""
    # A billionth of a pixel is rounding: 2.88 x 500 is 1440, without margin and without overlap.
    top, bottom, left, right = (round(side, 9) for side in extent_px)
    off = abs(ratio - round(ratio))
    return GeometryReport(
        *panel,
        *modulator,
        *ccd,
        ratio,
        round(bottom - top, 9),
        round(right - left, 9),
        min(top, ccd[0] - bottom),
        min(left, ccd[1] - right),
        1 / off if off > 1e-9 else None,
        math.floor(ccd[0] / ratio + 1e-9),
        math.floor(ccd[1] / ratio + 1e-9),
        relay_accepts,
    )


@dataclass(frozen=True)
class LatencyReport:
    """Smallest possible latency of the loop: code f may use frames up to f - ``frames``."""

    frames: int  # Coded frames.
    readout_s: float  # From the end of an exposure to the panel's next pattern, four steps.
    transfer_s: float
    computation_s: float
    display_s: float
    slack_s: float  # From the end of the exposure to the end of the period.
    period_s: float  # Of coded frames.
    keeps_up: bool  # Whether a frame is read before the next exposure ends: readout within a period.
    sources: str = (
        "readout: published table for this camera model; transfer: unsourced, 350 MB/s; "
        "computation: unsourced assumption; display: one 60 Hz DVI frame"
    )


def latency_report(
    *, readout_s: float, ccd_pixels: int, computation_s: float, period_s: float, slack_s: float
) -> LatencyReport:
    """Add up the loop's times; a latency of L frames leaves (L - 1) periods and the slack."""
    transfer_s = 2 * ccd_pixels / LINK_BYTES_S
    total = readout_s + transfer_s + computation_s + DVI_FRAME_S
    frames = 1 + max(0, math.ceil((total - slack_s) / period_s - 1e-9))
    keeps_up = readout_s <= period_s * (1 + 1e-9)
    return LatencyReport(
        frames, readout_s, transfer_s, computation_s, DVI_FRAME_S, slack_s, period_s, keeps_up
    )
