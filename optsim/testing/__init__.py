"""Contracts of decoders, schemes, metrics, parts and objects of another package, for its own tests.

Each function raises ``AssertionError`` with the rule that was broken.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from optsim.calibration import Calibration
from optsim.camera.camera import CodedCamera
from optsim.camera.hardware import demo
from optsim.camera.true_calibration import ideal_calibration
from optsim.coding import RandomExposure
from optsim.core.config import Part
from optsim.core.quantities import Bools, CodedFrame, ExposureCode, IrradianceVideo, Segment
from optsim.metrics import FrameMetric, Metric

_ROWS, _COLS, _FRAMES = 24, 32, 3
_WHITE_CD_M2 = 500.0

__all__ = ["check_decoder", "check_metric", "check_object", "check_part", "check_scheme"]


def check_decoder(decoder: Any) -> None:
    """Hold a decoder to its contract, on three frames of a still picture under random exposures.

    One reconstruction a frame, of finite light that is nowhere negative, from this frame and those before
    alone, the same each time.

    Parameters
    ----------
    decoder : Part
        An instance with ``decode(frames, calibration)``.

    Raises
    ------
    AssertionError
        With the rule that it breaks.
    """
    calibration, frames = _film(RandomExposure())
    found = list(decoder.decode(iter(frames), calibration))
    _hold([each.index for each in found] == list(range(_FRAMES)), "one reconstruction a frame, in order")
    for each in found:
        video = each.irradiance_w_m2
        _hold(video.shape == (calibration.slots_per_frame, _ROWS, _COLS), "light is (slot, v, u)")
        _hold(video.dtype == np.float32, "light is float32")
        _hold(np.isfinite(video[:, each.valid]).all(), "valid light is finite")
        _hold((video[:, each.valid] >= 0).all(), "light is not negative")
        for name in ("valid", "interpolated", "moving"):
            _hold(_is_mask(getattr(each, name)), f"{name} is a mask (v, u), bool")
    again = list(decoder.decode(iter(frames[:2]), calibration))
    for one, two in zip(again, found, strict=False):
        same = np.array_equal(one.irradiance_w_m2, two.irradiance_w_m2, equal_nan=True)
        _hold(same, "a frame is decoded from itself and those before, the same each time")


def check_scheme(scheme: Any) -> None:
    """Hold a scheme to its contract: codes of the panel's size, dark while the shutter is closed.

    Each is a function of the generator and of the frames that have arrived.

    Parameters
    ----------
    scheme : Part
        An instance with ``init(calibration, rng)`` and ``next(index, arrived, state)``.

    Raises
    ------
    AssertionError
        With the rule that it breaks.
    """
    camera, calibration = _camera()
    _, frames = _film(scheme)
    state = scheme.init(calibration, np.random.default_rng(0))
    for index, frame in enumerate(frames):
        code, state = scheme.next(index, frames[: max(0, index - camera.latency_frames + 1)], state)
        levels, expected = code.levels, (calibration.slots_per_frame, _ROWS, _COLS)
        _hold(levels.shape == expected and levels.dtype == np.uint8, "levels are (slot, v, u), uint8")
        _hold(_is_mask(code.moving), "moving is a mask (v, u), bool")
        _hold(not levels[calibration.coded_slots :].any(), "dark in slots with the shutter closed")
        same = np.array_equal(levels, frame.code.levels)
        _hold(same, "the same frames and generator give the same code")


def check_metric(metric: Metric | FrameMetric) -> None:
    """Hold a metric to its contract: a name with its parameters, a unit, and worse for more noise.

    Parameters
    ----------
    metric : Metric or FrameMetric
        An instance without arguments. Sums of a ``Metric`` over disjoint masks add up.

    Raises
    ------
    AssertionError
        With the rule that it breaks.
    """
    _hold("[" in metric.name, "the name holds the parameters, in brackets")
    typed = (type(metric.unit), type(metric.higher_is_better)) == (str, bool)
    _hold(typed, "a metric has a unit and a direction")
    if not isinstance(metric, Metric):
        return
    rng = np.random.default_rng(1)
    truth = rng.uniform(1, _WHITE_CD_M2, (4, 12, 15)).astype(np.float32)
    everywhere, some = np.ones(truth.shape[1:], np.bool_), rng.random(truth.shape[1:]) < 0.4

    def of(sigma: float, where: Bools) -> tuple[float, int]:
        noise = np.random.default_rng(2).standard_normal(truth.shape)
        noisy = (truth * np.exp(sigma * noise)).astype(np.float32)
        return metric.sum_errors(noisy, truth, where, _WHITE_CD_M2)

    less, more = (metric.finish(*of(sigma, everywhere)) for sigma in (0.02, 0.3))
    _hold(less is not None and more is not None and np.isfinite([less, more]).all(), "scores are finite")
    _hold(((less or 0) > (more or 0)) == metric.higher_is_better, "more noise is a worse score")
    _hold(metric.finish(0.0, 0) is None, "nothing compared is None")
    (one, n_one), (two, n_two), (both, n_both) = of(0.1, some), of(0.1, ~some), of(0.1, everywhere)
    _hold(n_one + n_two == n_both, "counts of disjoint masks add up")
    _hold(np.isclose(one + two, both, rtol=1e-9), "sums of disjoint masks add up")


def check_part(part: Part, place: str) -> None:
    """Hold a part of the camera to its contract: frozen, itself again from a table, and light arrives.

    Parameters
    ----------
    part : Part
        An instance of a subclass of the part at that place.
    place : {"objective", "splitter", "modulator", "relay", "sensor"}
        Key of the camera.

    Raises
    ------
    AssertionError
        With the rule that it breaks.
    """
    camera, _ = _camera()
    made = CodedCamera.model_validate({**camera.model_dump(), place: part.model_dump()})
    _hold(getattr(made, place) == part, "a part is itself again from its table")
    _hold(hash(part) == hash(getattr(made, place)), "equal parts have equal hashes")
    light, rng = _light(made), np.random.default_rng(0)
    bright, dark = (made.expose(light, 0, _code(made, level), None, rng)[0].dn.mean() for level in (255, 0))
    _hold(bright > dark, "an open panel brings more light than a dark one")


def check_object(thing: Any) -> None:
    """Hold an object or mover of a scene to its contract: a mesh of finite points, the same each time.

    Parameters
    ----------
    thing : Part
        An object with ``material`` and ``mesh()``, or a mover with ``material``, ``rest()`` and
        ``vertices(time_s)``. Vertices keep their number and order at all times.

    Raises
    ------
    AssertionError
        With the rule that it breaks.
    """
    _hold(isinstance(thing.material, str), "a thing names its material")
    moves = hasattr(thing, "vertices")
    mesh = thing.rest() if moves else thing.mesh()
    corners, faces = mesh.vertices_m, mesh.faces
    _hold(corners.shape[1:] == (3,) and np.isfinite(corners).all(), "vertices are (n, 3), m, finite")
    _hold(faces.shape[1:] == (3,), "faces are (m, 3)")
    _hold(faces.min() >= 0 and faces.max() < len(corners), "faces are made of vertices")
    for time_s in (0.0, 0.01, 1.7) if moves else ():
        there, again = thing.vertices(time_s), thing.vertices(time_s)
        _hold(there.shape == corners.shape and np.isfinite(there).all(), "vertices keep their number")
        _hold(np.array_equal(there, again), "vertices are a function of the time alone")
    _hold(not moves or np.allclose(thing.vertices(0.0), corners), "a mover rests where it is at time 0")
    _hold(type(thing)(**thing.model_dump()) == thing, "a thing is itself again from its table")


def _hold(condition: object, rule: str) -> None:
    if not condition:
        raise AssertionError(rule)


def _is_mask(found: Any) -> bool:
    return found.shape == (_ROWS, _COLS) and found.dtype == np.bool_


def _camera() -> tuple[CodedCamera, Calibration]:
    """Small camera, and its ideal calibration."""
    whole = demo()
    sensor = whole.sensor.model_copy(update={"rows": 3 * _ROWS + 8, "cols": 3 * _COLS + 8})
    small = {"panel_rows": _ROWS, "panel_cols": _COLS, "sensor": sensor}
    camera = whole.model_copy(update=small)
    return camera, ideal_calibration(camera, 1)


def _light(camera: CodedCamera) -> IrradianceVideo:
    """Light of two halves, which fill half of the well and a tenth."""
    most_e, _ = camera.expected_electrons(_halves(camera, 1e-6, 1e-6), 0, _code(camera, 255), None)
    full = 1e-6 * camera.sensor.full_well_e / float(most_e.max())
    return _halves(camera, 0.5 * full, 0.1 * full)


def _halves(camera: CodedCamera, left: float, right: float) -> IrradianceVideo:
    view, slots = camera.view, camera.slots_per_frame
    image = np.full((view.rows, view.cols), left, np.float32)
    image[:, view.cols // 2 :] = right
    segment, n_slots = Segment(image, image, (), slots), slots * _FRAMES
    return IrradianceVideo.on_view(
        view, camera.slot_s, lambda _: segment, slots_per_segment=slots, n_slots=n_slots
    )


def _code(camera: CodedCamera, level: int) -> ExposureCode:
    levels = np.full((camera.slots_per_frame, _ROWS, _COLS), level, np.uint8)
    levels[camera.coded_slots :] = 0
    return ExposureCode(levels, np.zeros((_ROWS, _COLS), np.bool_))


def _film(scheme: Any) -> tuple[Calibration, Sequence[CodedFrame]]:
    """Three frames of the picture under a scheme."""
    camera, calibration = _camera()
    light, state = _light(camera), scheme.init(calibration, np.random.default_rng(0))
    frames: list[CodedFrame] = []
    panel = None
    for index in range(_FRAMES):
        code, state = scheme.next(index, frames[: max(0, index - camera.latency_frames + 1)], state)
        frame, panel = camera.expose(light, index, code, panel, np.random.default_rng(index))
        frames.append(replace(frame, index=index))
    return calibration, frames
