"""Lamps: rectangular area lights, steady or flickering by a closed form."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field, field_validator, model_validator

from optsim.core.config import Part
from optsim.core.errors import ValueCheckError
from optsim.scene.bands import PositiveByBand
from optsim.scene.fields import Positive, Share, Vector
from optsim.scene.parts import check_edges
from optsim.scene.textures import OUTSIDES


class Sine(Part):
    """Relative radiance ``1 + depth sin(2 pi (frequency_hz t + phase_turns))``: a lamp on the mains.

    Parameters
    ----------
    frequency_hz : float
        Frequency of the light: 100 or 120 Hz on mains of 50 or 60 Hz.
    depth : float
        Amplitude over mean.
    phase_turns : float
        Phase at time 0, in periods.
    """

    kind: Literal["sine"] = "sine"
    frequency_hz: Positive
    depth: Share = 1.0
    phase_turns: float = 0.0

    def gain(self, start_s: float, length_s: float) -> float:
        """Mean relative radiance over an interval, exact at any length."""
        middle = (self.frequency_hz * (start_s + length_s / 2) + self.phase_turns) % 1.0
        share = np.sinc(self.frequency_hz * length_s)
        return float(1 + self.depth * np.sin(2 * np.pi * middle) * share)


class Pwm(Part):
    """Full on during a share of each period and off in the rest, with mean 1: a dimmed LED.

    Parameters
    ----------
    frequency_hz : float
        Pulses per second.
    duty : float
        Share of the period in which it is on, from its start.
    phase_turns : float
        Phase at time 0, in periods.
    """

    kind: Literal["pwm"] = "pwm"
    frequency_hz: Positive
    duty: float = Field(0.5, gt=0, le=1)
    phase_turns: float = 0.0

    def gain(self, start_s: float, length_s: float) -> float:
        """Mean relative radiance over an interval, exact at any length."""
        turns = self.frequency_hz * length_s
        place = (self.frequency_hz * start_s + self.phase_turns) % 1.0
        if turns == 0:
            return 1 / self.duty if place < self.duty else 0.0
        # Whole periods have one pulse each; the rest overlaps this period's pulse and perhaps the next one's.
        # The overlap uses differences below one period, so that a short interval loses no precision.
        whole = np.floor(turns)
        rest = turns - whole
        lit = min(rest, max(0.0, self.duty - place)) + min(self.duty, max(0.0, rest - (1.0 - place)))
        return float((whole + lit / self.duty) / turns)


Flicker = Annotated[Sine | Pwm, Field(discriminator="kind")]


class Lamp(Part):
    """Rectangular area light facing ``edge_u x edge_v``, uniform or with an HDR picture.

    Parameters
    ----------
    center_m, edge_u_m, edge_v_m : vector
        Centre and full edges.
    radiance_w_m2_sr : float or dict
        Radiance in the band, or a table of it by band. With flicker it is the mean over a period. With a
        picture it is that of the picture's relative 1.
    picture : str or None
        Name of an outside in :mod:`optsim.scene.textures`: the lamp is then a window with a view outside.
    sampling_weight : float
        Share of light samples, relative to other lamps; lowest noise at about its share of the light.
    flicker : Sine, Pwm or None
        Change of the radiance with time; None is steady.
    lit : bool
        Whether it emits; an unlit lamp stays as a black rectangle, so that the geometry is the same.
    """

    center_m: Vector
    edge_u_m: Vector
    edge_v_m: Vector
    radiance_w_m2_sr: PositiveByBand
    picture: str | None = None
    sampling_weight: Positive = 1.0
    flicker: Flicker | None = None
    lit: bool = True

    @field_validator("picture")
    @classmethod
    def _known(cls, name: str | None) -> str | None:
        if name is not None and name not in OUTSIDES:
            raise ValueError(f"unknown outside; expected one of: {', '.join(OUTSIDES)}")
        return name

    @model_validator(mode="after")
    def _rectangle(self) -> Lamp:
        check_edges(self.edge_u_m, self.edge_v_m, orthogonal=True)
        return self

    def gain(self, start_s: float, stop_s: float) -> float:
        """Mean radiance over an interval, relative to ``radiance_w_m2_sr``.

        Parameters
        ----------
        start_s, stop_s : float
            Interval, s; if both are the same, the instant itself.

        Returns
        -------
        float
            Closed form; 1 without flicker. An unlit lamp has a gain too, but emits nothing.

        Raises
        ------
        ValueCheckError
            When the interval ends before it starts.
        """
        if not stop_s >= start_s:
            raise ValueCheckError(
                f"gain of a lamp: got an interval from {start_s} to {stop_s} s, which ends first"
            )
        return 1.0 if self.flicker is None else self.flicker.gain(start_s, stop_s - start_s)


def flicker_key(lamp: Lamp) -> str:
    """Name of a lamp's flicker, the same for lamps with the same flicker: ``steady``, or kind and numbers."""
    if lamp.flicker is None:
        return "steady"
    numbers = lamp.flicker.model_dump(exclude={"kind"})
    return " ".join([lamp.flicker.kind, *(f"{name}={value!r}" for name, value in numbers.items())])
