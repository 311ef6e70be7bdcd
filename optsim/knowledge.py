"""What schemes and decoders know of a camera, and how much of it they read."""

from __future__ import annotations

from typing import Annotated, Literal, NamedTuple

from pydantic import AfterValidator, BeforeValidator, Field

# Widest square that is read, over a panel pixel: a sensible default, no source.
_WIDEST = 1.2


def _true_is_a_word(value: object) -> object:
    """Read ``calibration=true``, which TOML takes for a truth value, as the word that was meant."""
    return "true" if value is True else value


# What is known of the camera: what the bench found, the simulator's own parameters, or the paper's equations.
Operator = Annotated[Literal["bench", "true", "ideal"], BeforeValidator(_true_is_a_word)]


def _with_a_middle(value: int) -> int:
    if value % 2 == 0:
        raise ValueError("expected an odd number: a square around the pixel at the centre")
    return value


# CCD pixels to a side of the square that is read for a panel pixel.
ReadingPx = Annotated[int, Field(ge=1, le=9), AfterValidator(_with_a_middle)]


class Known(NamedTuple):
    """What schemes and decoders know of the camera, and what they read of it.

    Parameters
    ----------
    operator : {"bench", "true", "ideal"}
        Where the calibration is from.
    reading_px : int
        CCD pixels to a side of the square that is read for a panel pixel.
    """

    operator: Operator
    reading_px: int

    def __str__(self) -> str:
        """Name it, in reports."""
        square = f", {self.reading_px} x {self.reading_px} CCD pixels read" if self.reading_px > 1 else ""
        return self.operator + square


def widest_reading(ratio: float) -> int:
    """CCD pixels to a side of the widest square that may be read, at so many to a panel pixel."""
    return max(1, int((_WIDEST * ratio - 1) // 2) * 2 + 1)
