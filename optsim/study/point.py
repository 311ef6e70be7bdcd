"""A point of a study: an experiment with some keys changed, and what its calibration knows of the change."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

from optsim.camera.camera import CodedCamera
from optsim.core.config import Table, build, flat, override
from optsim.core.errors import ConfigError, unknown_name
from optsim.core.units import parse_quantity
from optsim.experiment.experiment import Experiment

Mode = Literal["known", "unknown", "compensated"]
MODES: tuple[Mode, ...] = get_args(Mode)
_CAMERA = "camera."
# Parts behind the light on the panel: what changes in them leaves the truth as it is.
_AFTER_THE_PANEL = ("relay", "splitter", "modulator", "sensor")
# What is known, and what is done with it: neither is of the light.
_OF_THE_DECODER = ("calibration", "reading_px", "methods", "drift", "drift_per_frame")
# Their keys that the truth depends on all the same.
_IN_THE_TRUTH = ("camera.splitter.scene_light", "camera.splitter.azimuth_rad")
_MOST_VALUES = 1000


@dataclass(frozen=True)
class Point:
    """Changes of an experiment, and how they count."""

    # Keys of the experiment, ``camera.relay.shift_x_px`` for example, and their values.
    changes: tuple[tuple[str, Any], ...] = ()
    # "known" to the calibration, "unknown" to it, or "compensated": unknown, then put right.
    mode: Mode = "known"
    compensators: tuple[str, ...] = ()  # Of the mode "compensated".
    seed: int = 1  # Of codes and photons. The bench keeps the experiment's own.

    def as_json(self) -> dict[str, Any]:
        """Return its content for a JSON file."""
        return {
            "changes": dict(self.changes),
            "mode": self.mode,
            "compensators": list(self.compensators),
            "seed": self.seed,
        }


@dataclass(frozen=True)
class Axis:
    """A key that is varied, and its values in their order."""

    key: str
    values: tuple[Any, ...]

    @property
    def label(self) -> str:
        """Key as a user writes it."""
        return self.key.removeprefix(_CAMERA)


def full_key(experiment: Experiment, key: str) -> str:
    """Find the experiment's key that a user means: ``relay.shift_x_px`` is of the camera."""
    table = experiment.model_dump(mode="json")
    first = key.strip().partition(".")[0]
    full = f"{_CAMERA}{key.strip()}" if first in CodedCamera.model_fields else key.strip()
    # Lists are reached by name, and an override will tell.
    if first == "methods" or full in flat(table):
        return full
    keys = [name.removeprefix(_CAMERA) for name in flat(table) if not name.startswith("drift")]
    raise unknown_name("parameter", key.strip(), keys)


def parse_axis(experiment: Experiment, text: str) -> Axis:
    """Read ``KEY=FIRST:LAST:COUNT`` or ``KEY=VALUE,VALUE,...``.

    Raises
    ------
    ConfigError
        For an unknown key, an empty range or values that cannot be read.
    """
    key, equals, said = text.partition("=")
    if not equals or not said.strip():
        raise ConfigError(
            f"--vary {text!r}: got no values, expected KEY=FIRST:LAST:COUNT or KEY=VALUE,VALUE,..., "
            "for example relay.rotation_rad=-2e-3:2e-3:9"
        )
    full = full_key(experiment, key)
    ends = said.split(":")
    if len(ends) == 1:
        values = tuple(_value(experiment, full, each) for each in said.split(","))
        if len(set(map(str, values))) < len(values):
            raise ConfigError(f"--vary {text!r}: got a value twice, expected values that differ")
        return Axis(full, values)
    if len(ends) != 3:
        raise ConfigError(f"--vary {text!r}: got {len(ends)} numbers, expected FIRST:LAST:COUNT")
    first, last = (_value(experiment, full, end) for end in ends[:2])
    count = int(ends[2]) if ends[2].strip().isdecimal() else 0
    if not isinstance(first, int | float) or not isinstance(last, int | float):
        raise ConfigError(f"--vary {text!r}: got no numbers, expected FIRST:LAST:COUNT")
    if not 2 <= count <= _MOST_VALUES or first == last:
        raise ConfigError(
            f"--vary {text!r}: got an empty range, expected FIRST and LAST that differ and a COUNT of 2 "
            f"to {_MOST_VALUES}"
        )
    # Steps from both ends, so that the middle of a symmetric range is exactly 0.
    steps = count - 1
    # Twelve digits, as a user would write them: 0.1 and not 0.10000000000000002.
    even = (float(f"{(first * (steps - k) + last * k) / steps:.12g}") for k in range(count))
    return Axis(full, tuple(even))


def _value(experiment: Experiment, key: str, text: str) -> Any:
    if isinstance(flat(experiment.model_dump(mode="json")).get(key), str):
        # calibration=true is a word, no truth value.
        return text.strip()
    try:
        return tomllib.loads(f"value = {text.strip()}")["value"]
    except tomllib.TOMLDecodeError:
        if text.strip()[:1].isdigit() or text.strip()[:1] in "+-.":
            try:
                return parse_quantity(key.rpartition(".")[2], text.strip())
            except ValueError as error:
                raise ConfigError(f"--vary {key}: got {text.strip()!r}: {error}") from None
        return text.strip()


def changed_only(experiment: Experiment, changes: Mapping[str, Any]) -> tuple[tuple[str, Any], ...]:
    """Leave out changes to the value that the experiment has already, so that equal points are one."""
    now = flat(experiment.model_dump(mode="json"))
    return tuple((key, value) for key, value in changes.items() if key not in now or now[key] != value)


def experiment_at(base: Experiment, point: Point) -> Experiment:
    """Return the experiment of a point: known changes are of the camera, others of its drift."""
    if point.mode != "known" and any(not key.startswith(_CAMERA) for key, _ in point.changes):
        names = ", ".join(key for key, _ in point.changes)
        raise ConfigError(f"{names}: only the camera drifts; cure: --curves known")
    table: Table = base.model_dump(mode="json")
    if point.mode == "known":
        made = build(Experiment, _with(table, point.changes), where="point")
    else:
        drifts = [(f"drift.{key.removeprefix(_CAMERA)}", value) for key, value in point.changes]
        made = build(Experiment, _with(table, drifts), where="point")
    made.camera.geometry().check()
    made.at_work().geometry().check()
    return made


def _with(table: Table, changes: Sequence[tuple[str, Any]]) -> Table:
    return override(table, [f"{key}={json.dumps(value)}" for key, value in changes])


def shares_truth(point: Point) -> bool:
    """Whether the light on the panel, the target of all scores, is that of the unchanged experiment."""
    parts = [key.removeprefix(_CAMERA).partition(".")[0] for key, _ in point.changes]
    return all(part in (*_AFTER_THE_PANEL, *_OF_THE_DECODER) for part in parts) and not any(
        key in _IN_THE_TRUTH or key in _IMAGE_KEYS for key, _ in point.changes
    )


# Of the parts behind the panel, what sets its picture and timing.
_IMAGE_KEYS = (
    "camera.modulator.pitch_m",
    "camera.modulator.field_rate_hz",
    "camera.sensor.rows",
    "camera.sensor.cols",
)
