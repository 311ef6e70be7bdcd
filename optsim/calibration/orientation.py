"""Orientation of the panel's image: the directions in which panel rows and columns count up on the CCD."""

from __future__ import annotations

from optsim.core.quantities import Doubles

Orientation = tuple[str, str]
"""Directions of panel rows and panel columns on the CCD's image, such as ("down", "right")."""

_STEPS = {"down": (1, 0), "up": (-1, 0), "right": (0, 1), "left": (0, -1)}
UPRIGHT: Orientation = ("down", "right")
DIRECTIONS: tuple[Orientation, ...] = tuple(
    (rows, cols) for rows in _STEPS for cols in _STEPS if (rows in ("down", "up")) != (cols in ("down", "up"))
)
_NAMES = {
    ("down", "right"): "upright",
    ("down", "left"): "mirrored left to right",
    ("up", "right"): "mirrored top to bottom",
    ("up", "left"): "turned by 180 degrees",
    ("right", "down"): "transposed",
    ("left", "up"): "transposed about the other diagonal",
    ("right", "up"): "turned by 90 degrees, anticlockwise",
    ("left", "down"): "turned by 90 degrees, clockwise",
}


def orientation_of(slope: Doubles) -> Orientation:
    """Return the nearest of the eight orientations to a map."""

    def agreement(each: Orientation) -> float:
        return sum(float(slope[axis] @ _STEPS[step]) for axis, step in enumerate(each))

    return max(DIRECTIONS, key=agreement)


def in_words(orientation: Orientation) -> str:
    """Describe an orientation."""
    rows, cols = orientation
    return f"{_NAMES[orientation]}: panel rows run {rows}, panel columns {cols}"
