# pyright: reportMissingTypeStubs=false, reportUnknownVariableType=false
"""What an operator can put right: registration, focus, black level and gain, or all by a new bench.

The drifted camera is measured by images of its own, with their noise, and changed as a hand would change it:
a stage undoes the shift and the rotation, a focus ring the defocus. Black and gain are numbers of the
calibration. What an operator cannot see stays as it is. A bench changes nothing and calibrates what is there.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from typing import cast

import numpy as np
from numpy.random import Generator

from optsim.calibration import Calibration
from optsim.calibration.choice import CalibrationChoice
from optsim.camera.camera import CodedCamera
from optsim.core.config import build
from optsim.core.errors import BenchError
from optsim.core.quantities import Bytes, Doubles, ExposureCode, Floats, IrradianceVideo, Segment
from optsim.experiment.calibrations import Calibrations, calibrate_all
from optsim.experiment.experiment import Experiment
from optsim.optics.panel import settled_panel
from optsim.optics.readings import mean_reading

# Dots of two panel pixels each way, so far apart; a white pixel reaches this share of saturation.
_SPACING_PX, _SIZE_PX, _SHARE = 10, 2, 0.45
_FLAT_FRAMES = 8
# Half of a window around a dot, in spacings of the dots: the next one stays outside.
_HALF_WINDOW = 0.4
# A dot counts from this share of the median dot's light.
_DIM = 0.3
_FEWEST_DOTS = 6
# Search for the best focus: how far, and how fine. A blur of a CCD pixel takes 36 um at f/8.
_FOCUS_RANGE_M, _FOCUS_STEP_M = 150e-6, 3e-6
_MOST_IMAGES = 12
# Ratios of gains beyond these are a dead pixel's.
_GAINS = 0.1, 10.0

Values = dict[str, float]
"""What a compensator was set to, by the key of the camera or a word."""


def compensated(
    experiment: Experiment,
    now: CodedCamera,
    calibrations: Calibrations,
    compensators: tuple[str, ...],
    stream: Callable[[str], Generator],
) -> tuple[CodedCamera, Calibrations, Values]:
    """Let an operator work, in the order given, on the camera of an experiment, which has drifted."""
    values: Values = {}
    for name in compensators:
        now, calibrations, found = COMPENSATORS[name](experiment, now, calibrations, stream)
        values |= found
    return now, calibrations, values


@lru_cache(maxsize=2)
def by_bench(text: str) -> Calibrations:
    """Calibrate the camera of an experiment, as JSON; the last two are kept, for a point's other seeds."""
    return calibrate_all(build(Experiment, json.loads(text), where="point"))


def _registered(
    experiment: Experiment, now: CodedCamera, calibrations: Calibrations, stream: Callable[[str], Generator]
) -> tuple[CodedCamera, Calibrations, Values]:
    """Undo the shift and the rotation between two frames of the same dots."""
    camera = experiment.camera
    levels, light = _dots(camera), _light(calibrations)
    before = _photograph(camera, levels, light, 1, stream("dots before"))
    after = _photograph(now, levels, light, 1, stream("dots after"))
    shift_y, shift_x, turn = moved(before, after, camera)
    relay = now.relay
    undone = relay.model_copy(
        update={
            "shift_y_px": relay.shift_y_px - shift_y,
            "shift_x_px": relay.shift_x_px - shift_x,
            "rotation_rad": relay.rotation_rad - turn,
        }
    )
    found = {"relay.shift_y_px": -shift_y, "relay.shift_x_px": -shift_x, "relay.rotation_rad": -turn}
    return now.model_copy(update={"relay": undone}), calibrations, found


def moved(before: Doubles, after: Doubles, camera: CodedCamera) -> tuple[float, float, float]:
    """Shift (y, x), CCD pixels, and rotation, rad, of the dots between two images."""
    v, u = (each.ravel() + _SIZE_PX / 2 for each in np.meshgrid(*_places(camera), indexing="ij"))
    step = camera.view.samples_per_pitch
    y, x = camera.relay_geometry(step).place(v * step, u * step)
    spacing = _SPACING_PX * camera.ratio
    half = max(2, round(_HALF_WINDOW * spacing))
    (one, light), (two, also) = (_centroids(each, y, x, half) for each in (before, after))
    seen = (light > _DIM * np.nanmedian(light)) & (also > _DIM * np.nanmedian(also))
    if np.count_nonzero(seen) < _FEWEST_DOTS:
        raise BenchError(
            f"registration: got {np.count_nonzero(seen)} dots in both images, expected {_FEWEST_DOTS}; the "
            "drift is too large for a frame pair, calibrate anew"
        )
    geometry = camera.relay_geometry(step)
    ry, rx = one[seen, 0] - geometry.ccd_rows / 2, one[seen, 1] - geometry.ccd_cols / 2
    apart = two[seen] - one[seen]
    # A small turn from x towards y moves (y, x) by turn * (x, -y) in this camera's sense of rotation.
    zero, unit = np.zeros_like(ry), np.ones_like(ry)
    terms = np.concatenate([np.stack([unit, zero, rx], 1), np.stack([zero, unit, -ry], 1)])
    fit = np.linalg.lstsq(terms, np.concatenate([apart[:, 0], apart[:, 1]]))[0]
    return float(fit[0]), float(fit[1]), float(fit[2])


def _places(camera: CodedCamera) -> tuple[Doubles, Doubles]:
    """First panel rows and columns of the dots."""
    first = _SPACING_PX // 2
    rows, cols = (
        np.arange(first, side - first, _SPACING_PX, dtype=np.float64)
        for side in (camera.panel_rows, camera.panel_cols)
    )
    return rows, cols


def _dots(camera: CodedCamera) -> Bytes:
    levels = np.zeros((camera.panel_rows, camera.panel_cols), np.uint8)
    rows, cols = (each.astype(int) for each in _places(camera))
    for down in range(_SIZE_PX):
        for right in range(_SIZE_PX):
            levels[np.ix_(rows + down, cols + right)] = 255
    return levels


def _light(calibrations: Calibrations) -> float:
    """Irradiance on the panel at which white is as bright as wanted, by the calibration, W m^-2."""
    each = next(iter(calibrations.values()))
    range_dn = float(np.median((each.saturation_dn - each.black_dn)[each.valid]))
    return _SHARE * range_dn / (float(np.median(each.responsivity_dn[each.valid])) * each.coded_slots)


def _photograph(
    camera: CodedCamera, levels: Bytes, irradiance_w_m2: float, n_frames: int, rng: Generator
) -> Doubles:
    """Mean of frames, with their noise, of a panel that is held at some levels in even light, (y, x), DN."""
    view, slots = camera.view, camera.slots_per_frame
    image = np.full((view.rows, view.cols), irradiance_w_m2, np.float32)
    even = Segment(image, image, (), slots)
    light = IrradianceVideo.on_view(
        view, camera.slot_s, lambda _: even, slots_per_segment=slots, n_slots=slots
    )
    code = ExposureCode(np.repeat(levels[None], slots, axis=0), np.zeros(levels.shape, np.bool_))
    expected_e, _ = camera.expected_electrons(light, 0, code, settled_panel(levels, camera.panel_response))
    taken = [
        camera.sensor.digitise(expected_e, camera.exposure_s, camera.serial_number, rng)[0]
        for _ in range(n_frames)
    ]
    return np.stack(taken).mean(axis=0, dtype=np.float64)


def _centroids(picture: Doubles | Floats, y: Doubles, x: Doubles, half: int) -> tuple[Doubles, Doubles]:
    """Centre of light in windows around points, (n, 2), and its amount; NaN where a window leaves the CCD."""
    centres, light = np.full((len(y), 2), np.nan), np.full(len(y), np.nan)
    span = np.arange(-half, half + 1)
    for n, (row, col) in enumerate(zip(np.floor(y).astype(int), np.floor(x).astype(int), strict=True)):
        if row < half or col < half or row >= picture.shape[0] - half or col >= picture.shape[1] - half:
            continue
        window = picture[row - half : row + half + 1, col - half : col + half + 1].astype(np.float64)
        edge = np.concatenate([window[0], window[-1], window[:, 0], window[:, -1]])
        # Noise of the many dark pixels would pull the centre to the middle of the window.
        window = np.maximum(window - np.median(edge) - 3 * np.std(edge), 0)
        total = window.sum()
        if total > 0:
            light[n] = total
            centres[n] = (
                row + 0.5 + (window.sum(axis=1) * span).sum() / total,
                col + 0.5 + (window.sum(axis=0) * span).sum() / total,
            )
    return centres, light


def _refocused(
    experiment: Experiment, now: CodedCamera, calibrations: Calibrations, stream: Callable[[str], Generator]
) -> tuple[CodedCamera, Calibrations, Values]:
    """Turn the focus until dots are sharpest."""
    from scipy.optimize import fminbound

    levels, light = _dots(experiment.camera), _light(calibrations)

    def at(turned_m: float) -> CodedCamera:
        relay = now.relay.model_copy(update={"defocus_m": now.relay.defocus_m + turned_m})
        return now.model_copy(update={"relay": relay})

    def unsharp(turned_m: float) -> float:
        # The same noise at every setting: else it would decide between settings that are nearly alike.
        dn = _photograph(at(turned_m), levels, light, 1, stream("focus"))
        return -float(((dn - np.median(dn)) ** 2).sum())

    ends = -_FOCUS_RANGE_M, _FOCUS_RANGE_M
    turned_m = float(
        cast("float", fminbound(unsharp, *ends, xtol=_FOCUS_STEP_M, maxfun=_MOST_IMAGES, disp=0))
    )
    return at(turned_m), calibrations, {"relay.defocus_m": turned_m}


def _new_black_and_gain(
    experiment: Experiment, now: CodedCamera, calibrations: Calibrations, stream: Callable[[str], Generator]
) -> tuple[CodedCamera, Calibrations, Values]:
    """Take dark frames and flats anew; the pixel map stays."""
    camera = experiment.camera
    white, light = np.full((camera.panel_rows, camera.panel_cols), 255, np.uint8), _light(calibrations)
    pairs = [
        [_photograph(of, white, each, _FLAT_FRAMES, stream(f"{word} {each > 0}")) for each in (0.0, light)]
        for of, word in ((camera, "flats before"), (now, "flats after"))
    ]
    changed: dict[CalibrationChoice, Calibration] = {}
    values: Values = {}
    for choice, each in calibrations.items():
        square = each.centre_row, each.centre_col, each.reading_px
        (black, flat), (black_now, flat_now) = ([mean_reading(image, *square) for image in p] for p in pairs)
        gain = np.clip((flat_now - black_now) / np.maximum(flat - black, 1.0), *_GAINS)
        changed[choice] = replace(
            each,
            responsivity_dn=(each.responsivity_dn * gain).astype(np.float32),
            black_dn=(each.black_dn + black_now - black).astype(np.float32),
            saturation_dn=(each.saturation_dn + black_now - black).astype(np.float32),
        )
        values = {
            "black level, DN": float((black_now - black)[each.valid].mean()),
            "gain, ratio": float(gain[each.valid].mean()),
        }
    return now, changed, values


def _benched(
    experiment: Experiment, now: CodedCamera, calibrations: Calibrations, stream: Callable[[str], Generator]
) -> tuple[CodedCamera, Calibrations, Values]:
    """Take a whole bench of what is there; its noise is that of the first one."""
    del calibrations, stream
    undrifted: dict[str, object] = {"camera": now, "drift": {}, "drift_per_frame": {}}
    return now, by_bench(experiment.model_copy(update=undrifted).model_dump_json()), {}


_Work = Callable[
    [Experiment, CodedCamera, Calibrations, Callable[[str], Generator]],
    tuple[CodedCamera, Calibrations, Values],
]
COMPENSATORS: dict[str, _Work] = {
    "registration": _registered,
    "focus": _refocused,
    "black_gain": _new_black_and_gain,
    "bench": _benched,
}
"""What an operator can do, by name."""
