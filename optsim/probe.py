# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false
"""Small cameras that stand for a large one, and what a change of the camera does to their frames.

The *near* probe has fewer pixels of the same size, its focal lengths shortened with the panel: field angles,
blur in pixels and light per pixel stay as they are. The *far* probe has as few pixels, but larger ones, and
sees the whole panel: on it light is as far from its source as in truth. Both look at a made scene:
reflectances over a decade and a half, something that moves, and, where the experiment has a bright light in
the picture, one. One half of the panel shows a random code, the other an exposure mosaic; the neutral density
follows the experiment's light rule.

The size of a change is its rms in a frame, over pixels that don't saturate, relative to the rms of the
frame's predicted noise; noise that it brings adds in squares. What a calibration takes out again, such as
shading, counts in full.

A near probe's image lies in the middle and is, relatively, as little distorted as the camera's, so that its
few pixels are hardly moved. ``mapping`` moves them as far.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, TypeVar

import numpy as np

from optsim.camera import SAMPLES_PER_PITCH, CodedCamera
from optsim.effects import Changes, changed
from optsim.forward.aberrations import Wavefront
from optsim.forward.psf import share_beyond
from optsim.optics.lens import LARGEST_WING_SHARE
from optsim.optics.objective import MOVING_WING_SHARE
from optsim.quantities import (
    Block,
    Bools,
    Bytes,
    Doubles,
    ExposureCode,
    Floats,
    RadianceVideo,
    Segment,
    made_radiance,
)
from optsim.scene import BrightLight

T = TypeVar("T")

NOTHING: Changes = {}
# Probes of a plan mix the rims of panel pixels, let PSFs be the same all over the field and wings of moving
# light be coarse, which saves most of their time and changes other sizes by at most a sixth for the nominal
# camera (the sensor's bend by a quarter), a third for a pessimistic one. Only what asks for one of these is
# compared with it whole, by the names of effects and short cuts.
PLAIN: Changes = {
    "modulator": {"rim_model": "mixed"},
    "objective": {"field_error": 1.0, "moving_wing_share": MOVING_WING_SHARE},
    "relay": {"field_error": 1.0},
}
FINEST_FIELD = 5e-3  # of a point's light is misplaced
_RIMS: Changes = {"modulator": {"rim_model": "fine"}}
_OBJECTIVE: Changes = {"objective": {"field_error": FINEST_FIELD}}
_RELAY: Changes = {"relay": {"field_error": FINEST_FIELD}}
_WHOLE: dict[str, Changes] = {
    "fringing": _RIMS,
    "fringing_rims": _RIMS,
    "moving_wings": {"objective": {"moving_wing_share": 0.0}},
    "objective_blur": _OBJECTIVE,
    "objective_field": _OBJECTIVE,
    "relay_blur": _RELAY,
    "relay_field": _RELAY,
}

_COLS = 40
# Wings of a near probe lose this share of the light or more: what reaches beyond its length has no room.
_NEAR_WINGS = 1e-3
_MARGIN_PX = 4
# Declared white over the interior's bright places: about that of window_room, whose interior is lit by its
# window alone; in brighter rooms a lamp in the picture is then taken for too bright.
WHITE_OVER_INTERIOR = 40.0
_WAY_PX = 30  # fine samples that the patch moves
_PARTS = (4, 5, 3, 2, 1)  # of a frame, of which it moves in one
_SHARP: Changes = {
    "objective": {"wavefront": Wavefront()},
    "relay": {"wavefront": Wavefront(), "defocus_m": 0.0},
}
_SHIFTS = ("shift_y_px", "shift_x_px")
# Fields of the relay that move what is far from the middle the farther.
_SCALES = ("rotation_rad", "magnification_error", "keystone_y", "keystone_x", "distortion", "lateral_colour")
# Slots that the four densities of the mosaic are open, as shares of a frame.
_DENSITIES = (1 / 36, 1 / 12, 11 / 36, 1.0)


def compared_with(name: str) -> Changes:
    """Return what an effect or short cut is compared with: nothing, or what a plain probe lacks."""
    return _WHOLE.get(name, NOTHING)


@dataclass(frozen=True)
class Illumination:
    """What a probe is told of the light.

    Parameters
    ----------
    white_w_m2_sr : float
        Radiance of the probe's brightest reflectance.
    percentile, saturation_share : float
        The light rule: this percentile of the interior fills this share of the full well under all-on.
    bright : BrightLight or None
        Brightest light in the picture.
    """

    white_w_m2_sr: float
    percentile: float
    saturation_share: float
    bright: BrightLight | None


@dataclass(frozen=True, eq=False)
class Probe:
    """A small camera before its scene.

    Parameters
    ----------
    camera : CodedCamera
        Behind the neutral density of the light rule.
    radiance : RadianceVideo
        The scene.
    mapping : Changes
        What moves the pixels of this probe's image as far as those of the camera that it stands for.
    """

    camera: CodedCamera
    radiance: RadianceVideo
    mapping: Changes = field(default_factory=dict[str, dict[str, float]])

    @property
    def parts(self) -> int:
        """Parts of a frame, in one of which something moves."""
        return self.radiance.n_slots // self.radiance.slots_per_segment

    # Most changes leave most of what a frame is made from as it is.
    @cached_property
    def _made(self) -> dict[object, Any]:
        return {}

    def _once(self, key: object, make: Callable[[], T]) -> T:
        if key not in self._made:
            self._made[key] = make()
        return self._made[key]

    def frame(self, changes: Changes) -> tuple[Doubles, Bools]:
        """Signal without noise of a camera with changed parts, electrons, and where it does not clip."""
        camera = changed(self.camera, changes)
        expected = camera.electrons_of(self._image(camera))
        edges = (min(2 * _MARGIN_PX, (n - 1) // 2) for n in expected.shape)
        inner = tuple(slice(edge, n - edge) for edge, n in zip(edges, expected.shape, strict=True))
        signal = camera.sensor.signal_e(expected, camera.exposure_s, camera.serial_number)
        return signal[inner], (expected < camera.sensor.full_well_e)[inner]

    def _image(self, camera: CodedCamera) -> Doubles:
        """Radiant exposure of the CCD."""
        panel, lens, relay = camera.modulator, _image_of(camera, "objective"), _image_of(camera, "relay")
        gate = (
            panel.model_dump_json(), camera.splitter.model_dump_json(),
            camera.objective.working_f_number, camera.coded_slots,
        )  # fmt: skip
        behind = lens, gate

        def energy() -> Floats:
            light = self._once(("light", lens), lambda: camera.form_image(self.radiance))
            shutter = self._once(("shutter", gate), lambda: camera.shutter(_code(camera), None, 1)[0])
            return camera.panel_energy(light, 0, shutter)

        def image() -> Doubles:
            return camera.relay_operator().apply(self._once(("energy", behind), energy))

        return self._once(("image", behind, relay, camera.relay_geometry()), image)

    def size(self, changes: Changes, of: Changes) -> float:
        """Rms difference that changes make to a frame with the changes ``of``, over that frame's noise.

        Infinite where every pixel clips, with the changes or without.
        """
        whole, usable = self._whole(of)
        without, unclipped = self.frame(changes)
        both = usable & unclipped
        if not both.any():
            return float("inf")
        dark, less = (changed(self.camera, each).sensor.dark_noise_e ** 2 for each in (of, changes))
        square = np.mean((whole - without)[both] ** 2) + abs(dark - less)
        return float(np.sqrt(square / np.mean(whole[usable] + dark)))

    def noise_e(self) -> tuple[float, float]:
        """Noise of the frame, rms, electrons: all of it, and what of it is the light's own.

        Of a frame that has no pixels or clips in all of them, it is that of the dark.
        """
        whole, usable = self._whole(NOTHING)
        light = float(np.mean(whole[usable])) if usable.any() else 0.0
        return (light + self.camera.sensor.dark_noise_e**2) ** 0.5, light**0.5

    def _whole(self, changes: Changes) -> tuple[Doubles, Bools]:
        return self._once(("frame", repr(changes)), lambda: self.frame(changes))


def near_probe(camera: CodedCamera, light: Illumination) -> Probe:
    """Probe of the same pixels, but fewer, that sees the same field angles; far wings would leave it."""
    small = shrunk(camera)
    lit = _lit(changed(small, _window_within(small)), light)
    return replace(lit, mapping=_as_far(camera, small))


def _window_within(small: CodedCamera) -> Changes:
    """Wings that reach no farther than a small camera's panel is long."""
    length = max(small.view.rows, small.view.cols)

    def share(part: str) -> float:
        least = max(_NEAR_WINGS, share_beyond_window(small, part, length))
        return max(getattr(small, part).wing_share, min(least, LARGEST_WING_SHARE))

    return {part: {"wing_share": share(part)} for part in ("objective", "relay")}


def share_beyond_window(camera: CodedCamera, part: str, half: int) -> float:
    """Share of its light that the PSF of objective or relay has farther off than so many fine samples."""
    f_number, sample_m = _cone_and_sample(camera, part)
    return share_beyond(camera.wavelength_m, f_number, half * sample_m)


def _cone_and_sample(camera: CodedCamera, part: str) -> tuple[float, float]:
    """f-number and side of a fine sample, m, in the image of objective or relay."""
    f_number, sample_m = camera.objective.working_f_number, camera.modulator.pitch_m / SAMPLES_PER_PITCH
    if part == "relay":
        return camera.relay.image_f_number(f_number), sample_m * camera.relay.magnification
    return f_number, sample_m


def _image_of(camera: CodedCamera, part: str) -> tuple[str, int]:
    """Key of the image of objective or relay: errors over the field that have as many nodes have one."""
    lens, view = getattr(camera, part), camera.view
    defocus_m = camera.relay.defocus_m if part == "relay" else 0.0
    psf = lens.psf(*_cone_and_sample(camera, part), (view.rows, view.cols), defocus_m, camera.wavelength_m)
    return lens.model_dump_json(exclude={"field_error"}), len(psf.cores)


def _as_far(camera: CodedCamera, small: CodedCamera) -> Changes:
    """Shift, rotation and scales that move the pixels of a small camera as far as those of the camera.

    But not out of its picture: a pixel that moves as far as its margin gets quite other light than before.
    """
    relay, times = camera.relay, camera.panel_cols / small.panel_cols
    most = _MARGIN_PX / (np.hypot(small.panel_rows, small.panel_cols) / 2 * small.ratio)
    shifts = {name: _within(getattr(relay, name), _MARGIN_PX) for name in _SHIFTS}
    scales = {name: _within(getattr(relay, name) * times, most) for name in _SCALES}
    return {"relay": shifts | scales}


def _within(value: float, limit: float) -> float:
    return float(np.clip(value, -limit, limit))


def far_probe(camera: CodedCamera, light: Illumination) -> Probe:
    """Probe of larger pixels, but fewer, that sees the whole panel: what blurs within one is left out."""
    times = max(1, camera.panel_cols // _COLS)
    panel, sensor = camera.modulator, camera.sensor
    larger = camera.model_copy(
        update={
            "panel_rows": max(1, camera.panel_rows // times),
            "panel_cols": camera.panel_cols // times,
            "modulator": panel.model_copy(
                update={
                    "rows": max(1, panel.rows // times),
                    "cols": panel.cols // times,
                    "pitch_m": panel.pitch_m * times,
                }
            ),
            "sensor": sensor.model_copy(update={"pitch_m": sensor.pitch_m * times}),
        }
    )
    return _lit(changed(shrunk(larger), _SHARP), light, times)


def _lit(camera: CodedCamera, light: Illumination, times: int = 1) -> Probe:
    """Probe behind the density of the light rule; pixels ``times`` as large get no more light for it."""
    radiance = _scene(camera, light)
    share = 1 - light.bright.share if light.bright else 1.0
    # Of the interior: a bright light, where there is one, is the brightest part.
    bright = float(np.percentile(radiance.load(0).start, light.percentile * share))
    all_on = {row.stage: row.value for row in camera.with_nd(1.0).ledger(bright)}["electrons a frame"]
    nd = min(1.0, light.saturation_share * camera.sensor.full_well_e / (all_on / times**2))
    return Probe(camera.with_nd(nd / times**2), radiance)


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


def _scene(camera: CodedCamera, light: Illumination) -> RadianceVideo:
    view, n_slots, white_w_m2_sr = camera.view, camera.slots_per_frame, light.white_w_m2_sr
    rng = np.random.default_rng(1288)
    base = white_w_m2_sr * _reflectances(rng, view.rows, view.cols)
    if light.bright is not None:
        side = np.sqrt(light.bright.share)
        height, width = max(1, round(view.rows * side)), max(1, round(view.cols * side))
        # A lamp smaller than a sample brings as much light by a less bright one.
        over = light.bright.over_white * light.bright.share * view.rows * view.cols / (height * width)
        # Its left part is in the way of what moves.
        row, col = (view.rows - height) // 3, (view.cols - width) // 4
        base[row : row + height, col : col + width] *= over * WHITE_OVER_INTERIOR
    parts = next(n for n in _PARTS if n_slots % n == 0)
    n = n_slots // parts
    height, width = view.rows // 3, view.cols // 3
    # A panel of a few pixels leaves less way to go.
    reach = min(_WAY_PX, view.cols // 3)
    row, col = view.rows * 5 // 12, max(0, (view.cols - width - reach) // 2)
    width = min(width, view.cols - col - reach)
    patch = white_w_m2_sr * _reflectances(rng, height, width)

    def picture(share: float) -> Floats:
        """Patch a share of its way along."""
        left, seen = col + round(share * reach), base.copy()
        seen[row : row + height, left : left + width] = patch
        return seen

    start, stop = picture(0.0), picture(1.0)
    # It stands, moves for a part of the frame, and stands: to move in all parts takes as many times as long.
    still = Segment(start, start, (), n), Segment(stop, stop, (), n)
    lines = Segment(start, stop, (), n)
    window = np.s_[row : row + height, col : col + width + reach]
    excess = np.stack([picture((t + 0.5) / n)[window] - lines.instant(t)[window] for t in range(n)])
    moving = replace(lines, blocks=(Block(row, col, excess),))
    segments = [still[0], moving, *[still[1]] * (parts - 2)] if parts > 1 else [moving]
    return made_radiance(
        view,
        camera.slot_s,
        lambda index: segments[index],
        slots_per_segment=n,
        n_slots=n_slots,
        white_w_m2_sr=white_w_m2_sr,
    )


def _reflectances(rng: np.random.Generator, rows: int, cols: int) -> Floats:
    """Patches of some samples, from 0.03 to 1."""
    coarse = rng.random((-(-rows // 12), -(-cols // 12)), np.float32)
    fine = np.repeat(np.repeat(coarse, 12, 0), 12, 1)[:rows, :cols]
    # A Gaussian of one sample, cut at four of them, mirrored at the border.
    line = np.exp(-(np.arange(-4.0, 5.0) ** 2) / 2)
    for axis in (0, 1):
        wide = np.pad(fine, [(4, 4) if axis == each else (0, 0) for each in (0, 1)], "symmetric")
        windows = np.lib.stride_tricks.sliding_window_view(wide, 9, axis)
        fine = np.asarray(windows @ (line / line.sum()), np.float32)
    return np.asarray(10 ** (fine * 1.5 - 1.5), np.float32)


def _code(camera: CodedCamera) -> ExposureCode:
    n, rows, cols = camera.slots_per_frame, camera.panel_rows, camera.panel_cols
    levels: Bytes = (np.random.default_rng(36).random((n, rows, cols)) < 0.5).astype(np.uint8) * np.uint8(255)
    tile = np.array(_DENSITIES).reshape(2, 2)
    opened = np.tile(tile, (-(-rows // 2), -(-cols // 2)))[:rows, :cols] * n
    static = np.arange(cols) < cols // 2
    mosaic = (np.arange(n)[:, None, None] < np.rint(opened)).astype(np.uint8) * np.uint8(255)
    levels[:, :, static] = mosaic[:, :, static]
    return ExposureCode(levels, np.broadcast_to(~static, (rows, cols)).copy())
