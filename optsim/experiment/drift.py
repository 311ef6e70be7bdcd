"""Drift of a camera after its calibration: before the first frame, and from frame to frame."""

from __future__ import annotations

from optsim.camera.camera import CodedCamera
from optsim.core.config import Table, build, flat, merged, override
from optsim.core.errors import ConfigError, unknown_name
from optsim.core.units import parse_quantity


def drifted_camera(camera: CodedCamera, drift: Table, per_frame: Table, frame: int) -> CodedCamera:
    """Camera at the start of a coded frame; arguments as in ``Experiment``.

    Raises
    ------
    ConfigError
        For an unknown key, one that truth and calibration depend on, or a change a frame that is no number.
    """
    if not drift and not per_frame:
        return camera
    for name, table in (("drift", drift), ("drift_per_frame", per_frame)):
        if "objective" in table:
            raise ConfigError(
                f"{name}.objective: got one, but the truth is the light behind the objective as it is; "
                "change camera.objective, or let the relay, splitter, modulator or sensor drift"
            )
    table = merged(camera.model_dump(), drift)
    found = build(CodedCamera, table, where="drift")
    if per_frame:
        now = flat(found.model_dump())
        rates = flat(per_frame).items()
        changes = [f"{key}={_start(now, key) + frame * _rate(key, rate)!r}" for key, rate in rates]
        found = build(CodedCamera, override(table, changes), where=f"drift_per_frame, frame {frame}")
    if _fixed(camera) != _fixed(found):
        raise ConfigError(
            f"drift: got {merged(drift, per_frame)}, expected what leaves the scene's picture, the timing "
            "and the size of the CCD as they are: truth and calibration are of those; change camera itself"
        )
    return found


def _fixed(camera: CodedCamera) -> tuple[object, ...]:
    """Return what no drift may change."""
    size = camera.sensor.rows, camera.sensor.cols
    return camera.view, camera.timing(1), camera.coded_slots, camera.wavelength_m, size


def _start(now: Table, key: str) -> float:
    numbers = {name: value for name, value in now.items() if isinstance(value, float)}
    if key not in numbers:
        raise unknown_name("drift_per_frame: key of a number", key, numbers)
    return numbers[key]


def _rate(key: str, value: object) -> float:
    try:
        rate = parse_quantity(key, value) if isinstance(value, str) else value
    except ValueError as error:
        raise ConfigError(f"drift_per_frame.{key}: got {value!r}; {error}; fix: a change a frame") from None
    if isinstance(rate, bool) or not isinstance(rate, int | float):
        raise ConfigError(f"drift_per_frame.{key}: got {value!r}, expected a change a frame, a number")
    return rate
