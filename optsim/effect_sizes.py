# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false
"""How much each imperfection changes a frame, predicted on a small probe before anything is rendered.

The probe is the experiment's camera with fewer pixels of the same size, its focal lengths shortened with
the panel, so that field angles, blur in pixels and light per pixel stay as they are. It looks at a made
scene: reflectances over a decade and a half, something that moves, and, where the experiment's scene has a
bright outside, a window a thousand times as bright as white on a tenth of the field. One half of the panel
shows a random code, the other an exposure mosaic; the neutral density follows the experiment's light rule.

The size of an effect is the rms, over pixels that don't saturate, of the change it makes in a frame,
relative to the rms of the frame's predicted noise. What a calibration takes out again, such as shading,
counts in full.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from optsim.camera import CodedCamera
from optsim.effects import ALL, with_effects
from optsim.optics import Objective
from optsim.quantities import (
    Block,
    Bools,
    Bytes,
    Doubles,
    ExposureCode,
    Floats,
    IrradianceVideo,
    RadianceVideo,
    Segment,
    made_radiance,
)

_COLS = 40
_MARGIN_PX = 4
_WINDOW = 1000.0
_STEP_PX = 0.5  # fine samples a slot that the patch moves
# Slots that the four densities of the mosaic are open, as shares of a frame.
_DENSITIES = (1 / 36, 1 / 12, 11 / 36, 1.0)


@dataclass(frozen=True)
class EffectSize:
    """What an effect does to a frame of the probe.

    Parameters
    ----------
    effect, what : str
        Name and a few words.
    size : float
        Rms change of the frame by the effect as this camera has it, relative to the noise.
    """

    effect: str
    what: str
    size: float


def effect_sizes(
    camera: CodedCamera, white_w_m2_sr: float, percentile: float, saturation_share: float, *, window: bool
) -> list[EffectSize]:
    """Predict the size of every effect, the largest first.

    Parameters
    ----------
    camera : CodedCamera
        The experiment's camera; its neutral density is not used.
    white_w_m2_sr : float
        Radiance of the scene's white.
    percentile, saturation_share : float
        The light rule: this percentile of the interior fills this share of the full well under all-on.
    window : bool
        Whether the scene has a bright outside.
    """
    probe = shrunk(camera)
    radiance = _scene(probe, white_w_m2_sr, window=window)
    # Of the interior: a window, where there is one, is the brightest tenth or so.
    bright = float(np.percentile(radiance.load(0).start, percentile * (0.9 if window else 1.0)))
    all_on = {row.stage: row.value for row in probe.with_nd(1.0).ledger(bright)}["electrons a frame"]
    probe = probe.with_nd(min(1.0, saturation_share * probe.sensor.full_well_e / all_on))
    code = _code(probe)
    lights: dict[str, IrradianceVideo] = {}  # most effects leave the objective's image as it is

    def light(lens: Objective) -> IrradianceVideo:
        key = lens.model_dump_json()
        if key not in lights:
            lights[key] = probe.model_copy(update={"objective": lens}).form_image(radiance)
        return lights[key]

    whole, usable = _frame(probe, light(probe.objective), code)
    noise_e = float(np.sqrt(np.mean(whole[usable] + probe.sensor.read_noise_e**2)))
    found: list[EffectSize] = []
    for name, effect in ALL.items():
        other = with_effects(probe, {name: "ideal"})
        without, unclipped = _frame(other, light(other.objective), code)
        change = (whole - without)[usable & unclipped]
        found.append(EffectSize(name, effect.what, float(np.sqrt(np.mean(change**2))) / noise_e))
    return sorted(found, key=lambda each: -each.size)


def shrunk(camera: CodedCamera, cols: int = _COLS) -> CodedCamera:
    """Return a camera of the same pixels, but fewer, that sees the same field."""
    share = min(1.0, cols / camera.panel_cols)
    rows, cols = max(1, round(camera.panel_rows * share)), round(camera.panel_cols * share)
    panel, relay, lens, splitter = camera.modulator, camera.relay, camera.objective, camera.splitter
    around = 2 * _MARGIN_PX
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
            "relay": relay.model_copy(update={"shift_y_px": 0.0, "shift_x_px": 0.0, "rotation_rad": 0.0}),
            "sensor": camera.sensor.model_copy(
                update={
                    "rows": int(np.ceil(rows * camera.ratio)) + around,
                    "cols": int(np.ceil(cols * camera.ratio)) + around,
                }
            ),
        }
    )


def _frame(camera: CodedCamera, light: IrradianceVideo, code: ExposureCode) -> tuple[Doubles, Bools]:
    """Signal of a frame without noise, electrons, inside the panel's image; and where it does not clip."""
    expected, _ = camera.expected_electrons(light, 0, code, None)
    inner = slice(2 * _MARGIN_PX, -2 * _MARGIN_PX)
    smear = camera.sensor.smear_e(expected, camera.exposure_s)
    signal = camera.sensor.signal_e(expected, smear, camera.serial_number)
    return signal[inner, inner], (expected < camera.sensor.full_well_e)[inner, inner]


def _scene(camera: CodedCamera, white_w_m2_sr: float, *, window: bool) -> RadianceVideo:
    view, n_slots = camera.view, camera.slots_per_frame
    rng = np.random.default_rng(1288)
    base = white_w_m2_sr * _reflectances(rng, view.rows, view.cols)
    if window:
        base[view.rows // 8 : view.rows // 2, view.cols // 8 : view.cols * 3 // 8] *= _WINDOW
    height, width = view.rows // 3, view.cols // 3
    reach = int(np.ceil(_STEP_PX * n_slots))
    row, col = view.rows // 2, max(0, (view.cols - width - reach) // 2)
    width = min(width, view.cols - col - reach)
    patch = white_w_m2_sr * _reflectances(rng, height, width)
    under = base[row : row + height, col : col + width + reach]
    excess = np.zeros((n_slots, *under.shape), np.float32)
    for slot in range(n_slots):
        left = round(slot * _STEP_PX)
        excess[slot, :, left : left + width] = patch - under[:, left : left + width]
    segment = Segment(base, base, (Block(row, col, excess),), n_slots)
    return made_radiance(
        view,
        camera.slot_s,
        lambda _: segment,
        slots_per_segment=n_slots,
        n_slots=n_slots,
        white_w_m2_sr=white_w_m2_sr,
    )


def _reflectances(rng: np.random.Generator, rows: int, cols: int) -> Floats:
    """Patches of some samples, from 0.03 to 1."""
    coarse = rng.random((-(-rows // 12), -(-cols // 12)), np.float32)
    fine = np.repeat(np.repeat(coarse, 12, 0), 12, 1)[:rows, :cols]
    return np.asarray(10 ** (ndimage.gaussian_filter(fine, 1.0) * 1.5 - 1.5), np.float32)


def _code(camera: CodedCamera) -> ExposureCode:
    n, rows, cols = camera.slots_per_frame, camera.panel_rows, camera.panel_cols
    levels: Bytes = (np.random.default_rng(36).random((n, rows, cols)) < 0.5).astype(np.uint8) * np.uint8(255)
    tile = np.array(_DENSITIES).reshape(2, 2)
    opened = np.tile(tile, (-(-rows // 2), -(-cols // 2)))[:rows, :cols] * n
    static = np.arange(cols) < cols // 2
    mosaic = (np.arange(n)[:, None, None] < np.rint(opened)).astype(np.uint8) * np.uint8(255)
    levels[:, :, static] = mosaic[:, :, static]
    return ExposureCode(levels, np.broadcast_to(~static, (rows, cols)).copy())
