"""Decoders: unbiased, causal, never fooled by saturation, and of one mind where nothing moves."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ideal_camera import BLACK_DN, KERNEL, SLOTS, crossing, expose, film, ideal_calibration, still_light
from pydantic import TypeAdapter
from scipy import ndimage

from optsim.calibration import Glare
from optsim.calibration.demixed import SaturationPrior, demix, demixed_frame, demixed_variance, noise_variance
from optsim.coding import (
    CodedRollingShutter,
    FlutterShutter,
    HdrMosaic,
    MotionAdaptive,
    NormalPhotography,
    RandomBinary,
    RandomExposure,
    RandomLengths,
    ShutterGrid,
)
from optsim.coding.static_schemes import STATIC_SCHEMES
from optsim.core.errors import ConfigError
from optsim.core.quantities import CodedFrame, ExposureCode
from optsim.decoding import (
    ALL,
    Decoder,
    GaussianMixture,
    HdrMerge,
    Interpolation,
    Joined,
    MotionDeblurring,
    P2c2,
    SparseCoding,
    TotalVariation,
    Union,
    VelocityMixture,
    shared_weights,
)
from optsim.decoding.coded_images import coded_images
from optsim.decoding.sparse.patch_codes import PatchCoder, measurement_matrix
from optsim.priors.dictionary import Dictionary, save_dictionary, shipped_dictionary, unit
from optsim.priors.mixture import shipped_mixture

ROWS, COLS = 32, 40
PATCHES = (SparseCoding, GaussianMixture, VelocityMixture, Joined)
VIDEO = (*PATCHES, Interpolation, TotalVariation, P2c2, MotionDeblurring)
NATURAL = {
    HdrMerge: HdrMosaic(),
    Union: MotionAdaptive(),
    **dict.fromkeys(VIDEO, RandomExposure()),
    MotionDeblurring: FlutterShutter(),
}


# Few velocities and windows take a tenth of the time.
QUICK = VelocityMixture(fastest=0.1, stride_px=6)
FASTER = {VelocityMixture: QUICK, Joined: Joined(decoders=(SparseCoding(stride_px=2), QUICK))}


def made(kind):
    return FASTER[kind] if kind in FASTER else kind()


def last(decoder, frames, calibration):
    *_, result = decoder.decode(frames, calibration)
    return result


@pytest.mark.slow
@pytest.mark.parametrize("kind", ALL)
@pytest.mark.parametrize("irradiance", [0.05, 0.6])
def test_uniform_still_light_comes_back(kind, irradiance):
    calibration = ideal_calibration(ROWS, COLS, leak=0.01, tau_s=0.5e-3, crosstalk=KERNEL)
    light = still_light(np.full((ROWS, COLS), irradiance))
    frames = film(calibration, NATURAL[kind], [light] * 6, np.random.default_rng(7))
    result = last(made(kind), frames, calibration)
    assert result.valid.all()
    assert not result.interpolated.any()
    error = result.irradiance_w_m2.mean(axis=0) / irradiance - 1
    exposure = 13 if kind is HdrMerge or kind is Union else 3.3
    n_frames = 1 if kind in VIDEO else 4
    electrons = irradiance * 270 * exposure * n_frames
    one_pixel = np.sqrt(electrons + 9 * n_frames) / electrons
    # Neighbours share patches and crosstalk, so 64 pixels count as one; 3 standard errors, and half a DN of
    # rounding per sample does not average away in the dimmest.
    assert abs(error.mean()) < 3 * one_pixel / np.sqrt(ROWS * COLS / 64) + 1e-3
    assert error.std() < 1.3 * one_pixel + 1e-3


def test_branches_agree_on_a_constant_still_scene():
    calibration = ideal_calibration(ROWS, COLS, leak=0.01)
    light = still_light(np.full((ROWS, COLS), 0.5))
    frames = film(calibration, RandomExposure(), [light] * 4, None)
    still = last(HdrMerge(), frames, calibration).irradiance_w_m2
    video = last(SparseCoding(noise_gain=0), frames, calibration).irradiance_w_m2
    # Without noise: half a DN of rounding of 440 is 0.1 %; the constant atom leaves 8-bit rounding, 0.4 %.
    np.testing.assert_allclose(still, 0.5, rtol=2e-3)
    np.testing.assert_allclose(video, 0.5, rtol=1e-2)
    assert still.shape == video.shape == (SLOTS, ROWS, COLS)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ALL)
def test_output_never_depends_on_later_frames(kind):
    calibration = ideal_calibration(ROWS, COLS, leak=0.01)
    frames = film(calibration, NATURAL[kind], crossing(5), np.random.default_rng(1))
    poisoned = [*frames[:3], *(replace(f, dn=np.full_like(f.dn, 12_345)) for f in frames[3:])]
    for index, (a, b) in enumerate(
        zip(made(kind).decode(frames, calibration), made(kind).decode(poisoned, calibration), strict=True)
    ):
        assert a.index == index
        assert np.array_equal(a.irradiance_w_m2, b.irradiance_w_m2) == (index < 3)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ALL)
def test_a_frame_s_light_does_not_depend_on_whether_earlier_video_was_asked_for(kind):
    calibration = ideal_calibration(ROWS, COLS, crosstalk=KERNEL)
    light = [each.copy() for each in crossing(4)]
    for each in light:
        # Saturates in some frames; what the others saw of it is remembered.
        each[:, 4:8, 4:8] *= 400
    frames = film(calibration, NATURAL[kind], light, np.random.default_rng(1))
    assert (frames[3].dn >= 15_000).any()
    unasked = [replace(f, code=replace(f.code, moving=np.zeros_like(f.code.moving))) for f in frames[:3]]
    one, other = (last(made(kind), taken, calibration) for taken in (frames, [*unasked, frames[3]]))
    # Threads add overlapping patches in any order.
    np.testing.assert_allclose(one.irradiance_w_m2, other.irradiance_w_m2, rtol=1e-5, atol=1e-7)
    for mask in ("valid", "interpolated", "moving"):
        np.testing.assert_array_equal(getattr(one, mask), getattr(other, mask))


@pytest.mark.parametrize("kind", ALL)
def test_decoders_are_lazy_and_deterministic(kind):
    calibration = ideal_calibration(ROWS, COLS)
    frames = film(calibration, NATURAL[kind], crossing(3), np.random.default_rng(1))
    taken = []

    def feed():
        for frame in frames:
            taken.append(frame.index)
            yield frame

    stream = made(kind).decode(feed(), calibration)
    first = next(stream)
    assert taken == [0], "frame 0 is decoded before frame 1 is asked for"
    again = next(made(kind).decode(frames, calibration))
    np.testing.assert_array_equal(first.irradiance_w_m2, again.irradiance_w_m2)


def test_four_mosaic_frames_are_all_four_exposures():
    calibration = ideal_calibration(ROWS, COLS)
    image = np.random.default_rng(0).uniform(0.3, 1.2, (ROWS, COLS))
    frames = film(calibration, HdrMosaic(), [still_light(image)] * 4, None)
    result = last(HdrMerge(neighbours=False), frames, calibration)
    # 51 slots of at least 80 DN each, four roundings of at most half a DN.
    np.testing.assert_allclose(result.irradiance_w_m2[0], image, rtol=2 / (51 * 80))


@pytest.mark.parametrize("electrons", [20, 60, 200, 2000])
def test_merge_is_unbiased_down_to_20_electrons(electrons):
    calibration = ideal_calibration(160, 160)
    irradiance = electrons / (270 * 51)
    light = still_light(np.full((160, 160), irradiance))
    frames = film(calibration, HdrMosaic(), [light] * 4, np.random.default_rng(electrons))
    found = last(HdrMerge(threshold_sigma=6), frames, calibration).irradiance_w_m2[0]
    one = np.sqrt(electrons + 4 * 9) / electrons
    # The estimate is clipped at zero: at 20 electrons 0.4 % of the pixels, 0.1 % of the mean.
    assert found.mean() / irradiance == pytest.approx(1, abs=0.01)
    assert found.mean() / irradiance == pytest.approx(1, abs=4 * one / 160 + 1.5e-3)


def test_saturated_samples_are_never_used():
    calibration = ideal_calibration(ROWS, COLS)
    light = still_light(np.full((ROWS, COLS), 10.0))
    frames = film(calibration, HdrMosaic(), [light] * 4, np.random.default_rng(1))
    result = last(HdrMerge(), frames, calibration)
    assert result.irradiance_w_m2[0].mean() == pytest.approx(10, rel=0.005)
    # Whatever a saturated sample says above the threshold changes nothing.
    shaken = [
        replace(f, dn=np.where(f.dn >= 15_000, np.uint16(15_001 + 300 * i), f.dn))
        for i, f in enumerate(frames)
    ]
    again = last(HdrMerge(), shaken, calibration)
    np.testing.assert_array_equal(result.irradiance_w_m2, again.irradiance_w_m2)
    literal = last(HdrMerge(paper_literal=True), frames, calibration)
    assert literal.irradiance_w_m2[0].mean() < 7, "equation 7 as printed averages saturated samples in"


def test_all_saturated_is_filled_and_said_so():
    calibration = ideal_calibration(ROWS, COLS)
    image = np.full((ROWS, COLS), 1.0, np.float32)
    image[10:14, 20:24] = 5.0
    result = last(HdrMerge(), film(calibration, NormalPhotography(), [still_light(image)], None), calibration)
    np.testing.assert_array_equal(result.interpolated, image == 5.0)
    # No less than the sample says: 15 000 DN or more, all open.
    assert (result.irradiance_w_m2[0][image == 5] > (15_000 - BLACK_DN) / (270 * 36)).all()
    # Nobody knows more than that: as uncertain as bright. What was measured is not.
    np.testing.assert_array_equal(
        result.uncertainty_w_m2[:, image == 5], result.irradiance_w_m2[:, image == 5]
    )
    assert result.uncertainty_w_m2[:, image == 1].max() < 0.02
    assert result.valid.all()


def test_change_restarts_the_merge():
    calibration = ideal_calibration(ROWS, COLS)
    lights = [still_light(np.full((ROWS, COLS), e)) for e in (0.2, 0.2, 0.2, 1.0, 1.0)]
    frames = film(calibration, HdrMosaic(), lights, np.random.default_rng(0))
    results = [r.irradiance_w_m2[0] for r in HdrMerge().decode(frames, calibration)]
    assert np.median(results[2]) == pytest.approx(0.2, rel=0.01)
    assert np.median(results[3]) == pytest.approx(1.0, rel=0.02)
    assert results[4].mean() == pytest.approx(1.0, rel=0.01)


def test_smaller_changes_end_the_merge_where_motion_chose_the_code():
    """3 standard deviations instead of 4, but not where the scheme calls the whole panel moving."""
    calibration, half = ideal_calibration(24, 48), np.zeros((24, 48), np.bool_)
    half[:, :24] = True

    def changed(step, moving):
        code = ExposureCode(np.full((SLOTS, 24, 48), 255, np.uint8), moving)
        light = np.full((24, 48), 0.5, np.float32)
        two = [
            expose(calibration, still_light(each), k, code, None, None)[0]
            for k, each in enumerate((light, light * step))
        ]
        return last(HdrMerge(), two, calibration).moving

    steps = 1 + np.geomspace(1e-4, 1e-1, 121)
    first = {}
    for step in steps:
        found, whole = changed(step, half), changed(step, np.ones_like(half))
        for name, part in {"chosen": found[:, 6:18], "not": found[:, 30:42], "all": whole[:, 6:18]}.items():
            if part.all():
                first.setdefault(name, step - 1)
    assert first["not"] / first["chosen"] == pytest.approx(4 / 3, rel=0.06)
    assert first["all"] == first["not"]


def test_undone_crosstalk_beats_row_sums_at_an_edge():
    image = np.full((ROWS, COLS), 0.1, np.float32)
    image[:, 20:] = 10.0
    calibration = ideal_calibration(ROWS, COLS, leak=0.01, crosstalk=KERNEL)
    frames = film(calibration, HdrMosaic(), [still_light(image)] * 4, np.random.default_rng(0))

    def stops(**options):
        found = last(HdrMerge(**options), frames, calibration).irradiance_w_m2[0]
        return np.sqrt((np.log2(np.maximum(found, 1e-4) / image)[:, 18:22] ** 2).mean())

    # Beside light that is 100 times brighter, 1.4 % of it is more than the pixel's own.
    assert stops(crosstalk="row_summed") > 1.0
    assert stops() < 0.25


@settings(deadline=None)
@given(st.floats(0.55, 1.0), st.integers(0, 2**32 - 1))
def test_separation_inverts_the_kernel(centre, seed):
    rng = np.random.default_rng(seed)
    kernel = rng.random((3, 3)).astype(np.float32)
    kernel[1, 1] = 0
    kernel *= (1 - centre) / kernel.sum()
    kernel[1, 1] = centre
    calibration = ideal_calibration(12, 14, crosstalk=kernel)
    image = rng.uniform(0, 0.8, (12, 14)).astype(np.float32)
    frame = film(calibration, HdrMosaic(), [still_light(image)], None)[0]
    sample, _ = demixed_frame(calibration, frame, calibration.panel_at_rest(), "undone")
    # Half a DN of rounding, blown up by at most 1 / (2 centre - 1).
    np.testing.assert_allclose(
        sample.signal, image * sample.exposure, atol=0.02 / 270 * 36 / (2 * centre - 1)
    )


def test_separated_variance_is_the_variance_found():
    kernel = np.array([[0, 0.05, 0], [0.05, 0.8, 0.05], [0, 0.05, 0]], np.float32)
    calibration = ideal_calibration(128, 128, crosstalk=kernel)
    light = still_light(np.full((128, 128), 0.5))
    frame = film(calibration, HdrMosaic(), [light], np.random.default_rng(3))[0]
    sample, _ = demixed_frame(calibration, frame, calibration.panel_at_rest(), "undone")
    predicted = demixed_variance(
        calibration, noise_variance(calibration, calibration.spread(0.5 * sample.exposure[None])[0])
    )
    for n_open in (1, 3, 11, 36):
        of = np.isclose(sample.exposure, n_open)
        ratio = ((sample.signal - 0.5 * sample.exposure)[of] ** 2 / predicted[of]).mean()
        # 4096 pixels: the variance is known to 2.2 %; five of these, one false alarm in a million.
        assert ratio == pytest.approx(1, abs=0.11)


@pytest.mark.parametrize("glare", [Glare(), Glare(0.1, 0.05, 5.0, (0.02, 0.01, 0.0, 0.0))], ids=["", "glare"])
@pytest.mark.parametrize("share", [0.9, 0.55, 0.501, 0.5, 0.45, 0.36])
def test_neighbours_light_is_taken_out_while_a_third_is_a_pixels_own(share, glare):
    """Where half is not its own, the plain iteration swings up: even light, bright and dark, mixed shares."""
    beside, across = 0.175 * (1 - share), 0.075 * (1 - share)
    kernel = np.array([[across, beside, across], [beside, share, beside], [across, beside, across]])
    kernels = np.broadcast_to(kernel.astype(np.float32), (24, 30, 3, 3)).copy()
    kernels[:, 15:] = np.array([[0, 0.02, 0], [0.02, 0.92, 0.02], [0, 0.02, 0]])
    calibration = replace(ideal_calibration(24, 30), crosstalk=kernels, glare=glare)
    frame = film(calibration, HdrMosaic(), [still_light(np.ones((24, 30)))], None)[0]
    sample, _ = demixed_frame(calibration, frame, calibration.panel_at_rest(), "row_summed")
    signal = np.random.default_rng(1).lognormal(0, 1, (24, 30)).astype(np.float32)
    signal[4:20, 3:12] = 5
    measured = calibration.mix(signal)
    unknown = SaturationPrior.unknown(calibration.shape)
    found = demix(calibration, replace(sample, measured=measured, signal=measured), unknown).signal
    # It ends where a step changes nothing by more than 1e-4 of the brightest.
    np.testing.assert_allclose(found, signal, atol=1e-3 * signal.max())


def test_wide_kernels_are_refused_with_a_cure():
    calibration = ideal_calibration(8, 8, crosstalk=np.full((3, 3), 1 / 9, np.float32))
    frame = film(calibration, HdrMosaic(), [still_light(np.ones((8, 8)))], None)[0]
    with pytest.raises(ConfigError, match="row_summed"):
        next(HdrMerge().decode([frame], calibration))
    for decoder in (HdrMerge(), TotalVariation(), Union(moving=Interpolation())):
        with pytest.raises(ConfigError, match="row_summed"):
            list(decoder.decode((), calibration))
    with pytest.raises(ConfigError, match="row_summed"):
        MotionAdaptive().init(calibration, np.random.default_rng(0))
    MotionAdaptive(crosstalk="row_summed").init(calibration, np.random.default_rng(0))
    assert next(HdrMerge(crosstalk="row_summed").decode([frame], calibration)).valid.all()


def test_saturated_neighbours_taint_unless_known():
    calibration = ideal_calibration(8, 8, crosstalk=KERNEL)
    image = np.full((8, 8), 0.01, np.float32)
    image[4, 4] = 50
    frame = film(calibration, NormalPhotography(), [still_light(image)], None)[0]
    sample, _ = demixed_frame(calibration, frame, calibration.panel_at_rest(), "undone")
    assert sample.tainted[3:6, 3:6].sum() == 8
    assert sample.tainted.sum() == 8
    known = demix(calibration, sample, SaturationPrior(image, np.zeros_like(image)))
    assert not known.tainted.any()
    np.testing.assert_allclose(known.signal[3:6, 3:6], image[3:6, 3:6] * 36, rtol=0.02)
    result = last(HdrMerge(), [frame], calibration)
    assert not result.valid[3, 4], "unknown light of the neighbour outweighs its own"
    assert result.valid[0, 0]


def test_video_beats_the_blur_and_moves_the_right_way():
    calibration = ideal_calibration(ROWS, COLS, leak=0.01)
    lights = crossing(2)
    frames = film(calibration, RandomExposure(), lights, np.random.default_rng(1))
    video = last(SparseCoding(), frames, calibration).irradiance_w_m2
    blur = lights[1].mean(axis=0)
    error = ((video - lights[1]) ** 2).mean()
    # 5 dB: less than any published dictionary gains over a long exposure on simple motion.
    assert error < 0.3 * ((blur - lights[1]) ** 2).mean()
    centre = (video[:, 8:20].mean(axis=1) - 0.2) @ np.arange(COLS)
    mass = (video[:, 8:20].mean(axis=1) - 0.2).sum(axis=1)
    path = centre / mass
    assert path[-4:].mean() - path[:4].mean() == pytest.approx(0.15 * 32, abs=1.0)


# Squared error of the moving bar relative to that of its blur, at most, by decoder: half as much again as was
# found. One shutter for all pixels tells the dictionary too little, and binary codes give interpolation no
# times of their own: worse than the blur.
CODED = [
    (RandomExposure(), 0.25, 0.3, 0.95),
    (RandomLengths(), 0.35, 0.35, 0.95),
    (RandomBinary(), 1.0, 0.65, 1.7),
    (FlutterShutter(), 4.5, 1.5, 1.9),
    (CodedRollingShutter(), 1.2, 0.75, 1.1),
    (ShutterGrid(), 0.85, 0.85, 1.3),
]


@pytest.mark.parametrize("coded_slots", [SLOTS, 28])
@pytest.mark.parametrize(
    ("scheme", "sparse", "mixture", "interpolated"), CODED, ids=lambda item: getattr(item, "kind", "")
)
def test_every_temporal_scheme_is_decoded(scheme, sparse, mixture, interpolated, coded_slots):
    calibration = ideal_calibration(ROWS, COLS, leak=0.01, coded_slots=coded_slots)
    (light,) = crossing(1)
    frames = film(calibration, scheme, [light], np.random.default_rng(1))
    scored = slice(0, coded_slots)
    blur = np.square(light[scored].mean(axis=0) - light[scored]).mean()
    for decoder, bound in (
        (SparseCoding(), sparse),
        (GaussianMixture(), mixture),
        (Interpolation(), interpolated),
    ):
        found = last(decoder, frames, calibration)
        assert found.valid.all()
        assert np.square(found.irradiance_w_m2 - light)[scored].mean() < bound * blur, decoder.kind


@pytest.mark.parametrize("scheme", [case[0] for case in CODED] + [RandomExposure(bump_slots=1)])
def test_every_code_measures_the_constant_atom(scheme):
    """The dictionary's first atom brings the light that everything else deviates from."""
    calibration = ideal_calibration(ROWS, COLS, leak=0.01)
    (frame,) = film(calibration, scheme, [still_light(np.full((ROWS, COLS), 0.5))], None)
    weights, _ = calibration.weights(frame.code, None)
    coder = PatchCoder.of(shipped_dictionary())
    matrix, lengths = np.empty(coder.sums.shape, np.float32), np.empty(coder.sums.shape[1], np.float32)
    for v, u in ((0, 0), (8, 16), (3, 5)):
        mine = weights[:, v : v + 8, u : u + 8].reshape(len(weights), -1).T
        measurement_matrix(coder.by_pixel, coder.sums, np.ascontiguousarray(mine), matrix, lengths)
        assert lengths[0] >= np.median(lengths), scheme.kind


def test_no_temporal_scheme_is_forgotten():
    assert {type(scheme) for scheme, *_ in CODED} == {leaf for leaf in STATIC_SCHEMES if leaf.TEMPORAL}


def test_own_matrices_equal_shared_ones_and_survive_dead_pixels(monkeypatch):
    calibration = ideal_calibration(ROWS, COLS, leak=0.01)
    lights = crossing(1)
    frames = film(calibration, RandomExposure(), lights, np.random.default_rng(1))
    shared = last(SparseCoding(), frames, calibration)
    with monkeypatch.context() as patched:
        patched.setattr(shared_weights, "code_period", lambda weights, *_: weights.shape[:2])
        own = last(SparseCoding(), frames, calibration)
    difference = np.sqrt(((own.irradiance_w_m2 - shared.irradiance_w_m2) ** 2).mean())
    assert difference < 0.01 * np.sqrt((shared.irradiance_w_m2**2).mean())
    valid = calibration.valid.copy()
    valid[12, 12] = False
    broken = replace(calibration, valid=valid)
    frames[0] = replace(frames[0], dn=np.where(valid, frames[0].dn, 0).astype(np.uint16))
    result = last(SparseCoding(), frames, broken)
    assert not result.valid[12, 12]
    around = np.abs(result.irradiance_w_m2 - shared.irradiance_w_m2)[:, 10:15, 10:15]
    assert around.mean() < 0.1, "a dead pixel's zero is left out, not believed"


@pytest.mark.parametrize(("literal", "neighbours"), [(False, False), (False, True), (True, False)])
@pytest.mark.parametrize("kernel", [np.ones((1, 1), np.float32), KERNEL])
def test_merge_errs_by_what_it_says(kernel, literal, neighbours):
    calibration = ideal_calibration(96, 96, crosstalk=kernel)
    light = still_light(np.random.default_rng(2).uniform(0.02, 0.35, (96, 96)))
    if literal:
        light = still_light(np.full((96, 96), 0.1))
    frames = film(calibration, HdrMosaic(), [light] * 4, np.random.default_rng(3))
    *_, layer = HdrMerge(threshold_sigma=6, neighbours=neighbours, paper_literal=literal).partials(
        frames, calibration
    )
    error = (layer.irradiance_w_m2[0] - light[0]) / layer.uncertainty_w_m2[0]
    # Four standard errors of a deviation are 3 %; half as much for rounding, and for variances that are
    # predicted from noisy estimates or samples. Neighbours know nothing of white texture.
    most = 1.5 if neighbours else 1.045
    assert 0.955 < error[layer.valid].std() < most


@pytest.mark.parametrize("decoder", [*(made(kind) for kind in VIDEO), GaussianMixture(uncertainty=True)])
def test_nothing_moving_costs_no_patches(decoder):
    calibration = ideal_calibration(ROWS, COLS)
    frame = film(calibration, HdrMosaic(), [still_light(np.ones((ROWS, COLS)))], None)[0]
    result = last(decoder, [frame], calibration)
    assert not result.valid.any()
    assert not result.irradiance_w_m2.any()


@pytest.mark.slow
@settings(deadline=None, max_examples=25)
@given(st.integers(0, 2**32 - 1), st.sampled_from(ALL))
def test_any_code_and_any_counts_give_a_valid_reconstruction(seed, kind):
    rng = np.random.default_rng(seed)
    calibration = ideal_calibration(12, 13, leak=0.01, crosstalk=KERNEL)
    frames = []
    for index in range(3):
        # Deblurring takes any code that all pixels share, and refuses others with an error of its own.
        drawn = (SLOTS, 1, 1) if kind is MotionDeblurring else (SLOTS, 12, 13)
        levels = np.broadcast_to(rng.integers(0, 256, drawn, dtype=np.uint8), (SLOTS, 12, 13))
        code = ExposureCode(levels, rng.random((12, 13)) < rng.random())
        frames.append(CodedFrame(index, rng.integers(0, 16_384, (12, 13)).astype(np.uint16), code))
    for result in made(kind).decode(frames, calibration):
        assert result.irradiance_w_m2.shape == (SLOTS, 12, 13)
        assert np.isfinite(result.irradiance_w_m2).all()
        assert (result.irradiance_w_m2 >= 0).all()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "moving"),
    [*((kind, True) for kind in ALL if kind is not MotionDeblurring), (HdrMerge, False), (Union, False)],
)
def test_what_a_code_never_opens_is_not_valid(kind, moving):
    """Half of the panel closed, and then all of it: undetermined, and finite all the same."""
    calibration = ideal_calibration(ROWS, COLS, crosstalk=KERNEL)
    levels = 255 * np.random.default_rng(5).integers(0, 2, (SLOTS, ROWS, COLS)).astype(np.uint8)
    levels[:, :, COLS // 2 :] = 0
    for shown, opened in ((levels, np.arange(COLS) < COLS // 2), (0 * levels, np.zeros(COLS, bool))):
        code = ExposureCode(shown, np.full((ROWS, COLS), moving))
        frame, _ = expose(calibration, still_light(np.ones((ROWS, COLS))), 0, code, None, None)
        result = last(made(kind), [frame], calibration)
        assert np.isfinite(result.irradiance_w_m2).all()
        # The kernel reaches one pixel further.
        far = np.abs(np.arange(COLS) - COLS // 2 + 0.5) > 1
        np.testing.assert_array_equal(result.valid[:, far], np.broadcast_to(opened, (ROWS, COLS))[:, far])


def test_decoders_read_from_tables_and_dictionaries_must_fit(tmp_path):
    adapter: TypeAdapter = TypeAdapter(Decoder)
    decoder = adapter.validate_python({"kind": "union", "moving": {"stride_px": 2}})
    assert decoder == Union(moving=SparseCoding(stride_px=2))
    other = adapter.validate_python({"kind": "union", "moving": {"kind": "gaussian_mixture", "single": True}})
    assert other == Union(moving=GaussianMixture(single=True))
    atoms = unit(np.ones((3, 8, 8, 12), np.float32))
    save_dictionary(tmp_path / "short.npz", Dictionary(atoms))
    calibration = ideal_calibration(16, 16)
    frame = film(calibration, RandomExposure(), [still_light(np.ones((16, 16)))], None)[0]
    with pytest.raises(ConfigError, match="12 slots"):
        next(SparseCoding(dictionary=str(tmp_path / "short.npz")).decode([frame], calibration))


@pytest.mark.parametrize(
    "decoder", [SparseCoding(), GaussianMixture(), VelocityMixture()], ids=lambda each: each.kind
)
def test_priors_serve_frames_of_fewer_slots(decoder):
    """28 slots, as a readout of 39 ms leaves, with the priors of 36: well ahead of what needs no prior."""
    calibration = ideal_calibration(ROWS, 48, slots_per_frame=28, coded_slots=28)
    x, slot = np.arange(48), np.arange(28)[:, None, None]
    light = 0.2 + 0.5 * np.sin((x - 0.7 * slot) / 4) ** 2
    light = np.broadcast_to(light, (28, ROWS, 48)).astype(np.float32)
    code, _ = RandomExposure().next(0, [], RandomExposure().init(calibration, np.random.default_rng(0)))
    frame, _ = expose(calibration, light, 0, code, None, np.random.default_rng(1))
    error, plain = (
        np.mean((last(each, [frame], calibration).irradiance_w_m2 - light) ** 2)
        for each in (decoder, Interpolation())
    )
    assert 10 * np.log10(plain / error) > 4


@pytest.mark.parametrize("slots", [28, 12, 1])
def test_a_shortened_mixture_is_the_marginal(slots):
    """Mean and covariance of the first slots are those of the whole, component by component."""
    whole = shipped_mixture()
    short = whole.shortened(slots)
    np.testing.assert_array_equal(short.base, whole.base[..., :slots])
    rows, all_rows = (b.reshape(len(b), -1).astype(float) for b in (short.basis, whole.basis[..., :slots]))
    np.testing.assert_allclose(rows @ rows.T, np.eye(len(rows)), atol=2e-5)
    for k in (0, len(whole.shares) // 2):
        np.testing.assert_allclose(short.means[k] @ rows, whole.means[k] @ all_rows, atol=1e-5)
        found, true = (b.T @ m.covariances[k] @ b for b, m in ((rows, short), (all_rows, whole)))
        np.testing.assert_allclose(found, true, atol=2e-5 * np.abs(true).max())


def test_single_alarms_are_not_believed_and_regions_are():
    calibration = ideal_calibration(ROWS, COLS)
    light = still_light(np.full((ROWS, COLS), 0.5))
    frames = film(calibration, HdrMosaic(), [light] * 4, None)
    dn = frames[3].dn.copy()
    dn[10, 10] += 3000
    dn[20:24, 20:24] += 3000
    frames[3] = replace(frames[3], dn=dn)
    panel = calibration.panel_at_rest()
    alone, _ = demixed_frame(calibration, frames[3], panel, "undone")
    newest = alone.signal / alone.exposure
    found = last(HdrMerge(neighbours=False), frames, calibration).irradiance_w_m2[0]
    np.testing.assert_allclose(found[20:24, 20:24], newest[20:24, 20:24], rtol=1e-4)
    assert abs(found[10, 10] - newest[10, 10]) > 0.05
    believed = last(HdrMerge(speck_px=1, neighbours=False), frames, calibration).irradiance_w_m2[0]
    assert believed[10, 10] == pytest.approx(newest[10, 10], rel=1e-4)


def test_interpolation_gives_back_what_is_even_and_fills_only_what_is_near():
    calibration = ideal_calibration(ROWS, COLS)
    slopes = np.linspace(0.2, 0.8, COLS, dtype=np.float32) * np.ones((ROWS, 1), np.float32)
    frames = film(calibration, RandomExposure(), [still_light(slopes)], None)
    found = last(Interpolation(), frames, calibration)
    # Samples' weight lies beside the place asked for, typically by less than a pixel, their Gaussian's width.
    slope = slopes[0, 1] - slopes[0, 0]
    error = (found.irradiance_w_m2 - slopes)[:, 5:-5, 5:-5]
    assert np.sqrt((error**2).mean()) < slope
    assert abs(error.mean()) < 0.1 * slope
    nowhere = replace(
        frames[0], code=ExposureCode(np.zeros_like(frames[0].code.levels), frames[0].code.moving)
    )
    assert not last(Interpolation(), [nowhere], calibration).valid.any(), "never open: nothing to go on"


def test_total_variation_finds_what_is_flat_between_edges_with_any_code():
    calibration = ideal_calibration(ROWS, COLS)
    (light,) = crossing(1)
    blur = np.square(light.mean(axis=0) - light).mean()
    frames = film(calibration, RandomBinary(tile_px=5), [light], np.random.default_rng(1))
    errors = {
        kind: np.square(last(made(kind), frames, calibration).irradiance_w_m2 - light).mean() / blur
        for kind in (TotalVariation, Interpolation)
    }
    # Found: 0.80 and 1.10. Bounds of a regression: of one exposure half open little can be told.
    assert errors[TotalVariation] < 0.85
    assert errors[TotalVariation] < 0.8 * errors[Interpolation]
    # Each slot by itself is another answer, and what no slot ever opened is nobody's.
    still = last(TotalVariation(time_weight=0), frames, calibration).irradiance_w_m2
    assert np.abs(still - last(TotalVariation(), frames, calibration).irradiance_w_m2).max() > 0.01
    levels = frames[0].code.levels.copy()
    levels[:, 3, 4] = 0
    closed = replace(frames[0], code=ExposureCode(levels, frames[0].code.moving))
    found = last(TotalVariation(), [closed], calibration)
    assert not found.valid[3, 4]
    assert found.valid.sum() == ROWS * COLS - 1


def test_flow_gives_a_moving_texture_more_than_total_variation():
    rng, rows, cols = np.random.default_rng(2), 40, 48
    calibration = ideal_calibration(rows, cols)
    ground = np.kron(rng.uniform(0.1, 0.9, (rows // 5, (cols + 40) // 5 + 1)), np.ones((5, 5), np.float32))
    light = np.stack([ndimage.shift(ground, (0, 0.4 * t - 20), order=1) for t in range(SLOTS)])
    light = np.ascontiguousarray(light[:, :, 20 : 20 + cols])
    frames = film(calibration, RandomBinary(tile_px=8), [light], rng)

    def error(decoder):
        return np.square(last(decoder, frames, calibration).irradiance_w_m2 - light)[:, 4:-4, 4:-4].mean()

    flowed = error(P2c2())
    assert flowed < 0.9 * error(TotalVariation(weight=0.3))
    # No pixel agrees with its way back to a millionth: total variation is left.
    alone = error(P2c2(consistent_px=1e-6))
    assert alone > 1.1 * flowed
    # A frame of fewer slots than two groups has no flow.
    short = P2c2(group_slots=64)
    np.testing.assert_array_equal(
        last(short, frames, calibration).irradiance_w_m2,
        last(TotalVariation(weight=0.3), frames, calibration).irradiance_w_m2,
    )


@pytest.mark.parametrize(("slots", "weight"), [(SLOTS, 1.0), (8, 1 / 3)])
def test_total_variation_trusts_time_less_where_slots_are_few(slots, weight):
    calibration = ideal_calibration(12, 16, slots_per_frame=slots, coded_slots=slots)
    light = np.random.default_rng(0).uniform(0.2, 0.8, (slots, 12, 16)).astype(np.float32)
    frames = film(calibration, RandomExposure(), [light], None)
    told = last(TotalVariation(time_weight=weight), frames, calibration)
    np.testing.assert_array_equal(
        last(TotalVariation(), frames, calibration).irradiance_w_m2, told.irradiance_w_m2
    )


def test_total_variation_agrees_with_what_was_measured_as_far_as_the_noise_lets_it():
    calibration = ideal_calibration(ROWS, COLS)
    (light,) = crossing(1)
    frames = film(calibration, RandomExposure(), [light], None)
    ((_, image),) = coded_images(frames, calibration, "undone")

    def off(decoder, calibration):
        found = last(decoder, frames, calibration)
        again = np.einsum("vut,tvu->vu", image.weights, found.irradiance_w_m2)
        return np.sqrt(np.square(again - image.signal).mean()) / np.sqrt(np.square(image.signal).mean())

    few, many = (off(TotalVariation(rounds=n, weight=0.02), calibration) for n in (5, 100))
    assert many < 0.02 < 2 * few
    loud = replace(calibration, read_noise_dn=2e3)
    assert off(TotalVariation(), loud) > 5 * off(TotalVariation(), calibration)
