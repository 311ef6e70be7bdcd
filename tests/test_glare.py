"""Stray light of a calibrated camera: wings by rings, ghost and veil, against sums over pairs of pixels."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from optsim.calibration import Glare
from optsim.calibration.glare import REACH, RINGS_PX, ring_strengths

ROWS, COLS = 23, 61
WINGS = (0.02, 0.05, 0.03, 0.0)


def wings_of(image: np.ndarray, strengths: tuple[float, ...], reach: int) -> np.ndarray:
    """Strength over distance cubed, of each pixel in each other one beyond a square around it."""
    rows, cols = image.shape
    v, u = np.mgrid[:rows, :cols]
    found = np.zeros(image.shape)
    for row, col in np.argwhere(image):
        distance = np.hypot(v - row, u - col)
        beyond = np.maximum(abs(v - row), abs(u - col)) > reach
        for strength, (inner, outer) in zip(strengths, pairwise(RINGS_PX), strict=True):
            ring = beyond & (distance >= inner) & (distance < outer)
            found[ring] += strength * image[row, col] / distance[ring] ** 3
    return found


@pytest.fixture
def image() -> np.ndarray:
    lit = np.zeros((ROWS, COLS))
    lit[3, 4], lit[20, 58], lit[11, 30], lit[11, 31] = 5.0, 2.0, 1.0, 0.5
    return lit


@pytest.mark.parametrize("reach", [1, 3, 6])
@pytest.mark.parametrize("wings", [WINGS, (0.04, 0.0, 0.0, 0.0), (0.0, 0.0, 0.01, 0.02)])
def test_wings_fall_with_the_cube_of_the_distance_ring_by_ring(image, wings, reach) -> None:
    found = Glare(wings=wings).light(image, reach)
    np.testing.assert_allclose(found, wings_of(image, wings, reach), rtol=1e-6, atol=1e-12)


def test_veil_is_even_and_a_ghost_is_turned_by_half_a_turn(image) -> None:
    np.testing.assert_allclose(Glare(veil=0.01).light(image, 3), 0.01 * image.mean(), rtol=1e-12)
    ghost = Glare(ghost=0.02, ghost_blur_px=1.5).light(image, 3)
    # Of (3, 4) the ghost is around (19, 56), beside the light of (20, 58).
    assert np.unravel_index(ghost.argmax(), ghost.shape) == (ROWS - 1 - 3, COLS - 1 - 4)
    # All of 8.5 but what the blur throws over the edge.
    assert ghost.sum() == pytest.approx(0.02 * 8.5, rel=0.1)
    together = Glare(0.01, 0.02, 1.5, WINGS).light(image, 3)
    alone = [Glare(veil=0.01), Glare(ghost=0.02, ghost_blur_px=1.5), Glare(wings=WINGS)]
    np.testing.assert_allclose(together, sum(each.light(image, 3) for each in alone), rtol=1e-9)


def test_the_share_of_a_pixel_is_all_that_others_get_of_it() -> None:
    reach = int(RINGS_PX[-1])
    wide = np.zeros((2 * reach + 1, 2 * reach + 1))
    wide[reach, reach] = 1
    glare = Glare(veil=0.01, wings=WINGS)
    assert glare.light(wide, 3).sum() == pytest.approx(glare.share(3), rel=1e-6)


def test_ring_strengths_come_back_and_are_never_negative() -> None:
    lit = np.zeros((ROWS, COLS))
    lit[9, 40] = 1
    seen = wings_of(lit, WINGS, REACH)
    np.testing.assert_allclose(ring_strengths(seen, 9, 40), WINGS, rtol=1e-9, atol=1e-12)
    assert ring_strengths(-seen, 9, 40) == (0.0,) * len(WINGS)
