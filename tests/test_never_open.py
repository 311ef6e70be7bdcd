"""Pixels that no slot opens: every decoder fills them as bright as their neighbours and says so."""

import numpy as np
import pytest
from ideal_camera import SLOTS, expose, ideal_calibration, still_light

from optsim.coding import FlutterShutter, RandomExposure
from optsim.core.quantities import ExposureCode
from optsim.decoding import ALL, GaussianMixture, Joined, MotionDeblurring, SparseCoding

ROWS, COLS = 32, 36
# Patches far apart take less time.
SPARSE_GRID = GaussianMixture(stride_px=4)
FASTER = {GaussianMixture: SPARSE_GRID, Joined: Joined(decoders=(SparseCoding(), SPARSE_GRID))}


def closed_pixels():
    """One pixel in twenty, a tile of more than two patches, and the corner."""
    closed = np.random.default_rng(1).random((ROWS, COLS)) < 0.05
    closed[5:23, 5:23] = True
    closed[26:, 28:] = True
    return closed


@pytest.mark.parametrize("decoder", ALL, ids=lambda kind: kind.__name__)
def test_what_no_slot_opens_is_as_bright_as_its_neighbours_and_marked(decoder):
    calibration = ideal_calibration(ROWS, COLS)
    slope = np.broadcast_to(np.linspace(0.2, 0.3, COLS), (ROWS, COLS)).astype(np.float32)
    scheme = FlutterShutter() if decoder is MotionDeblurring else RandomExposure()
    code, _ = scheme.next(0, [], scheme.init(calibration, np.random.default_rng(2)))
    closed = closed_pixels()
    levels = np.where(closed, 0, code.levels).astype(np.uint8)
    everywhere = np.ones((ROWS, COLS), np.bool_)
    frame, _ = expose(
        calibration,
        still_light(slope),
        0,
        ExposureCode(levels, everywhere),
        None,
        np.random.default_rng(3),
    )
    (found,) = FASTER.get(decoder, decoder()).decode([frame], calibration)
    light = found.irradiance_w_m2.mean(axis=0)
    assert found.irradiance_w_m2.shape[0] == SLOTS
    np.testing.assert_allclose(light[closed], slope[closed], rtol=0.3)
    assert np.median(np.abs(light[closed] / slope[closed] - 1)) < 0.1
    assert not found.valid[closed].any()
    assert found.interpolated[closed].all()
    assert found.valid[~closed].all()
    assert not found.interpolated[~closed].any()
