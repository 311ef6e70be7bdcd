# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false
"""Time of a coded frame at the prototype's scale, against the plain dense computation.

The scene is made, not rendered: a textured interior, a window a thousand times as bright, and ten textured
patches that move; a random code on every panel pixel. Ours is what every run does: the camera that a plan
chooses for a tenth of the noise, the objective on base and moving blocks, the panel's weights with their
history, one exposure, the relay once. The codes of the adaptive scheme, bumps where something moves and the
mosaic elsewhere, are timed beside it, by a plan of their own. The dense computation takes each slot as a
whole picture through objective, panel and relay of the full model, and adds the slots up on the CCD; smear,
clip and bend of the sensor follow in both. What ours leaves out by its plan is the difference of the two, in
units of a tenth of the predicted noise of a pixel. Time and error are measured for a series of tolerances.
"""

from __future__ import annotations

import resource
import time
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from scipy import ndimage

from optsim.camera.camera import CodedCamera
from optsim.camera.hardware import prototype
from optsim.camera.probe import WHITE_OVER_INTERIOR, Illumination
from optsim.camera.skip import Given, leave_out
from optsim.coding import MotionAdaptive, RandomBinary, Scheme
from optsim.coding.periodic import PeriodicCode
from optsim.core.progress import Progress, silent
from optsim.core.quantities import (
    Block,
    Bytes,
    Doubles,
    ExposureCode,
    Floats,
    RadianceVideo,
    Segment,
)
from optsim.optics.fringe_correction import cell_weights
from optsim.optics.fringing import whole_cells
from optsim.optics.panel import slot_weights
from optsim.optics.radiometry import photons_per_joule
from optsim.scene import BrightLight

# Slots between key instants, as in a scene that moves about as fast as window_room.
_SEGMENT = 18
_MOVERS = 10
# Share of the field that the patches sweep over.
_SHARES = {"capture.paper_20_percent": 0.2, "capture.paper_all_moving": 1.0}
_WHITE = 0.1  # W m^-2 sr^-1, about 68 cd/m^2 at 550 nm
_ROUNDS = 5
# An effect is negligible below this share of the predicted noise.
_TOLERANCE, _FURTHER_TOLERANCES = 0.1, (0.0, 0.03, 0.3, 1.0)
_WINDOW = 1000.0  # times as bright as the interior


def measure(name: str, progress: Progress = silent) -> dict[str, Any]:
    """Measure one record.

    Parameters
    ----------
    name : str
        ``capture.<how much moves>``.
    progress : Progress
        Told of each piece of work.
    """
    camera, share = prototype(), _SHARES[name]
    rng = np.random.default_rng(1288)
    radiance, levels = moving_patches(camera, share, rng), _random_code(camera, rng)
    code = ExposureCode(levels, np.ones(levels.shape[1:], np.bool_))
    light = Illumination(_WHITE, 90.0, 0.8, (BrightLight(_WINDOW / WHITE_OVER_INTERIOR, 1 / 12),))
    seconds: dict[float, float] = {}
    frames: dict[float, Doubles] = {}
    peak_mb = 0.0

    def planned_for(scheme: Scheme, tolerance: float) -> CodedCamera:
        return leave_out(Given(camera, light), tolerance).camera

    for done, tolerance in enumerate((_TOLERANCE, *_FURTHER_TOLERANCES)):
        planned = planned_for(RandomBinary(), tolerance)
        seconds[tolerance] = _seconds_a_frame(planned, radiance, code, _ROUNDS if tolerance else 1)
        if tolerance == _TOLERANCE:
            peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        expected, _ = planned.expected_electrons(
            planned.form_image(radiance), 0, code, planned.panel_at_rest()
        )
        frames[tolerance] = _signal(planned, expected)
        progress("optsim", done + 1, 1 + len(_FURTHER_TOLERANCES))
    adaptive = MotionAdaptive()
    shown = _adaptive_code(camera, adaptive, share)
    adaptive_s = _seconds_a_frame(planned_for(adaptive, _TOLERANCE), radiance, shown, _ROUNDS)
    start = time.perf_counter()
    whole = planned_for(RandomBinary(), 0.0)
    dense_e = _dense(whole, radiance, code, progress)
    dense = _signal(whole, dense_e)
    dense_s = time.perf_counter() - start
    valid = dense_e < camera.sensor.full_well_e
    noise = np.sqrt(dense_e + camera.sensor.read_noise_e**2)
    errors = {tolerance: ((frame - dense) / noise)[valid] for tolerance, frame in frames.items()}
    best_s, error = seconds[_TOLERANCE], errors[_TOLERANCE]
    return {
        "name": name,
        "value": 1 / best_s,
        "unit": "frames/s",
        "peer": "every slot dense",
        "peer_value": 1 / dense_s,
        "ratio": dense_s / best_s,
        "conditions": {
            "panel": f"{camera.panel_cols} x {camera.panel_rows}",
            "ccd": f"{camera.sensor.cols} x {camera.sensor.rows}",
            "slots": camera.slots_per_frame,
            "moving_share": share,
            "max_error_in_tolerance": float(np.sqrt(np.mean(error**2)) / _TOLERANCE),
            "worst_pixel_error_in_noise": float(np.abs(error).max()),
            "time_against_error": [
                {
                    "tolerance_in_noise": tolerance,
                    "seconds": seconds[tolerance],
                    "rms_error_in_noise": float(np.sqrt(np.mean(errors[tolerance] ** 2))),
                }
                for tolerance in sorted(seconds)
            ],
            "valid_share": float(valid.mean()),
            "tolerance": f"{_TOLERANCE:g} of the predicted noise, rms over pixels below the full well",
            "process_peak_mb": peak_mb,
            "seconds_with_adaptive_codes": adaptive_s,
            "note": "a further frame of a sequence, with its noise, the error without; best of "
            f"{_ROUNDS}, dense and tolerance 0 once",
        },
    }


def _seconds_a_frame(camera: CodedCamera, radiance: RadianceVideo, code: ExposureCode, rounds: int) -> float:
    """Best time of a further frame of a sequence, with its noise."""
    camera.relay_operator()  # built once for an alignment
    light, panel = camera.form_image(radiance), None
    seconds: list[float] = []
    for turn in range(1 + rounds):
        start = time.perf_counter()
        _, panel = camera.expose(light, turn, code, panel, np.random.default_rng(turn))
        seconds.append(time.perf_counter() - start)
    return min(seconds[1:])


def _signal(camera: CodedCamera, expected_e: Doubles) -> Doubles:
    """Signal without noise, electrons: with smear, the full well's clip and what bends below it."""
    return camera.sensor.signal_e(expected_e, camera.exposure_s, camera.serial_number)


def moving_patches(camera: CodedCamera, share: float, rng: np.random.Generator) -> RadianceVideo:
    """Make the scene: patches whose ways cover a share of the field.

    Parameters
    ----------
    camera : CodedCamera
        Decides the grid and the slots.
    share : float
        Of the field, 0..1.
    rng : Generator
        Of textures.

    Returns
    -------
    RadianceVideo
        One instant a slot; coded frames that are all alike.
    """
    view, n_slots = camera.view, camera.slots_per_frame
    base = _texture(rng, view.rows, view.cols)
    base[view.rows // 6 : view.rows // 2, view.cols // 8 : view.cols * 3 // 8] *= _WINDOW
    (height, width), places = _ways(view.rows, view.cols, share)
    textures = [_texture(np.random.default_rng(mover), height, width) for mover in range(_MOVERS)]
    segments: list[Segment] = []
    for first in range(0, n_slots, _SEGMENT):
        blocks: list[Block] = []
        for (row, col), texture in zip(places, textures, strict=True):
            under = base[row : row + height, col : col + width]
            slots = first + np.arange(_SEGMENT)
            excess = np.stack([_patch(texture, slot / n_slots, under) for slot in slots])
            blocks.append(Block(row, col, excess))
        segments.append(Segment(base, base, tuple(blocks), _SEGMENT))
    return RadianceVideo.on_view(
        view,
        camera.slot_s,
        lambda index: segments[index % len(segments)],
        slots_per_segment=_SEGMENT,
        n_slots=(1 + _ROUNDS) * n_slots,
        white_w_m2_sr=_WHITE,
    )


def _ways(rows: int, cols: int, share: float) -> tuple[tuple[int, int], list[tuple[int, int]]]:
    """Two rows of ways, each a rectangle that a textured patch crosses: height and width, and corners."""
    columns, side = _MOVERS // 2, np.sqrt(share)
    size = int(rows // 2 * side), int(cols // columns * side)
    return size, [(m // columns * (rows // 2), m % columns * (cols // columns)) for m in range(_MOVERS)]


def _texture(rng: np.random.Generator, rows: int, cols: int) -> Floats:
    """Reflectances of about 0.1 to 1 in patches of some samples, times the white."""
    coarse = rng.random((-(-rows // 8), -(-cols // 8)), np.float32)
    fine = np.repeat(np.repeat(coarse, 8, 0), 8, 1)[:rows, :cols]
    return np.asarray(_WHITE * 10 ** (ndimage.gaussian_filter(fine, 1.5) * 2 - 1.5), np.float32)


def _patch(texture: Floats, place: float, under: Floats) -> Floats:
    """Excess of a patch half as wide as its way, a share of the way along."""
    rows, cols = texture.shape
    half = max(1, cols // 2)
    left = round(place * (cols - half))
    excess = np.zeros((rows, cols), np.float32)
    excess[:, left : left + half] = texture[:, :half] - under[:, left : left + half]
    return excess


def _random_code(camera: CodedCamera, rng: np.random.Generator) -> Bytes:
    shape = camera.slots_per_frame, camera.panel_rows, camera.panel_cols
    return (rng.random(shape, np.float32) < 0.5).astype(np.uint8) * np.uint8(255)


def _adaptive_code(camera: CodedCamera, scheme: MotionAdaptive, share: float) -> ExposureCode:
    """Code that the adaptive scheme would show, had it found out where something moves."""
    panel, rng = (camera.panel_rows, camera.panel_cols), np.random.default_rng(36)
    static, moving = (
        PeriodicCode(each.tiles(camera.slots_per_frame, camera.coded_slots, rng), panel).levels(0)
        for each in (scheme.static, scheme.moving)
    )
    (height, width), places = _ways(*panel, share)
    moves = np.zeros(panel, np.bool_)
    for row, col in places:
        moves[row : row + height, col : col + width] = True
    return ExposureCode(np.where(moves, moving, static), moves)


def _dense(camera: CodedCamera, radiance: RadianceVideo, code: ExposureCode, progress: Progress) -> Doubles:
    """Compute the expected electrons, each slot a whole picture, the camera's parts put together anew."""
    whole = replace(radiance, slots_per_segment=1, load=partial(_picture, radiance))
    irradiance = camera.form_image(whole)
    panel, sensor, serial = camera.modulator, camera.sensor, camera.serial_number
    stuck, stuck_levels = panel.stuck(camera.panel_rows, camera.panel_cols, serial)
    levels = np.where(stuck, stuck_levels, code.levels)
    rest, response = camera.panel_at_rest(), camera.panel_response
    weights, _ = slot_weights(levels, rest, response, camera.slot_s, leak=camera.column_leaks)
    course = levels, rest, response, camera.slot_s, 1, camera.column_leaks
    fringe = panel.fringe_correction(*course, radiance.samples_per_pitch)
    assert fringe is not None, "the full model has the fringe-field correction"
    passed = cell_weights(fringe, weights)
    gain = whole_cells(camera.panel_gain, radiance.samples_per_pitch)
    relay = camera.relay_operator()
    arrived = np.zeros((sensor.rows, sensor.cols))
    for slot in range(camera.slots_per_frame):
        arrived += relay.apply(passed[slot] * gain * irradiance.load(slot).start * camera.slot_s)
        progress("dense", slot + 1, camera.slots_per_frame)
    efficiency = sensor.efficiency_at(camera.wavelength_m) * sensor.pixel_response(serial)
    electrons = arrived * sensor.pixel_area_m2 * photons_per_joule(camera.wavelength_m) * efficiency
    return electrons + sensor.dark_rate_e_s * camera.exposure_s


def _picture(radiance: RadianceVideo, slot: int) -> Segment:
    """One slot as a segment without blocks."""
    segment, place = divmod(slot, radiance.slots_per_segment)
    image = radiance.load(segment).instant(place)
    return Segment(image, image, (), 1)
