"""What the skip table leaves out, against the full model over cameras, scenes and tolerances.

Run as a program it prints the grid.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from scipy import ndimage

sys.path.append(str(Path(__file__).parents[2]))  # the checks are files, not a package

from optsim.camera.camera import CodedCamera
from optsim.camera.effects import ITSELF, changed, with_effects
from optsim.camera.hardware import demo, imx174, prototype
from optsim.camera.probe import Illumination
from optsim.camera.skip import Given, leave_out
from optsim.coding import (
    CodedRollingShutter,
    FlutterShutter,
    HdrMosaic,
    MotionAdaptive,
    NormalPhotography,
    RandomBinary,
    RandomExposure,
    Scheme,
)
from optsim.coding.periodic import PeriodicCode
from optsim.core.quantities import Block, ExposureCode, RadianceVideo, Segment
from optsim.scene import BrightLight

CLAIM = (
    "a frame of the camera that leaves something out differs from one of the full model by less than the "
    "tolerance, rms over "
    "pixels that don't saturate and relative to the frame's noise, over cameras, lights, codes, tolerances"
)
ORACLE = (
    "the full model (tolerance 0) on made scenes that no plan has seen: other textures, two movers, one of "
    "them in front of each bright light; differences of expected electrons; numpy only"
)
SOURCE = "definition of an effect's size: rms of the change that it makes over the predicted noise"
TOLERANCE = 1.0
REASON = "In units of the tolerance asked for: the claim itself."
FILES = (
    "optsim/camera/camera.py",
    "optsim/camera/skip.py",
    "optsim/camera/effects.py",
    "optsim/optics/*.py",
    "optsim/camera/parts/*.py",
    "optsim/camera/hardware/*.py",
)

_FULL: dict[str, tuple[np.ndarray, np.ndarray]] = {}  # frames of the full model, which take longest
_WHITE = 1.0  # W m^-2 sr^-1: enough for the light rule to ask for a density
_TOLERANCES = (0.03, 0.1, 0.3)
_SEGMENT = 18  # slots: the longest that the renderer chooses
# A mover passes before each, with the adaptive scheme's moving code behind it, or its static one.
_BUMPS, _OPEN = (0.3, 0.55), (0.7, 0.15)
# Open where nothing moves, for three slots where something does: the most that two codes differ by.
_ADAPTIVE = MotionAdaptive(static=NormalPhotography(), moving=RandomExposure())
_SCHEMES: dict[str, Scheme] = {
    "adaptive": _ADAPTIVE,
    "normal": NormalPhotography(),
    "short": NormalPhotography(open_slots=3),
    "mosaic": HdrMosaic(),
    "bumps": RandomExposure(),
    "binary": RandomBinary(),
    "flutter": FlutterShutter(),
}
# Few methods, of which others than those of the darkest and brightest frames suffer most from fringing.
_SETS: dict[str, dict[str, Scheme]] = {
    "bumps beside even codes": {name: _SCHEMES[name] for name in ("short", "flutter", "bumps")},
    "bumps beside rows": {
        "rows": CodedRollingShutter(group_rows=36, open_slots=1),
        "bump": RandomExposure(bump_slots=1),
        "mosaic": HdrMosaic(),
    },
    "thirds of a frame": {
        "normal": NormalPhotography(),
        "third": NormalPhotography(open_slots=12),
        "rows": CodedRollingShutter(),
    },
}
_LIGHTS = {
    "even room": (),
    "window": ((BrightLight(25.0, 0.07), _BUMPS),),
    "lamp": ((BrightLight(1000.0, 0.0005), _OPEN),),
    "street lamp": ((BrightLight(25000.0, 6e-5), _BUMPS),),
    "point": ((BrightLight(1000.0, 6e-5), _OPEN),),
    "window and lamp": ((BrightLight(25.0, 0.07), _OPEN), (BrightLight(3000.0, 3e-4), _BUMPS)),
}


class Case(NamedTuple):
    """One point of the grid."""

    camera: str
    light: str
    scheme: str
    tolerance: float
    error: float  # rms over the noise
    left_out: str


def _cameras() -> dict[str, CodedCamera]:
    small = demo()
    slow = small.model_copy(update={"objective": small.objective.model_copy(update={"f_number": 8.0})})
    quick = with_effects(small, {"response": "ideal", "ghost": "pessimistic", "smear": "pessimistic"})
    poor = with_effects(small, {"objective_blur": "pessimistic", "relay_blur": "pessimistic"})
    return {"demo": small, "f/8": slow, "no lag, ghosts": quick, "poor lenses": poor}


def _further_cameras() -> dict[str, CodedCamera]:
    """Cameras that differ more, each looked at by fewer scenes."""
    small, sensor = demo(), demo().sensor
    other = imx174().model_copy(update={"rows": sensor.rows, "cols": sensor.cols})
    parts = {
        "f/1.4": {"objective": {"f_number": 1.4}},
        "slow panel": {"modulator": {"tau_on_s": 5e-3, "tau_off_s": 10e-3}},
        "relay out of focus": {"relay": {"defocus_m": 36e-6}},
        "converging": {"splitter": {"placement": "converging"}},
        "no overlap": {ITSELF: {"overlap": False}},
        "450 nm": {ITSELF: {"wavelength_m": 450e-9}},
        "650 nm": {ITSELF: {"wavelength_m": 650e-9}},
        "IMX174": {ITSELF: {"sensor": other}},
    }
    worst = with_effects(small, {"all": "pessimistic"})
    return {"all pessimistic": worst, **{name: changed(small, part) for name, part in parts.items()}}


def measure() -> float:
    return max(case.error / case.tolerance for case in grid())


def perturbed() -> float:
    """With a plan for an even room, before a window and a lamp that a mover hides."""
    camera, light = demo(), "window and lamp"
    plan = leave_out(_given(camera, "even room"), 0.1)
    return _error(camera, light, _ADAPTIVE, plan.camera) / 0.1


def grid() -> list[Case]:
    """Measure every case; the last ones at the prototype's size."""
    cases: list[Case] = []
    for (name, camera), light in product(_cameras().items(), _LIGHTS):
        for tolerance in _TOLERANCES if name == "demo" else (0.1,):
            cases += _cases(name, camera, light, tolerance)
    for (name, camera), light in product(_further_cameras().items(), ("even room", "window")):
        cases += _cases(name, camera, light, 0.1)
    for (name, scheme), light in product(_SCHEMES.items(), ("even room", "window", "lamp")):
        cases += _cases("demo", demo(), light, 0.1, {name: scheme})
    # One plan for all of them.
    for light in ("even room", "window", "lamp"):
        cases += _cases("demo, all schemes", demo(), light, 0.1, _SCHEMES)
    for (name, schemes), light in product(_SETS.items(), ("even room", "window", "lamp")):
        cases += _cases(f"demo, {name}", demo(), light, 0.1, schemes)
    large = prototype()
    fits = large.relay.model_copy(update={"distortion": 0.0})
    for light, tolerance in (("window", 0.1), ("lamp", 0.3), ("point", 0.3)):
        cases += _cases("prototype", large.model_copy(update={"relay": fits}), light, tolerance)
    return cases


def _cases(
    name: str,
    camera: CodedCamera,
    light: str,
    tolerance: float,
    schemes: Mapping[str, Scheme] = MappingProxyType({"adaptive": _ADAPTIVE}),
) -> list[Case]:
    """One a scheme, all by one plan."""
    plan = leave_out(_given(camera, light), tolerance)
    left_out = ", ".join(c.skip for c in plan.choices if c.skipped)
    return [
        Case(name, light, which, tolerance, _error(camera, light, scheme, plan.camera), left_out)
        for which, scheme in schemes.items()
    ]


def _given(camera: CodedCamera, light: str) -> Given:
    return Given(camera, Illumination(_WHITE, 90.0, 0.8, tuple(bright for bright, _ in _LIGHTS[light])))


def _error(camera: CodedCamera, light: str, scheme: Scheme, planned: CodedCamera) -> float:
    """Rms difference of the planned frame and the full one, over the noise."""
    radiance = _scene(camera, _LIGHTS[light])
    # The light rule: the interior's bright places fill 0.8 of the well, all-on.
    all_on = {row.stage: row.value for row in camera.with_nd(1.0).ledger(0.5 * _WHITE)}["electrons a frame"]
    nd = min(1.0, 0.8 * camera.sensor.most_e / all_on)
    key, code = camera.model_dump_json() + light + scheme.model_dump_json(), _code(camera, scheme)
    if key not in _FULL:
        full = leave_out(_given(camera, light), 0.0).camera
        _FULL[key] = _frame(full, radiance, code, nd)
    (whole, usable), (ours, unclipped) = _FULL[key], _frame(planned, radiance, code, nd)
    inside = np.zeros(whole.shape, np.bool_)
    inside[8:-8, 8:-8] = True
    valid = usable & unclipped & inside
    noise_e = np.sqrt(np.mean(whole[usable & inside] + camera.sensor.read_noise_e**2))
    return float(np.sqrt(np.mean((whole - ours)[valid] ** 2)) / noise_e)


def _frame(
    camera: CodedCamera, radiance: RadianceVideo, code: ExposureCode, nd: float
) -> tuple[np.ndarray, np.ndarray]:
    """Signal without noise, electrons, and where it does not clip."""
    lit = camera.with_nd(nd)
    expected, _ = lit.expected_electrons(lit.form_image(radiance), 0, code, None)
    signal = lit.sensor.signal_e(expected, lit.exposure_s, lit.serial_number)
    return signal, expected < lit.sensor.most_e


def _scene(camera: CodedCamera, lights: Sequence[tuple[BrightLight, tuple[float, float]]]) -> RadianceVideo:
    view, n = camera.view, camera.slots_per_frame
    rng = np.random.default_rng(7)
    base = _WHITE * _texture(rng, view.rows, view.cols)
    for bright, (row, col) in lights:
        side = np.sqrt(bright.share)
        height, width = max(1, round(view.rows * side)), max(1, round(view.cols * side))
        top, left = round(row * view.rows - height / 2), round(col * view.cols)
        over = 40 * bright.over_white * bright.share * view.rows * view.cols / (height * width)
        base[top : top + height, left : left + width] *= over
    blocks = []
    for row, col in ((0.2, 0.5), (0.6, 0.1)):
        top, left = round(row * view.rows), round(col * view.cols)
        height, width, step = view.rows // 5, view.cols // 8, 0.7
        under = base[top : top + height, left : left + width + int(np.ceil(step * n))]
        patch = _WHITE * _texture(rng, height, width)
        excess = np.zeros((n, *under.shape), np.float32)
        for slot in range(n):
            at = round(step * slot)
            excess[slot, :, at : at + width] = patch - under[:, at : at + width]
        blocks.append(Block(top, left, excess))
    segments = [
        Segment(
            base, base, tuple(Block(b.row, b.col, b.excess[at : at + _SEGMENT]) for b in blocks), _SEGMENT
        )
        for at in range(0, n, _SEGMENT)
    ]
    return RadianceVideo.on_view(
        view,
        camera.slot_s,
        lambda index: segments[index],
        slots_per_segment=_SEGMENT,
        n_slots=n,
        white_w_m2_sr=_WHITE,
    )


def _texture(rng: np.random.Generator, rows: int, cols: int) -> np.ndarray:
    """Smooth and rough reflectances from 0.02 to 1."""
    rough = ndimage.gaussian_filter(rng.standard_normal((rows, cols)), 2.0) * 7
    smooth = ndimage.gaussian_filter(rng.standard_normal((rows, cols)), 15.0) * 50
    return (10 ** np.clip(-0.7 + 0.3 * rough + 0.3 * smooth, -1.7, 0)).astype(np.float32)


def _code(camera: CodedCamera, scheme: Scheme) -> ExposureCode:
    """First frame of a scheme, of other tiles than a probe's; the adaptive one's left third is static."""
    rows, cols = camera.panel_rows, camera.panel_cols

    def levels(each: Scheme) -> np.ndarray:
        if isinstance(each, MotionAdaptive):
            return np.where(np.arange(cols) < cols // 3, levels(each.static), levels(each.moving))
        tiles = each.tiles(camera.slots_per_frame, camera.coded_slots, np.random.default_rng(3))
        return PeriodicCode(tiles, (rows, cols)).levels(0)

    return ExposureCode(levels(scheme), np.ones((rows, cols), np.bool_))


if __name__ == "__main__":
    for case in grid():
        share, left_out = case.error / case.tolerance, case.left_out
        print(f"{case.camera:18} {case.light:16} {case.scheme:9} {case.tolerance:5} {share:7.3f}  {left_out}")
