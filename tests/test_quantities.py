"""Values are checked once, where they are made."""

import numpy as np
import pytest

from optsim.core.errors import ValueCheckError
from optsim.core.quantities import (
    Block,
    CodedFrame,
    ExposureCode,
    PanelState,
    Reconstruction,
    Segment,
    checked,
)
from optsim.footage.made import footage, still


def test_nan_is_an_error_with_its_place() -> None:
    image = np.zeros((3, 4), np.float32)
    image[2, 1] = np.nan
    with pytest.raises(ValueCheckError, match=r"\(2, 1\)"):
        checked("light", image, axes=("y", "x"), dtype=np.float32, unit="W m^-2")


def test_negative_light_is_an_error_unless_allowed() -> None:
    image = np.full((2, 2), -1e-3, np.float32)
    with pytest.raises(ValueCheckError, match="negative"):
        checked("light", image, axes=("y", "x"), dtype=np.float32, unit="W m^-2")
    view = checked("light", image, axes=("y", "x"), dtype=np.float32, unit="W m^-2", nonnegative=False)
    assert not view.flags.writeable
    assert image.flags.writeable


def test_wrong_rank_and_dtype() -> None:
    with pytest.raises(ValueCheckError, match="axes"):
        PanelState(np.zeros(3, np.float32), np.zeros((3, 3), np.uint8))
    with pytest.raises(ValueCheckError, match="dtype"):
        PanelState(np.zeros((3, 3)), np.zeros((3, 3), np.uint8))
    code = ExposureCode(np.zeros((2, 3, 4), np.uint8), np.zeros((3, 4), np.bool_))
    with pytest.raises(ValueCheckError, match="dtype"):
        CodedFrame(0, np.zeros((3, 4), np.uint8), code)
    with pytest.raises(ValueCheckError, match="different panels"):
        ExposureCode(np.zeros((2, 3, 4), np.uint8), np.zeros((4, 3), np.bool_))
    mask = np.ones((3, 4), np.bool_)
    with pytest.raises(ValueCheckError, match="negative"):
        Reconstruction(0, np.full((2, 3, 4), -1, np.float32), mask, mask, mask)
    video = np.ones((2, 3, 4), np.float32)
    assert Reconstruction(0, video, mask, mask, mask).uncertainty_w_m2 is None
    assert Reconstruction(0, video, mask, mask, mask, video).uncertainty_w_m2 is video
    for wrong, says in (
        (-video, "uncertainty.*negative"),
        (video * np.nan, "uncertainty.*finite"),
        (video[:1], "uncertainty.*expected that of the irradiance"),
        (video.astype(np.float64), "uncertainty.*dtype"),
    ):
        with pytest.raises(ValueCheckError, match=says):
            Reconstruction(0, video, mask, mask, mask, wrong)


def test_segment_interpolates_at_instant_centres_and_blocks_add() -> None:
    start, stop = np.zeros((4, 5), np.float32), np.full((4, 5), 8, np.float32)
    excess = np.ones((4, 2, 2), np.float32)
    segment = Segment(start, stop, (Block(1, 2, excess), Block(2, 2, excess)), 4)
    instant = segment.instant(1)
    assert instant[0, 0] == pytest.approx(8 * 1.5 / 4)
    assert instant[1, 2] == pytest.approx(3 + 1)
    assert instant[2, 3] == pytest.approx(3 + 2)
    mean = np.mean([segment.instant(i) for i in range(4)], axis=0)
    assert mean[0, 0] == pytest.approx(4)


def test_block_outside_its_segment() -> None:
    image = np.zeros((4, 5), np.float32)
    with pytest.raises(ValueCheckError, match="does not fit"):
        Segment(image, image, (Block(3, 0, np.zeros((2, 2, 2), np.float32)),), 2)
    with pytest.raises(ValueCheckError, match="does not fit"):
        Segment(image, image, (Block(0, 0, np.zeros((3, 2, 2), np.float32)),), 2)


def test_footage_and_still() -> None:
    frames = np.arange(24, dtype=np.float32).reshape(4, 2, 3)
    video = footage(frames, slot_s=0.1)
    assert [first for first, _ in video.segments(1, 3)] == [1, 2]
    np.testing.assert_array_equal(video.load(2).instant(0), frames[2])
    np.testing.assert_array_equal(still(frames[0], n_slots=9, slot_s=0.1).load(8).instant(0), frames[0])
    with pytest.raises(ValueCheckError, match="whole segments"):
        list(video.segments(0, 5))
    with pytest.raises(ValueCheckError, match="whole panel pixels"):
        footage(frames, slot_s=0.1, samples_per_pitch=3)
