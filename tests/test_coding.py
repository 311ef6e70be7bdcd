"""Schemes: what they show, when they know it, and that they only know what has arrived."""

from dataclasses import replace
from typing import get_args

import numpy as np
import pytest
from ideal_camera import SLOTS, film, ideal_calibration, still_light
from pydantic import TypeAdapter

from optsim.coding import (
    ALL,
    CodedRollingShutter,
    FlutterShutter,
    HdrMosaic,
    MotionAdaptive,
    NormalPhotography,
    RandomBinary,
    RandomExposure,
    RandomLengths,
    Scheme,
    ShutterGrid,
)
from optsim.coding.flutter_shutter import flutter_code
from optsim.coding.shutter_grid import firing_order
from optsim.coding.static_schemes import STATIC_SCHEMES, AnyStaticScheme
from optsim.core.errors import ConfigError
from optsim.experiment.experiment import load_experiment
from optsim.optics.neighbourhoods import dilated

ROWS, COLS = 24, 32
# Chops published by Raskar, Agrawal and Tumblin (2006).
RASKAR = "1010000111000001010000110011110111010111001001100111"


def opened(scheme, coded_slots=SLOTS, seed=0):
    """Open slots of one frame of a scheme's tile: (slot, y, x)."""
    return scheme.tiles(SLOTS, coded_slots, np.random.default_rng(seed))[0] == 255


def runs(is_open):
    """Number of runs of open slots of each pixel."""
    return (np.diff(is_open.astype(int), axis=0, prepend=0) == 1).sum(axis=0)


def weakest(code):
    """Least magnitude of a code's spectrum, padded to 4096 chops."""
    return np.abs(np.fft.rfft(code, 4096)).min()


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
    assert all(same[4:]) == (kind in STATIC_SCHEMES)


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


def test_fixed_mosaic_is_two_by_two_and_the_same_in_all_frames():
    calibration = ideal_calibration(ROWS, COLS)
    scheme = HdrMosaic(shifts=False)
    state = scheme.init(calibration, np.random.default_rng(0))
    for f in range(5):
        code, _ = scheme.next(f, [], state)
        counts = (code.levels == 255).sum(axis=0)
        np.testing.assert_array_equal(counts, np.tile([[1, 3], [11, 36]], (ROWS // 2, COLS // 2)))
        assert not code.moving.any()


@pytest.mark.parametrize("coded_slots", [SLOTS, 28])
def test_random_lengths_are_single_bumps_of_all_lengths_anywhere(coded_slots):
    is_open = opened(RandomLengths(shortest_slots=2, longest_slots=6, tile_px=64), coded_slots)
    assert (runs(is_open) == 1).all()
    lengths = is_open.sum(axis=0)
    counts = np.bincount(lengths.ravel(), minlength=7)
    assert counts[:2].sum() == 0
    assert counts.size == 7
    assert counts[2:].max() - counts[2:].min() <= 1, "4096 pixels share 5 lengths evenly"
    for length in range(2, 7):
        n_starts = coded_slots - length + 1
        starts = np.bincount(is_open.argmax(axis=0)[lengths == length], minlength=n_starts)
        assert starts.size == n_starts, "nothing begins too late to end in time"
        assert starts.min() > 0, "20 expected of each: none of one by chance in 1e9"
        expected = starts.sum() / n_starts
        chi2 = ((starts - expected) ** 2 / expected).sum()
        # 5 standard deviations of chi squared with about 30 degrees: one false alarm in 10 000 each.
        assert abs(chi2 - (n_starts - 1)) < 5 * np.sqrt(2 * n_starts)
    assert opened(RandomLengths()).sum() == pytest.approx(4 * 64, abs=4), (
        "a mean of four slots, as the four to one of Portz et al."
    )


@pytest.mark.parametrize("coded_slots", [SLOTS, 28])
def test_exposures_of_random_length_run_on_over_frames(coded_slots):
    """Each begins where the one before ended; one that would not fit begins the frame again."""
    calibration = ideal_calibration(8, 8, coded_slots=coded_slots)
    scheme = RandomLengths()
    state = scheme.init(calibration, np.random.default_rng(0))
    is_open = np.stack([scheme.next(f, [], state)[0].levels == 255 for f in range(coded_slots)])
    lengths, starts = is_open.sum(axis=1), is_open.argmax(axis=1)
    assert (lengths == lengths[0]).all()
    assert all((runs(frame) == 1).all() for frame in is_open)
    ends = (starts + lengths)[:-1]
    fits = ends + lengths[1:] <= coded_slots
    np.testing.assert_array_equal(starts[1:][fits], ends[fits])
    assert (starts[1:][~fits] < lengths[1:][~fits]).all()
    assert is_open[:, :coded_slots].any(axis=0).all(), "every pixel sees every slot in time"


@pytest.mark.parametrize(("share", "coded_slots"), [(0.5, SLOTS), (0.5, 28), (0.1, SLOTS)])
def test_random_binary_codes_are_independent_with_the_stated_share(share, coded_slots):
    is_open = opened(RandomBinary(open_share=share, tile_px=64), coded_slots)
    assert is_open.any(axis=0).all()
    assert not is_open[coded_slots:].any()
    code = is_open[:coded_slots].astype(float)
    given_one = share / (1 - (1 - share) ** coded_slots)
    one_slot = np.sqrt(given_one * (1 - given_one) / 4096)
    # 5 standard errors: a false alarm in 1.7 million a number, 36 slots, 8 of the rest.
    assert np.abs(code.mean(axis=(1, 2)) - given_one).max() < 5 * one_slot
    # Drawing anew those that never open makes slots a little dependent; 2 % of the pixels at a share of 0.1.
    assert abs(code.mean() - given_one) < 5 * one_slot / np.sqrt(coded_slots)
    rest = (code - code.mean()) / code.std()
    n = rest.size
    for a, b in ((rest[1:], rest[:-1]), (rest[:, 1:], rest[:, :-1]), (rest[:, :, 1:], rest[:, :, :-1])):
        assert abs((a * b).mean()) < 5 / np.sqrt(n) + 0.002


def test_rare_openings_are_drawn_until_every_pixel_opens():
    is_open = opened(RandomBinary(open_share=1 / 28, tile_px=64), 28)
    assert is_open.sum(axis=0).min() == 1
    # One slot on average, given at least one: 1 / (1 - (27/28)^28) = 1.565, 4096 pixels know it to 0.012.
    assert is_open.sum(axis=0).mean() == pytest.approx(1.565, abs=0.06)


@pytest.mark.parametrize("coded_slots", [SLOTS, 28])
def test_flutter_is_one_code_for_all_that_loses_no_frequency(coded_slots):
    calibration = ideal_calibration(ROWS, COLS, coded_slots=coded_slots)
    state = FlutterShutter().init(calibration, np.random.default_rng(0))
    code, _ = FlutterShutter().next(3, [], state)
    assert (code.levels == code.levels[:, :1, :1]).all()
    assert code.moving.all()
    shutter = code.levels[:coded_slots, 0, 0] == 255
    assert shutter.sum() == coded_slots // 2
    assert shutter[0]
    assert shutter[-1]
    box = np.arange(coded_slots) < coded_slots // 2
    assert weakest(shutter) > 100 * weakest(box)
    rng = np.random.default_rng(0)
    drawn = [weakest(rng.permutation(box)) for _ in range(2000)]
    assert weakest(shutter) > 1.3 * max(drawn), "far beyond the best of 2000 at random"
    again = FlutterShutter().init(calibration, np.random.default_rng(99))
    np.testing.assert_array_equal(again.tiles, state.tiles)


def test_flutter_search_beats_the_published_code_at_its_own_length():
    published = np.array([int(chop) for chop in RASKAR])
    assert published.sum() == 26
    assert weakest(published) == pytest.approx(1.324, abs=0.002)
    assert weakest(flutter_code(52)) > 1.1 * weakest(published)


@pytest.mark.parametrize(("coded_slots", "group_rows"), [(SLOTS, 4), (SLOTS, 6), (28, 4), (28, 3), (28, 28)])
def test_rows_open_one_after_the_other(coded_slots, group_rows):
    calibration = ideal_calibration(ROWS, COLS, coded_slots=coded_slots)
    scheme = CodedRollingShutter(group_rows=group_rows)
    code, _ = scheme.next(0, [], scheme.init(calibration, np.random.default_rng(0)))
    is_open = code.levels == 255
    assert (is_open == is_open[:, :, :1]).all(), "a row is of one mind"
    assert code.moving.all()
    rows = opened(scheme, coded_slots)[:, :, 0]
    for v in range(ROWS):
        np.testing.assert_array_equal(is_open[:, v, 0], rows[:, v % group_rows])
    assert (runs(rows) == 1).all()
    assert (rows.sum(axis=0) == -(-coded_slots // group_rows)).all()
    assert (np.diff(rows.argmax(axis=0)) > 0).all()
    at_once = rows.sum(axis=1)
    assert (at_once[:coded_slots] >= 1).all(), "some row sees every slot"
    assert at_once.max() == (1 if coded_slots % group_rows == 0 else 2)


def test_rows_overlap_when_told_to_stay_open():
    rows = opened(CodedRollingShutter(group_rows=4, open_slots=18), 36)[:, :, 0]
    np.testing.assert_array_equal(rows.argmax(axis=0), [0, 6, 12, 18])
    assert (rows.sum(axis=0) == 18).all()


@pytest.mark.parametrize(("coded_slots", "grid_px"), [(SLOTS, 2), (SLOTS, 6), (SLOTS, 4), (28, 2), (28, 5)])
def test_pixels_of_a_grid_open_one_after_the_other(coded_slots, grid_px):
    grid = opened(ShutterGrid(grid_px=grid_px), coded_slots)
    assert grid.shape == (SLOTS, grid_px, grid_px)
    assert (runs(grid) == 1).all()
    assert (grid.sum(axis=0) == -(-coded_slots // grid_px**2)).all()
    starts = grid.argmax(axis=0).ravel()
    np.testing.assert_array_equal(starts.argsort(), firing_order(grid_px).argsort())
    at_once = grid.sum(axis=(1, 2))
    assert (at_once[:coded_slots] >= 1).all()
    assert not at_once[coded_slots:].any()
    assert at_once.max() == 1 if coded_slots % grid_px**2 == 0 else at_once.max() == 2


@pytest.mark.parametrize("side", [2, 4, 8, 16])
def test_grids_cover_the_frame_evenly_at_every_resolution(side):
    """Every 2^k x 2^k square, wherever it lies, has one pixel in each 4^k-th part of the frame."""
    turn = firing_order(side).reshape(side, side)
    for k in range(int(np.log2(side)) + 1):
        part = turn * 4**k // side**2
        for v, u in np.ndindex(side, side):
            square = np.roll(part, (-v, -u), axis=(0, 1))[: 2**k, : 2**k]
            np.testing.assert_array_equal(np.sort(square, axis=None), np.arange(4**k))
        # Pixels of one part lie on a lattice: the image that it takes is 2^k times as coarse.
        v, u = np.nonzero(part == 0)
        assert not (v % 2**k).any()
        assert not (u % 2**k).any()


@pytest.mark.parametrize("side", [2, 3, 5, 6, 7])
def test_successive_pixels_of_any_grid_lie_apart(side):
    v, u = np.divmod(firing_order(side).argsort(), side)
    assert len({*zip(v, u, strict=True)}) == side**2
    apart = np.maximum(*(np.abs(np.diff(each)) for each in (v, u)))
    assert apart.mean() >= side / 3
    assert apart[0] >= side // 2


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
    reach = dilated(code.moving, scheme.patch_px - 1 + scheme.psf_px)
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
    with pytest.raises(ValueError, match="longest_slots"):
        RandomLengths(shortest_slots=5, longest_slots=4)


@pytest.mark.parametrize(
    ("scheme", "words"),
    [
        (NormalPhotography(open_slots=30), "open_slots: got 30, expected at most the 28 coded slots; lower"),
        (RandomExposure(bump_slots=30), "bump_slots: got 30, expected at most the 28 coded slots; lower"),
        (
            RandomLengths(longest_slots=29),
            "longest_slots: got 29, expected at most the 28 coded slots; lower",
        ),
        (RandomBinary(open_share=0.03), "open_share: got 0.03, expected at least 0.0357.*raise"),
        (ShutterGrid(grid_px=6), "grid_px: got 6, expected at most 5.*lower"),
        (CodedRollingShutter(group_rows=29), "group_rows: got 29, expected at most 28.*lower"),
        (
            CodedRollingShutter(open_slots=29),
            "open_slots: got 29, expected at most the 28 coded slots; lower",
        ),
        (
            CodedRollingShutter(open_slots=26),
            "group_rows: got 4, expected at most 3.*lower it, or open_slots",
        ),
    ],
)
def test_codes_that_cannot_be_are_refused_with_a_cure(scheme, words):
    with pytest.raises(ConfigError, match=words):
        scheme.init(ideal_calibration(8, 8, coded_slots=28), np.random.default_rng(0))


def test_flutter_needs_slots_to_choose_among():
    with pytest.raises(ConfigError, match="got 5 coded slots, expected at least 6"):
        FlutterShutter().tiles(SLOTS, 5, np.random.default_rng(0))
    assert weakest(flutter_code(6)) > 0.3


@pytest.mark.parametrize("kind", ALL)
def test_an_experiment_takes_every_scheme_by_its_kind(kind):
    name = kind.model_fields["kind"].default
    found = load_experiment("demo", [f"methods.3.scheme.kind={name}"])
    assert isinstance(found.methods[3].scheme, kind)
    if kind in STATIC_SCHEMES:
        part = load_experiment("demo", [f"methods.0.scheme.moving.kind={name}"]).methods[0].scheme
        assert isinstance(part.moving, kind)


def test_the_union_of_schemes_is_their_list():
    assert get_args(AnyStaticScheme) == STATIC_SCHEMES
    assert {leaf.model_fields["kind"].default for leaf in STATIC_SCHEMES} == {
        leaf.__module__.rpartition(".")[2] for leaf in STATIC_SCHEMES
    }
