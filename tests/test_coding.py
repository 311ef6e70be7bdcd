"""Schemes: what they show, when they know it, and that they only know what has arrived."""

from dataclasses import replace

import numpy as np
import pytest
from ideal_camera import SLOTS, film, ideal_calibration, still_light
from pydantic import TypeAdapter

from optsim.coding import ALL, HdrMosaic, MotionAdaptive, NormalPhotography, RandomExposure, Scheme
from optsim.errors import ConfigError
from optsim.forward.motion import grown

ROWS, COLS = 24, 32


def lights(n: int) -> list[np.ndarray]:
    rng = np.random.default_rng(1)
    image = rng.uniform(0.05, 0.3, (ROWS, COLS)).astype(np.float32)
    frames = []
    for index in range(n):
        light = still_light(image).copy()
        light[:, 8:14, 3 * index : 3 * index + 8] = 1.0
        frames.append(light)
    return frames


@pytest.mark.parametrize("kind", ALL)
@pytest.mark.parametrize("coded_slots", [SLOTS, 28])
def test_codes_keep_their_contract(kind, coded_slots):
    calibration = ideal_calibration(ROWS, COLS, coded_slots=coded_slots)
    for frame in film(calibration, kind(), lights(5), np.random.default_rng(0)):
        code = frame.code
        assert code.levels.shape == (SLOTS, ROWS, COLS)
        assert code.levels.dtype == np.uint8
        assert code.moving.shape == (ROWS, COLS)
        assert not code.levels[coded_slots:].any(), "light in slots with the shutter closed"
        assert code.levels.any(axis=0).all(), "a pixel that never opens measures nothing"


@pytest.mark.parametrize("kind", ALL)
def test_codes_come_from_arrived_frames_and_the_generator_alone(kind):
    calibration = ideal_calibration(ROWS, COLS)
    scheme = kind()
    frames = film(calibration, scheme, lights(6), np.random.default_rng(0), latency=3)
    poisoned = [frames[0]] + [replace(f, dn=np.full_like(f.dn, 9999)) for f in frames[1:]]

    def codes(known):
        state = scheme.init(calibration, np.random.default_rng(5))
        for index in range(6):
            code, state = scheme.next(index, known[: max(0, index - 2)], state)
            yield code

    for code, frame in zip(codes(frames), frames, strict=True):
        np.testing.assert_array_equal(code.levels, frame.code.levels)
        np.testing.assert_array_equal(code.moving, frame.code.moving)
    same = [np.array_equal(c.levels, f.code.levels) for c, f in zip(codes(poisoned), frames, strict=True)]
    # Frame 1 arrives before code 4 at a latency of 3: poison may show there, never before.
    assert all(same[:4])
    assert all(same[4:]) == (kind is not MotionAdaptive)


def test_random_exposure_depends_on_the_generator_only_through_places():
    scheme = RandomExposure()
    first, second = (scheme.tiles(SLOTS, SLOTS, np.random.default_rng(seed)) for seed in (1, 2))
    assert not np.array_equal(first, second)
    np.testing.assert_array_equal(first.sum(axis=(2, 3)), second.sum(axis=(2, 3)))


def test_mosaic_is_equation_5():
    calibration = ideal_calibration(ROWS, COLS)
    scheme = HdrMosaic(open_slots=(1, 3, 11, 36))
    state = scheme.init(calibration, np.random.default_rng(0))
    seen = []
    for f in range(4):
        code, state = scheme.next(f, [], state)
        counts = (code.levels == 255).sum(axis=0)
        for y, x in ((0, 0), (0, 3), (1, 0), (5, 7), (23, 31)):
            assert counts[y, x] == (1, 3, 11, 36)[(2 * y + x + f) % 4]
        blocks = counts[:2, :2].ravel()
        assert sorted(blocks) == [1, 3, 11, 36], "every 2 x 2 block holds all four"
        seen.append(counts)
    assert (np.sort(np.stack(seen), axis=0) == np.array([1, 3, 11, 36])[:, None, None]).all()


def test_random_bumps_are_single_even_and_inside():
    levels = RandomExposure(bump_slots=3).tiles(SLOTS, 28, np.random.default_rng(0))[0]
    is_open = levels == 255
    assert (is_open.sum(axis=0) == 3).all()
    edges = np.abs(np.diff(is_open.astype(int), axis=0, prepend=0, append=0)).sum(axis=0)
    assert (edges == 2).all(), "one run of open slots a pixel"
    assert not is_open[28:].any()
    starts = np.bincount(is_open.argmax(axis=0).ravel(), minlength=26)
    assert starts.min() >= 2, "64 starts spread evenly over 26 places"
    assert starts.max() <= 3


def test_adaptive_scheme_finds_what_moves_and_codes_a_patch_further():
    calibration = ideal_calibration(ROWS, COLS)
    scheme = MotionAdaptive(dilation_px=1)
    frames = film(calibration, scheme, lights(6), np.random.default_rng(0))
    assert frames[1].code.moving.all(), "until two frames have arrived all counts as moving"
    code = frames[3].code
    # Between frames 1 and 2 the bar moved from columns 3..10 to 6..13: both ends changed.
    assert code.moving[9:13, 3:6].all()
    assert code.moving[9:13, 11:14].all()
    assert not code.moving[18:, :].any()
    assert not code.moving[:, 20:].any()
    reach = grown(code.moving, scheme.patch_px - 1 + scheme.psf_px)
    is_random = (code.levels == 255).sum(axis=0) == 3
    short = (HdrMosaic().tiles(SLOTS, SLOTS, np.random.default_rng(0))[3] == 255).sum(axis=0) == 3
    mosaic = np.tile(short, (ROWS // 2, COLS // 4))
    np.testing.assert_array_equal(is_random | mosaic, reach | mosaic)
    calm = film(calibration, scheme, [lights(1)[0]] * 5, np.random.default_rng(0))
    assert not calm[4].code.moving.any(), "nothing moves, nothing is coded as moving"


def test_first_frames_can_count_as_static():
    calibration = ideal_calibration(ROWS, COLS)
    scheme = MotionAdaptive(first_frames="static")
    code, _ = scheme.next(0, [], scheme.init(calibration, np.random.default_rng(0)))
    assert not code.moving.any()
    np.testing.assert_array_equal(np.unique((code.levels == 255).sum(axis=0)), (1, 3, 11, 36))


def test_schemes_read_from_tables_and_refuse_nonsense():
    adapter: TypeAdapter = TypeAdapter(Scheme)
    scheme = adapter.validate_python({"kind": "motion_adaptive", "moving": {"kind": "normal_photography"}})
    assert scheme == MotionAdaptive(moving=NormalPhotography())
    with pytest.raises(ValueError, match="ascending"):
        HdrMosaic(open_slots=(1, 1, 2, 3))
    with pytest.raises(ConfigError, match="coded slots"):
        RandomExposure(bump_slots=30).init(ideal_calibration(8, 8, coded_slots=28), np.random.default_rng(0))
    with pytest.raises(ConfigError, match="coded slots"):
        NormalPhotography(open_slots=30).init(
            ideal_calibration(8, 8, coded_slots=28), np.random.default_rng(0)
        )
