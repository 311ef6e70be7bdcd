import numpy as np
import pytest

from optsim.core.errors import ValueCheckError
from optsim.core.quantities import Block, Segment, Video
from optsim.optics.fringing import border_shares
from optsim.optics.integrate import Shutter, integrate_exposure, slot_means

PITCH, N_SUB, PER_SEGMENT, N_SLOTS = 3, 2, 4, 12
SHAPE = (4, 5)


def video(rng):
    rows, cols = SHAPE[0] * PITCH, SHAPE[1] * PITCH
    keys = rng.uniform(0, 5, (N_SLOTS // PER_SEGMENT + 1, rows, cols)).astype(np.float32)
    n = N_SUB * PER_SEGMENT
    blocks = [
        (
            Block(1, 2, rng.normal(0, 1, (n, 5, 7)).astype(np.float32)),
            Block(3, 4, rng.normal(0, 1, (n, 6, 4)).astype(np.float32)),
        )
        for _ in range(N_SLOTS // PER_SEGMENT)
    ]
    return Video(
        rows=rows, cols=cols, samples_per_pitch=PITCH, slot_s=1 / 180, instants_per_slot=N_SUB,
        slots_per_segment=PER_SEGMENT, n_slots=N_SLOTS,
        load=lambda i: Segment(keys[i], keys[i + 1], blocks[i], n),
    )  # fmt: skip


def instants(light):
    return np.stack(
        [s.instant(i).astype(np.float64) for _, s in light.segments(0, N_SLOTS) for i in range(s.n_instants)]
    )


def test_an_exposure_is_the_sum_over_instants_of_weight_light_and_duration():
    rng = np.random.default_rng(5)
    light = video(rng)
    weights = rng.uniform(0, 1, (16, *SHAPE)).astype(np.float32)
    energy = integrate_exposure(light, PER_SEGMENT, Shutter(weights, border_shares(0.0, PITCH)))
    fine = weights.repeat(PITCH, axis=1).repeat(PITCH, axis=2)
    expected = (fine * instants(light)[8:24]).sum(axis=0) / 180 / N_SUB
    np.testing.assert_allclose(energy, expected, rtol=1e-5)


def test_slot_means_average_over_the_slot_and_the_pitch_cell():
    light = video(np.random.default_rng(6))
    means = slot_means(light, PER_SEGMENT, 2 * PER_SEGMENT)
    cells = instants(light)[8:24].reshape(8, N_SUB, SHAPE[0], PITCH, SHAPE[1], PITCH)
    np.testing.assert_allclose(means, cells.mean(axis=(1, 3, 5)), rtol=1e-5)


def test_weights_of_another_panel_are_refused():
    shutter = Shutter(np.ones((8, 5, 4), np.float32), border_shares(0.0, PITCH))
    with pytest.raises(ValueCheckError, match="do not fit"):
        integrate_exposure(video(np.random.default_rng(0)), 0, shutter)
