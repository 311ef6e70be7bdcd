"""What a mechanic can hold: the parameters of a tolerance sheet, their units, and a bad specimen's values.

``usual`` is the excess of this project's pessimistic camera over the nominal one
(:mod:`optsim.camera.effects`), a judgement without a source unless the effect states one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from optsim.core.config import flat
from optsim.experiment.experiment import Experiment


@dataclass(frozen=True)
class Tolerated:
    """A parameter with its tolerance."""

    name: str
    unit: str  # On the drawing.
    per_unit: float  # Change in the key's own unit for one unit of the drawing.
    keys: tuple[str, ...]  # Keys that change together.
    how: Literal["add", "times"]  # Whether a change is added, or multiplies by one plus it.
    first: float  # Change at which a search begins; key's own unit.
    most: float  # Largest one that is tried.
    usual: float  # A bad specimen's.
    about: str = ""  # What it stands for, where the name does not say all.
    signs: tuple[int, ...] = (1, -1)  # Which way it may change: upwards first.
    period: float | None = None  # Change that brings the panel back onto the CCD's pixels, key's own unit.

    @property
    def bad_specimen(self) -> tuple[float, float]:
        """Largest change of a bad specimen downwards and upwards, both positive, in the key's own unit."""
        return (self.usual if -1 in self.signs else 0.0), (self.usual if 1 in self.signs else 0.0)

    def changes(self, experiment: Experiment, change: float) -> dict[str, Any]:
        """Keys and values of the experiment changed by so much."""
        now = flat(experiment.model_dump(mode="json"))
        return {key: now[key] + change if self.how == "add" else now[key] * (1 + change) for key in self.keys}

    def shown(self, change: float) -> float:
        """Return a change in the unit of the drawing."""
        return change / self.per_unit


def _relay(key: str) -> tuple[str, ...]:
    return (f"camera.relay.{key}",)


def _panel(*keys: str) -> tuple[str, ...]:
    return tuple(f"camera.modulator.{key}" for key in keys)


ALL: dict[str, Tolerated] = {
    each.name: each
    for each in (
        Tolerated("shift_x", "CCD px", 1.0, _relay("shift_x_px"), "add", 0.2, 20.0, 1.0, period=1.0),
        Tolerated("shift_y", "CCD px", 1.0, _relay("shift_y_px"), "add", 0.2, 20.0, 1.0, period=1.0),
        Tolerated("rotation", "mrad", 1e-3, _relay("rotation_rad"), "add", 1e-3, 0.05, 1e-3),
        Tolerated(
            "tilt",
            "% keystone",
            1e-2,
            _relay("keystone_y"),
            "add",
            1e-3,
            0.1,
            2e-3,
            "keystone of a tilted panel; its blur towards the edges is not modelled",
        ),
        Tolerated("magnification", "%", 1e-2, _relay("magnification_error"), "add", 1e-3, 0.02, 3e-3),
        Tolerated("defocus", "um", 1e-6, _relay("defocus_m"), "add", 20e-6, 1e-3, 36e-6, "of the CCD"),
        Tolerated(
            "distortion", "%", 1e-2, _relay("distortion"), "add", 2e-3, 0.1, 7e-3, "at the panel's corners"
        ),
        Tolerated(
            "contrast",
            "% of light",
            1e-2,
            _panel("depolarised_share"),
            "add",
            5e-3,
            0.5,
            0.0763,
            "depolarised by the panel; half of it passes where the panel is dark, and less of it is no fault",
            signs=(1,),
        ),
        Tolerated(
            "response",
            "%",
            1e-2,
            _panel("tau_on_s", "tau_off_s"),
            "times",
            0.2,
            3.0,
            0.5,
            "both time constants of the panel",
        ),
        Tolerated("synchronisation", "ms", 1e-3, _panel("delay_s"), "add", 0.1e-3, 5e-3, 0.5e-3),
        Tolerated(
            "temperature",
            "K",
            1.0,
            _panel("temperature_c") + _relay("mount.temperature_c"),
            "add",
            5.0,
            40.0,
            5.0,
            "of panel and mount: response, and what the lengths in camera.relay.mount move; 0 m by default",
        ),
    )
}
"""All parameters of a sheet by name."""
