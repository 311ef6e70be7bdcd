# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false
"""A small camera that stands for a large one.

It has fewer pixels of the same size, its focal lengths shortened with the panel: field angles, blur in pixels
and light per pixel stay as they are. Its neutral density follows the experiment's light rule.

Its image lies in the middle and is, relatively, as little distorted as the camera's, so that its few pixels
are hardly moved. ``mapping`` moves them as far.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from optsim.camera.camera import CodedCamera
from optsim.camera.effects import ITSELF, Changes, changed
from optsim.camera.parts.lens import LARGEST_WING_SHARE
from optsim.camera.probe.frames import MARGIN_PX, Probe, cone_and_sample
from optsim.camera.probe.made_code import Schemes, levels_of
from optsim.camera.probe.made_scene import made_scene
from optsim.core.config import Part
from optsim.core.errors import ConfigError
from optsim.optics.psf import share_beyond
from optsim.scene import BrightLight

_COLS = 40
# Wings of a near probe lose this share of the light or more: what reaches beyond its length has no room.
_NEAR_WINGS = 1e-3
# Side of a lamp that lenses spread about as far as it reaches, fine samples; by trial.
_POINT = 5.0
_SHIFTS = ("shift_y_px", "shift_x_px")
# Of digital numbers: a probe's frame is of electrons.
_CONVERTER = ("gain_e", "black_dn", "bits", "finer_bits")
# Fields of the relay that move what is far from the middle the farther.
_SCALES = ("rotation_rad", "magnification_error", "keystone_y", "keystone_x", "distortion", "lateral_colour")


@dataclass(frozen=True)
class Illumination:
    """What a probe is told of the light.

    Parameters
    ----------
    white_w_m2_sr : float
        Radiance of the probe's brightest reflectance.
    percentile, saturation_share : float
        The light rule: this percentile of the interior fills this share of the full well under all-on.
    lights : tuple of BrightLight
        In the picture, that which brings most light first.
    """

    white_w_m2_sr: float
    percentile: float
    saturation_share: float
    lights: tuple[BrightLight, ...] = ()

    @property
    def bright(self) -> BrightLight | None:
        """The one that a probe's scene holds."""
        return self.lights[0] if self.lights else None


def make_probe(camera: CodedCamera, light: Illumination, schemes: Schemes) -> Probe:
    """Make the probe of a camera, for each of some schemes that differ; far wings would leave its panel.

    Raises
    ------
    ConfigError
        For a scheme that the slots don't allow, with its name.
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
    """Light whose bright source does as much to a small camera's frame as the given one to the camera's.

    A lamp keeps its share of the picture. What an effect does along its rim is then as large, or larger. A
    lamp of fewer than :data:`_POINT` samples is a point to the lens: a picture of a k-th of the sides has a
    k-th of a k-th of its light, so that what an effect does around it would be k times too small, rms.
    """
    if light.bright is None:
        return light
    height, k = light.bright.share**0.5 * camera.view.rows, camera.view.rows / small.view.rows
    over_white = light.bright.over_white * (height + k * _POINT) / (height + _POINT)
    return replace(light, lights=(replace(light.bright, over_white=over_white),))


def _window_within(small: CodedCamera) -> Changes:
    """Wings that reach no farther than a small camera's panel is long."""
    length = max(small.view.rows, small.view.cols)

    def share(part: str) -> float:
        least = max(_NEAR_WINGS, share_beyond_window(small, part, length))
        return max(getattr(small, part).wing_share, min(least, LARGEST_WING_SHARE))

    return {part: {"wing_share": share(part)} for part in ("objective", "relay")}


def share_beyond_window(camera: CodedCamera, part: str, half: int) -> float:
    """Share of its light that the PSF of objective or relay has farther off than so many fine samples."""
    f_number, sample_m = cone_and_sample(camera, part)
    return share_beyond(camera.wavelength_m, f_number, half * sample_m)


def _as_far(camera: CodedCamera, small: CodedCamera) -> Changes:
    """Shift, rotation and scales that move the pixels of a small camera as far as those of the camera.

    But not out of its picture: a pixel that moves as far as its margin gets quite other light than before.
    """
    relay, (times, most) = camera.relay, _scale(camera, small)
    shifts = {name: _within(getattr(relay, name), MARGIN_PX) for name in _SHIFTS}
    scales = {name: _within(getattr(relay, name) * times, most) for name in _SCALES}
    return {"relay": shifts | scales}


def drifted_as_far(camera: CodedCamera, now: CodedCamera, small: CodedCamera) -> dict[str, Changes | None]:
    """Say for each key in which a camera differs from a calibrated one how a small camera would.

    Parameters
    ----------
    camera, now, small : CodedCamera
        As calibrated, as it is now, and the small one that stands for it as calibrated.

    Returns
    -------
    dict
        ``part.key`` -> change of the small camera; None where its number isn't the camera's.
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
    """How much more a small camera's image must turn or grow, and how much it may at most."""
    most = MARGIN_PX / (np.hypot(small.panel_rows, small.panel_cols) / 2 * small.ratio)
    return camera.panel_cols / small.panel_cols, float(most)


def _within(value: float, limit: float) -> float:
    return float(np.clip(value, -limit, limit))


def _lit(camera: CodedCamera, light: Illumination, schemes: Schemes, lamp_px: float) -> Probe:
    """Probe behind the density of the light rule."""
    radiance = made_scene(camera, light.white_w_m2_sr, light.bright)
    share = 1 - light.bright.share if light.bright else 1.0
    # Of the interior: a bright light, where there is one, is the brightest part.
    bright = float(np.percentile(radiance.load(0).start, light.percentile * share))
    all_on = {row.stage: row.value for row in camera.with_nd(1.0).ledger(bright)}["electrons a frame"]
    nd = min(1.0, light.saturation_share * camera.sensor.most_e / all_on)
    return Probe(camera.with_nd(nd), radiance, schemes, lamp_px)


def shrunk(camera: CodedCamera, cols: int = _COLS) -> CodedCamera:
    """Return a camera of the same pixels, but fewer, that sees the same field."""
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
            # A ghost covers as large a part of the picture.
            "relay": relay.model_copy(
                update={
                    "shift_y_px": 0.0,
                    "shift_x_px": 0.0,
                    "rotation_rad": 0.0,
                    "ghost_blur_px": relay.ghost_blur_px * share,
                }
            ),
            # Smear and slots lost to the readout are those of the camera: its whole readout stays.
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
