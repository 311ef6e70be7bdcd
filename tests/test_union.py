"""The union: a video where something moves, the merge of frames where nothing does."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from ideal_camera import BLACK_DN, SLOTS, crossing, film, ideal_calibration, still_light

from optsim.calibration import Glare
from optsim.calibration.demixed import FrameWithHighlights, demixed_frames
from optsim.coding import HdrMosaic, MotionAdaptive, NormalPhotography, RandomExposure
from optsim.core.quantities import CodedFrame, ExposureCode
from optsim.decoding import GaussianMixture, HdrMerge, Interpolation, SparseCoding, Union
from optsim.decoding.union import _nearness

ROWS, COLS = 32, 40


def textured():
    """A wall that no patch of a few atoms describes."""
    return np.random.default_rng(4).uniform(0.05, 0.4, (ROWS, COLS)).astype(np.float32)


def test_equation_1_takes_each_branch_in_its_place():
    calibration = ideal_calibration(ROWS, COLS, leak=0.01)
    lights = crossing(6)
    frames = film(calibration, MotionAdaptive(), lights, np.random.default_rng(1))
    *_, joined = Union(video="coded").decode(frames, calibration)
    *_, still = HdrMerge().decode(frames, calibration)
    *_, video = SparseCoding().decode(frames, calibration)
    moving = frames[-1].code.moving
    assert moving.any()
    assert not moving.all()
    np.testing.assert_array_equal(joined.moving, moving)
    np.testing.assert_allclose(joined.irradiance_w_m2[:, moving], video.irradiance_w_m2[:, moving], atol=1e-6)
    far = ~np.pad(moving, 8, mode="edge")
    far = np.lib.stride_tricks.sliding_window_view(far, (17, 17)).all(axis=(2, 3))
    assert far.any()
    np.testing.assert_array_equal(joined.irradiance_w_m2[:, far], still.irradiance_w_m2[:, far])
    steps = np.abs(np.diff(joined.irradiance_w_m2.mean(axis=0), axis=1))
    assert steps.max() < 1.0
    # The video doesn't know how sure it is.
    known = (joined.uncertainty_w_m2 > 0).all(axis=0)
    assert 0.1 < known.mean() < 0.9
    np.testing.assert_array_equal((joined.uncertainty_w_m2 > 0).any(axis=0), known)
    *_, layer = SparseCoding().partials(frames, calibration)
    np.testing.assert_array_equal(known, layer.blend_weight == 0)
    spread = np.broadcast_to(still.uncertainty_w_m2, joined.uncertainty_w_m2.shape)
    np.testing.assert_array_equal(joined.uncertainty_w_m2[:, known], spread[:, known])


def test_union_is_as_sure_as_who_makes_the_picture():
    calibration = ideal_calibration(ROWS, COLS, leak=0.01)
    frames = film(calibration, MotionAdaptive(), crossing(6), np.random.default_rng(1))
    sure = GaussianMixture(uncertainty=True)
    *_, joined = Union(moving=sure, video="coded").decode(frames, calibration)
    *_, still = HdrMerge().decode(frames, calibration)
    *_, video = sure.partials(frames, calibration)
    moving, spread = frames[-1].code.moving, joined.uncertainty_w_m2
    np.testing.assert_allclose(spread[:, moving], video.uncertainty_w_m2[:, moving], rtol=1e-5)
    np.testing.assert_array_equal(
        spread[:, video.blend_weight == 0], still.uncertainty_w_m2[:, video.blend_weight == 0]
    )
    mixed = (video.blend_weight > 0) & (video.blend_weight < 1)
    assert mixed.any()
    both = np.stack([still.uncertainty_w_m2, video.uncertainty_w_m2])[:, :, mixed]
    assert (spread[:, mixed] <= both.max(axis=0) * (1 + 1e-5)).all()
    assert (spread[:, mixed] >= both.min(axis=0) * (1 - 1e-5)).all()


def test_what_no_longer_changes_is_merged():
    """The bar stops; the mask, made from older frames, still asks for a video of where it was."""
    calibration = ideal_calibration(ROWS, COLS, leak=0.01)
    lights = crossing(4)
    lights += [still_light(lights[-1][-1])] * 2
    frames = film(calibration, MotionAdaptive(), lights, np.random.default_rng(1), latency=2)
    merge = HdrMerge(moving_sigma=4)  # without false alarms
    *_, still = merge.decode(frames, calibration)
    *_, joined = Union(static=merge).decode(frames, calibration)
    *_, paper = Union(video="coded").decode(frames, calibration)
    coded = frames[-1].code.moving
    assert coded.sum() > 100
    assert joined.moving.sum() < 0.2 * paper.moving.sum()

    def error(found):
        return np.sqrt(np.square(found.irradiance_w_m2 - lights[-1])[:, coded].mean())

    assert error(joined) < 0.7 * error(paper)
    assert error(joined) < 1.1 * error(still)


def test_what_changes_is_a_video():
    calibration = ideal_calibration(ROWS, COLS, leak=0.01)
    lights = crossing(6)
    frames = film(calibration, MotionAdaptive(), lights, np.random.default_rng(1))
    *_, still = HdrMerge().decode(frames, calibration)
    *_, joined = Union().decode(frames, calibration)
    *_, paper = Union(video="coded").decode(frames, calibration)
    moves = np.ptp(lights[-1], axis=0) > 0.05
    assert moves.sum() > 50

    def error(found):
        return np.sqrt(np.square(found.irradiance_w_m2 - lights[-1])[:, moves].mean())

    # The bar's rims change less than noise does, and are merged.
    assert error(joined) < 1.15 * error(paper)
    assert error(joined) < 0.8 * error(still)


def test_what_the_late_mask_misses_is_a_video_too():
    """The bar has left the mask, which is three frames old: the mosaic's own samples make a video of it."""
    calibration = ideal_calibration(ROWS, COLS, leak=0.01)
    lights = crossing(6)
    frames = film(calibration, MotionAdaptive(dilation_px=0), lights, np.random.default_rng(1), latency=3)
    *_, still = HdrMerge().decode(frames, calibration)
    *_, joined = Union().decode(frames, calibration)
    *_, paper = Union(video="coded").decode(frames, calibration)
    missed = (np.ptp(lights[-1], axis=0) > 0.05) & ~frames[-1].code.moving
    assert missed.sum() > 30

    def error(found):
        return np.sqrt(np.square(found.irradiance_w_m2 - lights[-1])[:, missed].mean())

    assert joined.moving[missed].mean() > 0.8
    assert error(joined) < 0.8 * error(still)
    assert error(joined) < 0.8 * error(paper)


def test_a_code_that_tells_no_times_apart_is_merged():
    calibration = ideal_calibration(ROWS, COLS, leak=0.01)
    frames = film(calibration, NormalPhotography(), crossing(6), np.random.default_rng(1))
    *_, still = HdrMerge().partials(frames, calibration)
    *_, joined = Union().decode(frames, calibration)
    assert still.moving.sum() > 50
    assert not joined.moving.any()
    np.testing.assert_array_equal(joined.irradiance_w_m2[0], still.irradiance_w_m2[0])


def test_a_mosaic_is_merged_beside_what_saturates():
    """A lamp beside the bar's path leaves the mosaic too few exposures for a video."""
    calibration = ideal_calibration(ROWS, COLS, leak=0.01)
    lights = crossing(6)
    for light in lights:
        light[:, 20:24, 16:24] = 8
    frames = film(calibration, HdrMosaic(), lights, np.random.default_rng(1))
    *_, still = HdrMerge().partials(frames, calibration)
    *_, joined = Union().decode(frames, calibration)
    lamp = np.zeros((ROWS, COLS), np.bool_)
    lamp[20:24, 16:24] = True
    assert _nearness(still.moving, 4.0)[lamp].max() > 0.3
    merged = np.broadcast_to(still.irradiance_w_m2, joined.irradiance_w_m2.shape)
    np.testing.assert_array_equal(joined.irradiance_w_m2[:, lamp], merged[:, lamp])


def test_a_random_code_of_a_still_wall_is_merged():
    """All is coded for a video, and nothing moves: frames add up as a mosaic's do."""
    calibration = ideal_calibration(ROWS, COLS)
    light = still_light(textured())
    frames = film(calibration, RandomExposure(), [light] * 4, np.random.default_rng(1))
    assert all(frame.code.moving.all() for frame in frames)
    first, *_, fourth = Union().decode(frames, calibration)
    *_, still = HdrMerge().decode(frames, calibration)
    np.testing.assert_array_equal(first.moving, True)
    # One such film in 75 has a false alarm, which calls for a video of up to a third of so small a picture.
    assert fourth.moving.mean() < 0.35
    # A twentieth of a video that is wrong by all of the light there is.
    apart = np.abs(fourth.irradiance_w_m2 - still.irradiance_w_m2)[:, ~fourth.moving]
    assert apart.max() < 0.05 * light.max()


@pytest.mark.parametrize("static", [HdrMerge(n_frames=1), HdrMerge(paper_literal=True)])
def test_a_merge_that_compares_nothing_leaves_it_to_the_mask(static):
    calibration = ideal_calibration(ROWS, COLS, leak=0.01)
    frames = film(calibration, MotionAdaptive(), crossing(4), np.random.default_rng(1))
    one, other = (
        Union(static=static, moving=Interpolation(), video=video).decode(frames, calibration)
        for video in ("changed", "coded")
    )
    for a, b in zip(one, other, strict=True):
        np.testing.assert_array_equal(a.irradiance_w_m2, b.irradiance_w_m2)
        np.testing.assert_array_equal(a.moving, b.moving)


def test_nearness_falls_by_e_in_its_distance():
    changed = np.zeros((41, 41), np.bool_)
    changed[20] = True
    near = _nearness(changed, 4.0)
    np.testing.assert_allclose(near[28:40] / near[24:36], np.exp(-1), rtol=1e-4)
    np.testing.assert_allclose(near, near[::-1], rtol=1e-5)
    assert near[20, 20] == near.max() == pytest.approx((1 + 2 * np.exp(-1 / 4)) / 3)
    assert not _nearness(np.zeros((5, 7), np.bool_), 3.0).any()
    np.testing.assert_allclose(_nearness(np.ones((5, 7), np.bool_), 3.0), 1, rtol=1e-6)


@given(arrays.arrays(np.bool_, st.tuples(st.integers(1, 9), st.integers(1, 9))), st.floats(0.01, 1e4))
def test_nearness_is_a_share(changed, fade_px):
    near = _nearness(changed, fade_px)
    assert near.dtype == np.float32
    assert (near >= 0).all()
    assert (near <= 1).all()


def test_known_highlights_take_their_glare_out_of_the_dark():
    """A lamp saturates by far; its veil is most of what a dark pixel reads."""
    calibration = ideal_calibration(ROWS, COLS, glare=Glare(veil=0.01))
    light = np.full((ROWS, COLS), 0.02, np.float32)
    light[4:6, 4:6] = 5_000
    code = ExposureCode(np.full((SLOTS, ROWS, COLS), 255, np.uint8), np.ones((ROWS, COLS), np.bool_))
    dn = calibration.mix(light * SLOTS) * calibration.responsivity_dn + BLACK_DN
    frame = CodedFrame(0, np.rint(dn.clip(0, 16_383)).astype(np.uint16), code)
    told = FrameWithHighlights(**vars(frame), highlights_w_m2=light)
    dark = light < 1
    alone, helped = (
        next(demixed_frames([each], calibration, "undone"))[1].signal[dark] / (0.02 * SLOTS)
        for each in (frame, told)
    )
    assert alone.min() > 5
    np.testing.assert_allclose(helped, 1, atol=0.02)


def test_the_video_is_told_what_the_merge_knows_of_highlights(monkeypatch):
    calibration = ideal_calibration(ROWS, COLS, leak=0.01)
    frames = film(calibration, RandomExposure(), crossing(3), np.random.default_rng(1))
    told = []

    def seen(self, frames, calibration):
        def kept():
            for frame in frames:
                told.append(frame.highlights_w_m2)
                yield frame

        return partials(self, kept(), calibration)

    partials = Interpolation.partials
    monkeypatch.setattr(Interpolation, "partials", seen)
    assert len(list(Union(moving=Interpolation()).decode(frames, calibration))) == 3
    for light, still in zip(told, HdrMerge().partials(frames, calibration), strict=True):
        np.testing.assert_array_equal(light, still.irradiance_w_m2[0])
