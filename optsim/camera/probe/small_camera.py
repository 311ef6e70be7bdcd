"""Small cameras that stand for large ones in probes.

A small camera has fewer pixels of the same size, and focal lengths shortened with the panel. Field angles,
blur in pixels and light per pixel stay the same. Its neutral density follows the experiment's light rule.

Its image lies in the middle with the camera's relative distortion, so its few pixels are hardly displaced.
``mapping`` displaces them as far as on the large camera.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from optsim.camera.camera import CodedCamera
from optsim.camera.effects import ITSELF, Changes, changed
from optsim.camera.parts.lens import LARGEST_TAIL_SHARE
from optsim.camera.probe.frames import MARGIN_PX, Probe, cone_and_sample
from optsim.camera.probe.made_code import Schemes, levels_of
from optsim.camera.probe.made_scene import made_scene
from optsim.core.config import Part
from optsim.core.errors import ConfigError
from optsim.optics.psf import share_beyond
from optsim.scene import BrightLight

_COLS = 40
# PSF windows of a probe miss at least this share of the light: tails longer than its panel have no room.
_NEAR_TAILS = 1e-3
# Side of a lamp as wide as its blur by the lenses, fine samples; by trial.
_POINT = 5.0
_SHIFTS = ("shift_y_px", "shift_x_px")
# Fields of the converter: a probe's frame is in electrons.
_CONVERTER = ("gain_e", "black_dn", "bits", "finer_bits")
# Fields of the relay whose displacement grows with the distance from the centre.
_SCALES = ("rotation_rad", "magnification_error", "keystone_y", "keystone_x", "distortion", "lateral_colour")


@dataclass(frozen=True)
class Illumination:
    """Light of the experiment as a probe needs it.

    Parameters
    ----------
    white_w_m2_sr : float
        Radiance of the probe's brightest reflectance.
    percentile, saturation_share : float
        The light rule: this percentile of the interior fills this share of the full well under all-on.
    lights : tuple of BrightLight
        Lights in the picture, by the light they bring, largest first.
    """

    white_w_m2_sr: float
    percentile: float
    saturation_share: float
    lights: tuple[BrightLight, ...] = ()

    @property
    def bright(self) -> BrightLight | None:
        """The brightest one, used in a probe's scene."""
        return self.lights[0] if self.lights else None


def make_probe(camera: CodedCamera, light: Illumination, schemes: Schemes) -> Probe:
    """Make the probe of a camera for some schemes; PSF tails are cut at the probe's panel.

    Raises
    ------
    ConfigError
        For a scheme that does not fit the slots, with its name.
    """
    different: dict[str, str] = {}
    for name, scheme in schemes.items():
        different.setdefault(scheme.model_dump_json(), name)
    schemes, small = {name: schemes[name] for name in different.values()}, shrunk(camera)
    for name, scheme in schemes.items():
        try:
            levels_of(scheme, small)
        except ConfigError as error:
            raise ConfigError(f"methods, {name!r}: {error}") from None
    lamp_px, light = _lamp_px(camera, light), _as_much(camera, small, light)
    lit = _lit(changed(small, _window_within(small)), light, schemes, lamp_px)
    return replace(lit, mapping=_as_far(camera, small))


def _lamp_px(camera: CodedCamera, light: Illumination) -> float:
    """Panel pixels that the brightest light covers."""
    return light.bright.share * camera.panel_rows * camera.panel_cols if light.bright else 0.0


def _as_much(camera: CodedCamera, small: CodedCamera, light: Illumination) -> Illumination:
    """Light whose bright source affects a small camera's frame as the given one affects the camera's.

    A lamp keeps its share of the picture, so effects along its edge are as large or larger. A lamp of fewer
    than :data:`_POINT` samples is a point to the lens: in a picture with sides k times shorter it would have
    k^2 times less light, and effects around it would be k times too small, rms.
    """
    if light.bright is None:
        return light
    height, k = light.bright.share**0.5 * camera.view.rows, camera.view.rows / small.view.rows
    over_white = light.bright.over_white * (height + k * _POINT) / (height + _POINT)
    return replace(light, lights=(replace(light.bright, over_white=over_white),))


def _window_within(small: CodedCamera) -> Changes:
    """Limit PSF windows to the length of a small camera's panel."""
    length = max(small.view.rows, small.view.cols)

    def share(part: str) -> float:
        least = max(_NEAR_TAILS, share_beyond_window(small, part, length))
        return max(getattr(small, part).tail_share, min(least, LARGEST_TAIL_SHARE))

    return {part: {"tail_share": share(part)} for part in ("objective", "relay")}


def share_beyond_window(camera: CodedCamera, part: str, half: int) -> float:
    """Share of the PSF of objective or relay farther from the centre than ``half`` fine samples."""
    f_number, sample_m = cone_and_sample(camera, part)
    return share_beyond(camera.wavelength_m, f_number, half * sample_m)


def _as_far(camera: CodedCamera, small: CodedCamera) -> Changes:
    """Shift, rotation and scales that displace a small camera's pixels as far as the camera's."""
    # Within the margin: beyond it a pixel would get unrelated light.
    relay, (times, most) = camera.relay, _scale(camera, small)
    shifts = {name: _within(getattr(relay, name), MARGIN_PX) for name in _SHIFTS}
    scales = {name: _within(getattr(relay, name) * times, most) for name in _SCALES}
    return {"relay": shifts | scales}


def drifted_as_far(camera: CodedCamera, now: CodedCamera, small: CodedCamera) -> dict[str, Changes | None]:
    """Translate the drift of a camera to a small camera, key by key.

    Parameters
    ----------
    camera, now, small : CodedCamera
        As calibrated, as it is now, and the small one that stands for it as calibrated.

    Returns
    -------
    dict
        ``part.key`` -> change of the small camera; None where the camera's number does not translate.
    """
    found: dict[str, Changes | None] = {}
    for part, own in camera:
        values = {part: (own, getattr(now, part))}
        if isinstance(own, Part):
            values = {f"{part}.{key}": (before, getattr(getattr(now, part), key)) for key, before in own}
        for key, (before, after) in values.items():
            if before != after and isinstance(before, Part):
                same = getattr(getattr(small, part), key.rpartition(".")[2]) == before
                for inner, value in after:
                    if value != getattr(before, inner):
                        table = {key.rpartition(".")[2]: {inner: value}}
                        found[f"{key}.{inner}"] = {part: table} if same else None
            elif before != after:
                found[key] = _as_drifted(camera, small, key, before, after)
    return found


def _as_drifted(camera: CodedCamera, small: CodedCamera, key: str, before: Any, after: Any) -> Changes | None:
    part, _, name = key.rpartition(".")
    if not part:
        return {ITSELF: {name: after}}
    own = getattr(getattr(small, part), name)
    if part == "sensor" and name in _CONVERTER:
        return None
    if part == "relay" and name in _SHIFTS:
        return {part: {name: _within(own + after - before, MARGIN_PX)}}
    if part == "relay" and name in _SCALES:
        times, most = _scale(camera, small)
        return {part: {name: _within(own + (after - before) * times, most)}}
    return {part: {name: after}} if own == before else None


def _scale(camera: CodedCamera, small: CodedCamera) -> tuple[float, float]:
    """Factor by which a small camera's image must rotate or grow more, and its limit."""
    most = MARGIN_PX / (np.hypot(small.panel_rows, small.panel_cols) / 2 * small.ratio)
    return camera.panel_cols / small.panel_cols, float(most)


def _within(value: float, limit: float) -> float:
    return float(np.clip(value, -limit, limit))


def _lit(camera: CodedCamera, light: Illumination, schemes: Schemes, lamp_px: float) -> Probe:
    """Probe behind the density of the light rule."""
    radiance = made_scene(camera, light.white_w_m2_sr, light.bright)
    share = 1 - light.bright.share if light.bright else 1.0
    # Percentile of the interior: a bright light, if any, is the brightest part.
    bright = float(np.percentile(radiance.load(0).start, light.percentile * share))
    all_on = {row.stage: row.value for row in camera.with_nd(1.0).ledger(bright)}["electrons a frame"]
    nd = min(1.0, light.saturation_share * camera.sensor.most_e / all_on)
    return Probe(camera.with_nd(nd), radiance, schemes, lamp_px)


def shrunk(camera: CodedCamera, cols: int = _COLS) -> CodedCamera:
    """Return a camera with fewer of the same pixels and the same field of view."""
    share = min(1.0, cols / camera.panel_cols)
    rows, cols = max(1, round(camera.panel_rows * share)), round(camera.panel_cols * share)
    panel, relay, lens, splitter = camera.modulator, camera.relay, camera.objective, camera.splitter
    around = 2 * MARGIN_PX
    return camera.model_copy(
        update={
            "panel_rows": rows,
            "panel_cols": cols,
            "objective": lens.model_copy(update={"focal_length_m": lens.focal_length_m * share}),
            "splitter": splitter.model_copy(update={"collimator_m": splitter.collimator_m * share}),
            "modulator": panel.model_copy(
                update={
                    "rows": max(rows, round(panel.rows * share)),
                    "cols": max(cols, round(panel.cols * share)),
                }
            ),
            # A ghost covers the same part of the picture.
            "relay": relay.model_copy(
                update={
                    "shift_y_px": 0.0,
                    "shift_x_px": 0.0,
                    "rotation_rad": 0.0,
                    "ghost_blur_px": relay.ghost_blur_px * share,
                }
            ),
            # Smear and slots lost to the readout stay those of the camera: its whole readout is kept.
            "sensor": camera.sensor.model_copy(
                update={
                    "rows": int(np.ceil(rows * camera.ratio)) + around,
                    "cols": int(np.ceil(cols * camera.ratio)) + around,
                    "readout_s": camera.sensor.frame_readout_s,
                    "readout_rows": None,
                }
            ),
        }
    )
