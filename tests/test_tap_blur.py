"""Blur tap by tap: what each place collects."""

import numpy as np
import pytest
from scipy import ndimage

from optsim.optics.tap_blur import LARGEST_TAPS, Grid, Patch, collect_strip, kernels_in_sixes

RNG = np.random.default_rng(9)
FIELD = 61, 83


def collected(kernels, excess, borders):
    """What a patch's light brings to the rows 5 to 47 of the field, which it fills."""
    target = Patch(np.zeros_like(excess), 0, 0)
    nodes = kernels_in_sixes(kernels)
    collect_strip(Patch(excess, 0, 0), Grid(*FIELD), nodes, np.array(borders), target, 5, 47)
    return target.excess


@pytest.mark.parametrize("half", [0, 1, 2, 9, 10, 11, LARGEST_TAPS, LARGEST_TAPS + 5])
def test_kernels_of_every_size_collect_what_is_around(half):
    """An independent correlation in double precision; light goes on beyond the border, and 0 stays 0."""
    kernel = RNG.random((2 * half + 1, 2 * half + 1))
    kernel /= kernel.sum()
    excess = RNG.normal(0, 1, (4, *FIELD)).astype(np.float32)
    excess[2] = 0
    found = collected(kernel[None, None], excess, [0, 40, FIELD[1]])
    exact = [ndimage.correlate(image.astype(np.float64), kernel, mode="nearest") for image in excess]
    np.testing.assert_allclose(found[:, 5:47], np.stack(exact)[:, 5:47], atol=2e-6)
    assert not found[:, :5].any()
    assert not found[:, 47:].any()
    assert not found[2].any()


@pytest.mark.parametrize("half", [3, LARGEST_TAPS])
def test_kernels_of_nodes_are_interpolated_at_every_row_and_column(half):
    kernels = RNG.random((3, 3, 2 * half + 1, 2 * half + 1)) / (2 * half + 1) ** 2
    excess = RNG.normal(0, 1, (2, *FIELD)).astype(np.float32)
    found = collected(kernels, excess, [0, 20, 42, 60, FIELD[1]])
    hats_y, hats_x = (
        np.maximum(1 - np.abs((np.arange(n) + 0.5) / n * 2 - np.arange(3)[:, None]), 0) for n in FIELD
    )
    exact = np.zeros((2, *FIELD))
    for i, j in np.ndindex(3, 3):
        of_node = [ndimage.correlate(image.astype(float), kernels[i, j], mode="nearest") for image in excess]
        exact += hats_y[i][:, None] * hats_x[j] * np.stack(of_node)
    np.testing.assert_allclose(found[:, 5:47], exact[:, 5:47], atol=2e-6)


def test_light_that_touches_no_border_is_collected_to_its_last_row():
    """Among it the rows that only the light's own first or last row reaches."""
    half, rows, cols = 4, slice(20, 31), slice(30, 45)
    kernel = RNG.random((2 * half + 1, 2 * half + 1))
    field = np.zeros(FIELD)
    field[rows, cols] = RNG.random((11, 15))
    light = Patch(field[None, rows, cols].astype(np.float32), rows.start, cols.start)
    target = Patch(np.zeros((1, *FIELD), np.float32), 0, 0)
    nodes, borders = kernels_in_sixes(kernel[None, None]), np.array([0, 40, FIELD[1]])
    for first in range(0, FIELD[0], 25):
        collect_strip(light, Grid(*FIELD), nodes, borders, target, first, min(first + 25, FIELD[0]))
    exact = ndimage.correlate(field, kernel, mode="nearest")
    assert exact[rows.start - half].any()
    assert exact[rows.stop + half - 1].any()
    np.testing.assert_allclose(target.excess[0], exact, atol=3e-5)
