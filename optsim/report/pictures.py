"""Display images, as pure functions from arrays to 8-bit images; none is ever scored."""

from __future__ import annotations

import numpy as np
from pydantic import Field

from optsim.core.config import Part
from optsim.core.quantities import Bools, Bytes, Doubles, Floats, Words
from optsim.core.units import REC709_Y
from optsim.optics.srgb import linear_to_srgb, srgb_to_linear
from optsim.report.schema import LegendEntry

Colour = tuple[int, int, int]

# From too dark to too bright; the viewer has the same (template/viewer_data.js).
_STOPS = ("#08306b", "#2f74c0", "#a9cbe8", "#f4f3ef", "#f2b08c", "#cc4c2d", "#6e1414")
_UNKNOWN = ("#8a8a8a", "#707070")
_SATURATED = "#ff7a1a"


def exposed(luminance_cd_m2: Floats, white_cd_m2: float) -> Bytes:
    """Convert luminance to display values, 0..255, by sRGB's transfer curve; ``white_cd_m2`` is white."""
    share = np.clip(luminance_cd_m2 / white_cd_m2, 0, 1)
    curve = np.where(share <= 0.0031308, 12.92 * share, 1.055 * share ** (1 / 2.4) - 0.055)
    return np.rint(255 * curve).astype(np.uint8)


class ToneCurve(Part):
    """One curve for all pictures of a page: mu-law, v = ln(1 + L / knee) / ln(1 + peak / knee).

    Parameters
    ----------
    knee_cd_m2
        Luminance around which the curve changes from linear to logarithmic.
    peak_cd_m2
        Luminance displayed as white; mu is peak / knee.
    """

    knee_cd_m2: float = Field(gt=0)
    peak_cd_m2: float = Field(gt=0)

    def apply(self, luminance_cd_m2: Floats) -> Bytes:
        """Convert luminance to display values, 0..255, for an sRGB screen without further conversion."""
        scaled = np.log1p(np.clip(luminance_cd_m2, 0, self.peak_cd_m2) / self.knee_cd_m2)
        return np.rint(255 * scaled / np.log1p(self.peak_cd_m2 / self.knee_cd_m2)).astype(np.uint8)


def tone_curve_for(reference_cd_m2: Floats) -> ToneCurve:
    """Fix the curve from the truth alone: white at its 99.9th percentile, knee at a tenth of its 5th.

    A rule of this project; no outside source.
    """
    low, high = (float(q) for q in np.percentile(reference_cd_m2, (5, 99.9)))
    peak = max(high, 1e-6)
    return ToneCurve(knee_cd_m2=max(low / 10, peak * 1e-7), peak_cd_m2=peak)


def rgb(grey: Bytes) -> Bytes:
    """Three equal channels, (v, u, 3)."""
    return np.repeat(grey[..., None], 3, axis=2)


def by_logarithm(light: Floats) -> Bytes:
    """Draw radiance of an unknown range: brightness by the logarithm, from its 2nd to its 99.5th percentile.

    Parameters
    ----------
    light : ndarray of shape (y, x, 1) or (y, x, 3)
        One band, or linear sRGB.

    Returns
    -------
    ndarray of shape (y, x, 3), uint8
    """
    image = light[..., 0].astype(np.float64) if light.shape[-1] == 1 else light @ np.array(REC709_Y)
    low, high = (float(end) for end in np.percentile(image, (2, 99.5)))
    low = max(low, high * 1e-3, 1e-12)
    share = np.log(np.maximum(image, low) / low) / max(np.log(max(high, low * 1.01) / low), 1e-9)
    grey = np.rint(255 * np.clip(share, 0, 1)).astype(np.uint8)
    return rgb(grey) if light.shape[-1] == 1 else tinted(light, grey)


def tinted(light: Floats | Doubles, grey: Bytes) -> Bytes:
    """Give a grey picture the colours of light, which keep its brightness where the screen can show them.

    Parameters
    ----------
    light : ndarray of shape (y, x, 3)
        Linear sRGB, in any unit.
    grey : ndarray of shape (y, x), uint8
        How bright it is to be, sRGB.

    Returns
    -------
    ndarray of shape (y, x, 3), uint8
    """
    positive = np.maximum(light, 0).astype(np.float64)
    luminance = positive @ np.array(REC709_Y)
    share = positive / np.maximum(luminance, 1e-30)[..., None]
    shown = np.clip(share * srgb_to_linear(grey[..., None] / 255), 0, 1)
    return np.rint(255 * linear_to_srgb(shown)).astype(np.uint8)


def enlarge(image: Bytes, factor: int) -> Bytes:
    """Repeat each pixel ``factor`` times along both axes, without interpolation."""
    return image.repeat(factor, axis=0).repeat(factor, axis=1)


def error_picture(
    estimate_cd_m2: Floats, reference_cd_m2: Floats, valid: Bools, *, e_cd_m2: float, limit_stops: float
) -> Bytes:
    """Signed error in stops, log2((t + e) / (r + e)), in false colour; a chequer where nothing is valid."""
    ratio = (np.maximum(estimate_cd_m2, 0) + e_cd_m2) / (np.maximum(reference_cd_m2, 0) + e_cd_m2)
    position = np.clip(np.log2(ratio) / (2 * limit_stops) + 0.5, 0, 1)
    return _chequered(ramp(_STOPS, position), valid)


def binned(dn: Words, by: int) -> Words:
    """Average squares of ``by`` x ``by`` pixels; a rest at the lower and right edge is left out."""
    rows, cols = (side // by for side in dn.shape)
    squares = dn[: rows * by, : cols * by].reshape(rows, by, cols, by)
    return np.rint(squares.mean(axis=(1, 3))).astype(np.uint16)


def captured_picture(dn: Words, saturation_dn: float) -> Bytes:
    """Raw CCD frame with gamma 1/2.2 up to saturation; saturated pixels in orange. Shape (y, x, 3)."""
    share = np.clip(dn / saturation_dn, 0, 1)
    out = rgb(np.rint(255 * share ** (1 / 2.2)).astype(np.uint8))
    out[dn >= saturation_dn] = _channels(_SATURATED)
    return out


def captured_legend() -> list[LegendEntry]:
    """Colours of :func:`captured_picture`."""
    return [LegendEntry(colour=_SATURATED, meaning="saturated")]


def _channels(colour: str) -> Colour:
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)


def ramp(anchors: tuple[str, ...], position: Doubles | Floats) -> Bytes:
    """Colours at positions 0..1 between evenly spaced anchors."""
    table = np.asarray([_channels(anchor) for anchor in anchors], np.float64)
    at = np.linspace(0, 1, len(anchors))
    channels = [np.interp(position, at, table[:, c]) for c in range(3)]
    return np.rint(np.stack(channels, axis=-1)).astype(np.uint8)


def _chequered(image: Bytes, valid: Bools) -> Bytes:
    v, u = np.indices(valid.shape)
    odd = (v // 2 + u // 2) % 2 == 1
    image[~valid & odd] = _channels(_UNKNOWN[0])
    image[~valid & ~odd] = _channels(_UNKNOWN[1])
    return image
