"""A user's statement on recorded footage, and the radiance of its stored values."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from optsim.core.config import Part
from optsim.core.errors import ConfigError, ValueCheckError
from optsim.core.quantities import Doubles
from optsim.core.units import REC709_Y
from optsim.footage.recording import RAW_COUNTS, FileStatement
from optsim.optics.srgb import srgb_to_linear

# Curves that no linearisation here inverts.
_OTHER_CURVES = ("PQ", "HLG", "log 100:1", "log 316:1", RAW_COUNTS)
# Values below the black level are read noise around a dark signal: about half, never most of a frame.
_BELOW_BLACK_SHARE = 0.6


class FootageSource(Part):
    """Truth from a recording: its files, its time base, and the conversion of stored values to radiance.

    ``signal = (value - black_level) / (full_scale - black_level)``, then the linearisation, then one
    weighted sum over colour channels, then ``scale_w_m2_sr``. Values are never rescaled by their dtype.

    Parameters
    ----------
    path : str
        A folder of images, a pattern such as ``shots/*.exr``, or one file: EXR, PNG, TIFF (also a stack),
        npz, npy, mat, or a video. Relative to the experiment's file.
    frame_rate_hz : float
        Recorded frames a second, whatever a video file states for playback. Each frame counts as the mean
        over 1 / frame_rate_hz (full shutter).
    scale_w_m2_sr : float
        Radiance of a linearised signal of 1, W m^-2 sr^-1.
    white_w_m2_sr : float
        Declared white, the peak of every PSNR, W m^-2 sr^-1.
    linearisation : str
        Conversion of stored values to light: ``linear``, ``srgb`` (IEC 61966-2-1), ``gamma`` (a power).
    gamma : float, optional
        Exponent of the curve ``gamma``: radiance goes as the signal to this power.
    full_scale : float, optional
        Stored value of a signal of 1, 65535 for all of 16 bits; greater ones are errors. Needed for
        integers and for curves; without it, floats are the signal itself.
    black_level : float
        Stored value at zero light; only with ``linear``. Values below it are noise and stay negative.
    channel_weights : "rec709" or tuple of float, optional
        Weight of each linear colour channel; ``rec709`` is the luminance Y. Needed for colour footage.
    key : str, optional
        Array in an npz or mat file, or channel of EXR files.
    axes : str, optional
        Order of an array's axes: t(ime), y, x, c(hannel). Needed for npz, npy and mat.
    first_frame : int
        Footage frame, counted from 0, at time 0.
    fit : str
        How footage fills the fine grid (``camera.view``): ``exact`` (same size), ``crop`` (its centre, one
        to one) or ``area`` (its centre in the grid's proportions, averaged over each fine sample's area).
    repeat : bool
        Consent to footage slower than the slots: a frame then fills several of them.
    accept_8bit : bool
        Consent to footage of 8 bits, in which high dynamic range is lost.
    """

    path: str = Field(min_length=1)
    frame_rate_hz: float = Field(gt=0, le=1e9)
    scale_w_m2_sr: float = Field(gt=0)
    white_w_m2_sr: float = Field(gt=0)
    linearisation: Literal["linear", "srgb", "gamma"]
    gamma: float | None = Field(None, gt=0.1, le=10)
    full_scale: float | None = Field(None, gt=0)
    black_level: float = Field(0.0, ge=0)
    channel_weights: Literal["rec709"] | tuple[float, ...] | None = None
    key: str | None = None
    axes: Literal["tyx", "yxt", "tyxc", "yxct"] | None = None
    first_frame: int = Field(0, ge=0)
    fit: Literal["exact", "crop", "area"] = "exact"
    repeat: bool = False
    accept_8bit: bool = False

    @model_validator(mode="after")
    def _statements_agree(self) -> FootageSource:
        if (self.gamma is None) == (self.linearisation == "gamma"):
            raise ValueError(
                f"gamma: got {self.gamma} with linearisation = '{self.linearisation}'; "
                "linearisation = 'gamma' needs one (gamma = 2.2), the others take none"
            )
        if self.linearisation != "linear" and self.full_scale is None:
            raise ValueError(
                f"full_scale: missing; linearisation = '{self.linearisation}' is a curve on 0 .. 1, so state "
                "which stored value means 1"
            )
        if self.black_level and self.linearisation != "linear":
            raise ValueError(
                f"black_level: got {self.black_level:g} with linearisation = '{self.linearisation}'; a level "
                "is subtracted from linear footage only"
            )
        if self.full_scale is not None and self.full_scale <= self.black_level:
            raise ValueError(
                f"full_scale: got {self.full_scale:g}, expected more than black_level {self.black_level:g}"
            )
        weights = self.channel_weights
        if isinstance(weights, tuple) and (not weights or min(weights) < 0 or sum(weights) <= 0):
            raise ValueError(f"channel_weights: got {weights}; expected weights >= 0, not all zero")
        return self

    def check_declared(self, declared: FileStatement, name: str) -> None:
        """Refuse a statement that the file itself contradicts.

        Raises
        ------
        ConfigError
            When the file states another curve, or primaries whose luminance isn't BT.709's.
        """
        curve, stated = declared.curve, self.linearisation
        if curve in _OTHER_CURVES or (curve and (curve == "linear") != (stated == "linear")):
            cure = f"linearisation = '{'linear' if curve == 'linear' else 'srgb'}', or remove what it says"
            raise ConfigError(
                f"source.footage.linearisation: got '{stated}', but {name} says that its values follow the "
                f"curve {curve}; cure: {'convert it to linear values' if curve in _OTHER_CURVES else cure}"
            )
        if self.channel_weights == "rec709" and declared.primaries not in (None, "BT.709"):
            raise ConfigError(
                f"source.footage.channel_weights: got 'rec709', but {name} says that its colours are "
                f"{declared.primaries}; cure: the weights of their luminance, one a channel"
            )

    def weights(self, n_channels: int) -> Doubles:
        """Weight of each channel for footage with ``n_channels``, array (channel,).

        Raises
        ------
        ConfigError
            When colour footage has no stated weights, or a number of weights other than its channels.
        """
        stated = self.channel_weights
        if n_channels == 1 and stated is None:
            return np.ones(1)
        if stated is None:
            raise ConfigError(
                f"source.footage.channel_weights: missing; the footage has {n_channels} channels. State "
                "'rec709' (luminance Y = 0.2126 R + 0.7152 G + 0.0722 B) or one weight a channel"
            )
        values = REC709_Y if stated == "rec709" else stated
        if len(values) != n_channels:
            raise ConfigError(
                f"source.footage.channel_weights: got {stated!r}, {len(values)} weights; the footage has "
                f"{n_channels} channel{'s' if n_channels > 1 else ''}"
            )
        return np.asarray(values, np.float64)

    def radiance(self, values: NDArray[Any], where: str) -> RecordedLight:
        """Convert stored values of a frame, array (y, x, channel), to radiance.

        Parameters
        ----------
        values : ndarray of shape (y, x, channel)
            As stored.
        where : str
            File and frame, for messages.

        Raises
        ------
        ValueCheckError
            For a value that is not finite, negative, above full scale, or mostly below black.
        """
        bad = ~np.isfinite(values)
        if bad.any():
            raise ValueCheckError(f"{where}: not a finite number at {_place(bad)}; repair the recording")
        if self.black_level == 0 and values.min() < 0:
            raise ValueCheckError(
                f"{where}: negative light {values.min():g} at {_place(values < 0)}; if the sensor's "
                "black is not 0, store it undiminished and state source.footage.black_level"
            )
        signal = np.asarray(values, np.float64) - self.black_level
        clipped = 0.0
        if self.full_scale is not None:
            if values.max() > self.full_scale:
                raise ValueCheckError(
                    f"{where}: {values.max():g} at {_place(values > self.full_scale)} is above "
                    f"source.footage.full_scale = {self.full_scale:g}; state the recording's true one"
                )
            clipped = float((values >= self.full_scale).any(axis=2).mean())
            signal /= self.full_scale - self.black_level
        below = float((signal < 0).mean())
        if below > _BELOW_BLACK_SHARE:
            raise ValueCheckError(
                f"{where}: {below:.0%} of the values are below source.footage.black_level = "
                f"{self.black_level:g}; a dark frame has about half: state the recording's true level"
            )
        light = self._linear(signal) @ self.weights(values.shape[2])
        return RecordedLight(light * self.scale_w_m2_sr, clipped, below)

    def _linear(self, signal: Doubles) -> Doubles:
        if self.linearisation == "srgb":
            return srgb_to_linear(signal)
        return signal if self.gamma is None else signal**self.gamma


@dataclass(frozen=True, eq=False)
class RecordedLight:
    """Radiance of one footage frame, and the loss of its recording."""

    w_m2_sr: Doubles  # (y, x), negative only where the signal was below the black level.
    clipped: float  # Share of pixels at full scale.
    below_black: float  # Share of values below the black level.


def _place(bad: NDArray[np.bool_]) -> str:
    row, col = (int(v) for v in np.argwhere(bad)[0][:2])
    return f"row {row}, column {col}"
