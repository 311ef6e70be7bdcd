"""Display images, as pure functions from arrays to 8-bit images; none is ever scored."""

from __future__ import annotations

from typing import cast

import numpy as np
from pydantic import Field

from optsim.core.config import Part
from optsim.core.quantities import Bools, Bytes, Doubles, Floats, Words
from optsim.report.schema import ColourScale, LegendEntry
from optsim.report.words import number

Colour = tuple[int, int, int]

_STOPS = ("#08306b", "#2f74c0", "#a9cbe8", "#f4f3ef", "#f2b08c", "#cc4c2d", "#6e1414")
_TIME = ("#221150", "#5f187f", "#b2357b", "#f1605d", "#feae77", "#fcf3bd")
_HIT, _MISS, _ALARM = "#12a683", "#e0457b", "#f2b632"
_UNKNOWN = ("#8a8a8a", "#707070")
_SATURATED = "#ff7a1a"


class ToneCurve(Part):
    """One curve for all images of a run: mu-law, v = ln(1 + L / knee) / ln(1 + peak / knee).

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

    @property
    def caption(self) -> str:
        """The curve and its parameters, in words."""
        return (
            f"mu-law tone curve, knee {number(self.knee_cd_m2)} cd/m², white {number(self.peak_cd_m2)} cd/m²"
        )


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


def enlarge(image: Bytes, factor: int) -> Bytes:
    """Repeat each pixel ``factor`` times along both axes, without interpolation."""
    return image.repeat(factor, axis=0).repeat(factor, axis=1)


def error_picture(
    estimate_cd_m2: Floats, reference_cd_m2: Floats, valid: Bools, *, e_cd_m2: float, limit_stops: float
) -> Bytes:
    """Signed error in stops, log2((t + e) / (r + e)), in false colour; a chequer where nothing is valid.

    Parameters
    ----------
    estimate_cd_m2, reference_cd_m2 : ndarray of shape (v, u), float32
        Luminance, cd/m^2.
    valid : ndarray of shape (v, u), bool
        False where the decoder has no information.
    e_cd_m2 : float
        Luminance below which errors fade out.
    limit_stops : float
        Error at the ends of the colour bar.
    """
    ratio = (np.maximum(estimate_cd_m2, 0) + e_cd_m2) / (np.maximum(reference_cd_m2, 0) + e_cd_m2)
    position = np.clip(np.log2(ratio) / (2 * limit_stops) + 0.5, 0, 1)
    return _chequered(ramp(_STOPS, position), valid)


def error_scale(limit_stops: float) -> ColourScale:
    """Colour bar of :func:`error_picture`."""
    half = limit_stops / 2
    ticks = [f"≤ −{limit_stops:g}", f"−{half:g}", "0", f"+{half:g}", f"≥ +{limit_stops:g}"]
    return ColourScale(colours=list(_STOPS), ticks=ticks, unit="stops: too dark … too bright")


def start_picture(levels: Bytes) -> Bytes:
    """Slot in which each pixel of a code (slot, v, u) first opens, in colour; a chequer if it never does."""
    opened = levels > 0
    first = cast("Doubles", np.argmax(opened, axis=0) / max(len(levels) - 1, 1))
    return _chequered(ramp(_TIME, first), cast("Bools", opened.any(axis=0)))


def start_scale(slots: int) -> ColourScale:
    """Colour bar of :func:`start_picture`."""
    ticks = [str(round(share * (slots - 1))) for share in (0, 0.25, 0.5, 0.75, 1)]
    return ColourScale(colours=list(_TIME), ticks=ticks, unit="slot of first opening")


def mask_picture(mask: Bools, oracle: Bools, background: Bytes) -> Bytes:
    """Motion mask against the oracle: three colours over a dimmed grey image of shape (v, u)."""
    out = rgb((background // 3 + 20).astype(np.uint8))
    for where, colour in ((mask & oracle, _HIT), (~mask & oracle, _MISS), (mask & ~oracle, _ALARM)):
        tint = np.asarray(_channels(colour), np.float64)
        out[where] = np.rint(0.8 * tint + 0.2 * background[where][:, None]).astype(np.uint8)
    return out


def mask_legend() -> list[LegendEntry]:
    """Colours of :func:`mask_picture`."""
    return [
        LegendEntry(colour=_HIT, meaning="hit: moves, coded as moving"),
        LegendEntry(colour=_MISS, meaning="miss: moves, coded as static"),
        LegendEntry(colour=_ALARM, meaning="false alarm: static, coded as moving"),
        LegendEntry(colour="#4a4a4a", meaning="static, coded as static"),
    ]


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
