"""The benchmark's own arithmetic: families of records, unbiased errors, and the picture of time and error."""

import numpy as np
import pytest
from ideal_camera import ideal_calibration

import benchmarks as benchmark
from benchmarks import capture, gmm, made_film, photographs, quality
from benchmarks.axes import Axes, even_numbers, round_numbers
from benchmarks.curve import time_against_error
from benchmarks.render import _Point, _Reference, _seconds_for
from optsim.calibration.demixed import demixed_frame
from optsim.camera.effects import changed
from optsim.camera.hardware import demo
from optsim.camera.parts.objective import MOVING_TAIL_SHARE
from optsim.core.errors import ConfigError
from optsim.core.progress import silent
from optsim.core.quantities import ExposureCode
from optsim.decoding import (
    ALL,
    GaussianMixture,
    HdrMerge,
    Interpolation,
    Joined,
    MotionDeblurring,
    SparseCoding,
    Union,
    VelocityMixture,
)
from optsim.experiment.train import training_textures
from optsim.optics import moving_blur
from optsim.scene.textures import PHOTOGRAPHS


def record(name="render.x", curve=()):
    return {"name": name, "ratio": 6.25, "conditions": {"curve": list(curve)}}


def test_a_family_is_all_its_records(monkeypatch):
    asked = []
    monkeypatch.setattr(
        benchmark, "import_module", lambda _: type("M", (), {"measure": lambda n, p: asked.append(n)})
    )
    benchmark.measure_all(["render", "omp.k2000"])
    scenes = "window_room half_moving moving_camera wheel glossy_floor flicker_lamp night_street chart"
    names = [*scenes.split(), "mesh_scene", "own_world", "own_world_walking", "colour"]
    assert asked == [*(f"render.{name}" for name in names), "omp.k2000"]
    with pytest.raises(ConfigError, match="render"):
        benchmark.measure_all(["rendr"])


def test_the_reference_does_not_add_its_own_noise():
    """Of a perfect picture the squared error averages to zero, of one 10 % off to 0.01."""
    rng = np.random.default_rng(4)
    n, noise = 200_000, 0.05
    halves = 2.0 + 2.0 * noise * rng.standard_normal((2, n))
    reference = _Reference(halves, np.arange(n) < n // 2, 1e-6)
    # A product of two halves of relative deviation 0.05 deviates by 0.0025; 5 standard errors of its mean.
    perfect = reference.squared_errors(np.full(n, 2.0))
    assert perfect.shape == (2,)
    assert np.abs(perfect).max() < 5 * noise**2 / np.sqrt(n / 2) < 0.1 * noise**2
    # Off by 10 %, division by the halves' own noisy mean adds about 2 x 0.1 x 0.05^2: 5 % of 0.01.
    off = reference.squared_errors(np.full(n, 2.2))
    np.testing.assert_allclose(off, 0.01, rtol=0.1)


def test_the_plain_loops_time_for_our_error_lies_between_its_points():
    # More samples took twice as long and brought a quarter, or a ninth, of the squared error.
    points = [_Point(1.0, 0.0, np.array([0.36, 0.36])), _Point(2.0, 0.0, np.array([0.09, 0.04]))]
    np.testing.assert_allclose(_seconds_for(points[0].squared, points), 1)
    np.testing.assert_allclose(_seconds_for(points[1].squared, points), 2)
    # Half way on logarithmic axes.
    np.testing.assert_allclose(_seconds_for(np.array([0.18, 0.12]), points), np.sqrt(2))
    # Beyond them, samples are worth what independent samples are.
    np.testing.assert_allclose(_seconds_for(np.array([0.72, 0.02]), points), [0.5, 4])


def test_the_picture_has_a_line_for_each_method_and_region():
    curve = [
        {"method": m, "setting": s, "seconds": t, "error_movers": e, "error_elsewhere": e / 2}
        for m, s, t, e in (("plain", 16, 0.4, 0.2), ("plain", 64, 1.6, 0.1), ("optsim", 0.1, 0.2, 0.1))
    ]
    text = time_against_error([record(curve=curve), record("omp.k2000")])
    assert text.count("<polyline") == 4
    assert text.count("<circle") == 6
    assert "6.2x the plain loop" in text
    assert "omp" not in text
    assert time_against_error([]).startswith("<svg")


@pytest.mark.parametrize("is_divided", [False, True])
@pytest.mark.parametrize("share", [0.2, 1.0])
def test_the_dense_frame_is_ours_but_for_what_ours_leaves_out(monkeypatch, share, is_divided):
    """Without wings and glare, which ours treats more cheaply on what moves, both are the same numbers."""
    # And with all of the PSF in every instant; divided it leaves a rest beside the window.
    monkeypatch.setattr(moving_blur, "FEW", 0 if is_divided else 10**9)
    whole = demo().without_glare()
    # Nor with a PSF that varies, whose modes leave a stated rest on what moves (tests/test_field_blur.py).
    lens = whole.objective.model_copy(update={"tail_share": MOVING_TAIL_SHARE, "field_error": 1.0})
    sensor = whole.sensor.model_copy(update={"rows": 80, "cols": 98})
    camera = whole.model_copy(
        update={"objective": lens, "sensor": sensor, "panel_rows": 24, "panel_cols": 30}
    )
    rng = np.random.default_rng(3)
    radiance = capture.moving_patches(camera, share, rng)
    levels = capture._random_code(camera, rng)
    code = ExposureCode(levels, np.ones(levels.shape[1:], np.bool_))
    ours, _ = camera.expected_electrons(camera.form_image(radiance), 0, code, camera.panel_at_rest())
    dense = capture._dense(camera, radiance, code, silent)
    assert np.median(dense) > 100
    left = 1e-4 * dense.max() if is_divided else 1e-3 * np.median(dense)
    np.testing.assert_allclose(ours, dense, rtol=1e-4, atol=left)
    pictures = np.stack([radiance.load(segment).instant(i) for segment in (0, 1) for i in (0, 9, 17)])
    moved = np.mean(np.ptp(pictures, axis=0) > 1e-4 * pictures.mean(axis=0))
    assert 0.8 * share < moved <= share


def test_the_dense_frame_is_ours_when_nothing_is_left_out():
    """Wings, glare and a PSF that varies, before a window a thousand times as bright as the room."""
    lens = {"moving_tail_share": 0.0, "field_error": 0.05, "tail_share": 1e-3, "glare_share": 0.01}
    # With the finer nodes at pixel edges; the default's leave a rest three times as large.
    camera = changed(demo(), {"objective": lens, "modulator": {"fringe_model": "fine"}})
    sensor = camera.sensor.model_copy(update={"rows": 80, "cols": 98})
    camera = camera.model_copy(update={"sensor": sensor, "panel_rows": 24, "panel_cols": 30})
    rng = np.random.default_rng(3)
    radiance = capture.moving_patches(camera, 1.0, rng)
    levels = capture._random_code(camera, rng)
    code = ExposureCode(levels, np.ones(levels.shape[1:], np.bool_))
    ours, _ = camera.expected_electrons(camera.form_image(radiance), 0, code, camera.panel_at_rest())
    dense = capture._dense(camera, radiance, code, silent)
    np.testing.assert_allclose(ours, dense, rtol=1e-5, atol=1e-6 * dense.max())
    cheaper = changed(camera, {"objective": {"moving_tail_share": 6e-3}})
    other, _ = cheaper.expected_electrons(cheaper.form_image(radiance), 0, code, camera.panel_at_rest())
    assert np.abs(other - dense).max() > 20 * np.abs(ours - dense).max()


def test_the_plain_mixture_is_ours(monkeypatch):
    """The dense computation beside which the decoder is timed gives its picture, at a mask's edge too."""
    for name, value in {"_SIDE": 28, "_CORNER": 12, "_SQUARE": 64, "_ROUNDS": 1}.items():
        monkeypatch.setattr(gmm, name, value)
    found = gmm.measure("gmm.36x256")
    conditions = found["conditions"]
    # Float32 of some hundred products.
    assert 0 < conditions["max_difference"] < 1e-5
    # Patches start at 0, 2 .. 20 on each axis; those that touch the corner at 0, 2 .. 10.
    assert (conditions["patches"], conditions["peer_patches"]) == (121, 36)
    assert found["value"] * conditions["seconds"] == pytest.approx(1)
    assert found["ratio"] == pytest.approx(found["value"] / found["peer_value"])
    assert conditions["seconds_over_sgemm"] > 0


def test_the_made_film_moves_hides_and_exposes_as_stated():
    film = made_film.made_film(40, 48, 36, np.random.default_rng(1))
    assert film.shape == (36, 40, 48)
    assert 0.05 <= film.min() < 0.2 < 0.8 < film.max() <= 1
    changed = np.ptp(film, axis=0) > 0.1
    assert 0.2 < changed.mean() < 1
    calibration = ideal_calibration(40, 48)
    levels = np.full((36, 40, 48), 255, np.uint8)
    code = ExposureCode(levels, np.ones((40, 48), np.bool_))
    frame, scale = made_film.photograph(calibration, code, film, np.random.default_rng(2))
    dn = frame.dn.astype(float) - 64
    expected = film.sum(axis=0) * scale * 270
    assert expected.max() == pytest.approx(2 / 3 * (15_000 - 64), rel=1e-5)
    # Shot noise at one DN an electron, and 3 DN of the readout: 1920 pixels tell its variance within 3.2 %,
    # three and a half standard errors are 11 %.
    error = (dn - expected) / np.sqrt(expected + 9)
    assert np.square(error).mean() == pytest.approx(1, abs=0.11)
    assert abs(error.mean()) < 4 / np.sqrt(error.size)


def test_quality_is_that_of_every_decoder_of_moving_light(monkeypatch):
    kinds = {type(decoder) for _, _, decoder in quality.decoders()}
    # The merge is of what stands still, the union is made of it and of one of the others; deblurring takes
    # codes that all pixels share, which the film's isn't.
    assert kinds == set(ALL) - {HdrMerge, Union, MotionDeblurring}
    joined = next(d for line, setting, d in quality.decoders() if (line, setting) == ("joined", "stride 2"))
    assert joined == Joined(decoders=(SparseCoding(stride_px=2), VelocityMixture()))
    few = [("interpolation", "", Interpolation())]
    few += [("gaussian_mixture", f"stride {n}", GaussianMixture(stride_px=n)) for n in (8, 2)]
    monkeypatch.setattr(quality, "decoders", lambda: few)
    monkeypatch.setattr(quality, "_SIDE", 48)
    found = quality.measure("reconstruct.quality")
    points = found["conditions"]["quality"]
    levels = {f"{p['decoder']} {p['setting']}": p["psnr_db"] for p in points}
    still = found["conditions"]["long_exposure_psnr_db"]
    # Light in the unit of the film: otherwise no decoder would come near it, nor above the blur.
    assert still < min(levels.values()) < max(levels.values()) < still + 10
    assert levels["gaussian_mixture stride 8"] < levels["gaussian_mixture stride 2"] == found["value"]
    assert found["ratio"] == pytest.approx(10 ** ((found["value"] - levels["interpolation "]) / 10))
    drawn = benchmark.pictures([found, {"conditions": {}}])
    assert set(drawn) == {"quality_against_time.svg"}
    text = drawn["quality_against_time.svg"]
    assert (text.count("<polyline"), text.count("<circle")) == (2, 3)
    assert ">stride 8 .. stride 2<" in text
    assert set(benchmark.pictures([record(curve=[])])) == {"time_against_error.svg"}


def test_photographs_are_those_that_no_prior_has_seen_and_are_exposed_as_stated():
    learned = {PHOTOGRAPHS[name] for name in training_textures() if name in PHOTOGRAPHS}
    assert len(learned) > 5
    assert not learned & set(photographs.NAMES)
    measurement = photographs.photographed(2)
    (film,), (frame,) = measurement.truth, measurement.frames
    assert 0 <= film.min() < film.max() <= 255
    # The ground moves by a fifth of a pixel a slot, some disc by one: still pictures lose to what moves.
    assert 20 < quality.psnr_db(np.broadcast_to(film.mean(axis=0), film.shape) / 255, film / 255) < 30
    sample, _ = demixed_frame(
        measurement.calibration, frame, measurement.calibration.panel_at_rest(), "undone"
    )
    opened = sample.weights
    np.testing.assert_array_equal(opened.sum(axis=0), 3)
    error = sample.signal - np.einsum("tvu,tvu->vu", opened, film)
    wanted = np.sqrt(1 + 1 / 12) / 255 * np.einsum("tvu,tvu->vu", opened, film).max()
    # 16384 pixels tell a standard deviation within 0.55 %; clipped ones are fewer than 1 in a thousand.
    assert np.std(error) == pytest.approx(wanted, rel=0.025)
    assert abs(error.mean()) < 4 * wanted / 128


def test_photographs_lie_beside_their_pixels_or_shine_through_closed_ones():
    """Recomputed by the Fourier shift theorem, away from the rims."""
    ideal, moved, dim = (
        photographs.photographed(2, **each) for each in ({}, {"shift_px": 0.15}, {"leak": 0.05})
    )
    (film,) = moved.truth
    np.testing.assert_array_equal(film, ideal.truth[0])
    frequencies = np.fft.fftfreq(film.shape[2])
    shifted = np.fft.ifft(np.fft.fft(film, axis=2) * np.exp(-2j * np.pi * frequencies * 0.15), axis=2).real

    def read(measurement):
        calibration, (frame,) = measurement.calibration, measurement.frames
        sample, _ = demixed_frame(calibration, frame, calibration.panel_at_rest(), "undone")
        return sample.weights, sample.signal

    weights, signal = read(moved)
    inner = np.s_[:, 16:-16]
    errors = [np.std((signal - np.einsum("tvu,tvu->vu", weights, each))[inner]) for each in (shifted, film)]
    assert errors[0] < 0.8 * errors[1]
    weights, signal = read(dim)
    assert (weights.min(), weights.max()) == (pytest.approx(0.05, abs=2e-3), pytest.approx(1))
    assert np.std(signal - np.einsum("tvu,tvu->vu", weights, film)) < 0.02 * signal.mean()


def test_photographs_are_scored_in_the_mean_of_all_films(monkeypatch):
    few = {"interpolation": Interpolation(), "mixture": GaussianMixture(stride_px=4)}
    monkeypatch.setattr(photographs, "decoders", lambda: few)
    monkeypatch.setattr(photographs, "NAMES", ("camera.png", "page.png"))
    found = photographs.measure("reconstruct.photographs")
    conditions = found["conditions"]
    assert conditions["best"] == "mixture"
    both = conditions["psnr_db"]["mixture"]
    assert found["value"] == pytest.approx((both["camera.png"] + both["page.png"]) / 2)
    assert found["value"] > found["peer_value"] + 1
    measurement = photographs.photographed(1)
    (video,) = few["mixture"].decode(measurement.frames, measurement.calibration)
    (truth,) = measurement.truth
    assert both["page.png"] == pytest.approx(quality.psnr_db(video.irradiance_w_m2 / 255, truth / 255))


def test_psnr_is_of_a_white_of_one():
    film = np.full((2, 3, 3), 0.5, np.float32)
    assert quality.psnr_db(film + np.float32(0.1), film) == pytest.approx(20, abs=1e-4)


def test_places_in_a_picture_follow_its_ticks():
    axes = Axes(10, 110, 20, 60, round_numbers(0.3, 15), even_numbers(16.2, 19.5, 1.0), log_up=False)
    assert axes.across == pytest.approx([0.2, 0.5, 1, 2, 5, 10, 20])
    assert axes.up == [16, 17, 18, 19, 20]
    assert axes.place(2, 17) == pytest.approx((60, 50))
    assert axes.place(0.2, 20) == pytest.approx((10, 20))
    both = Axes(10, 110, 20, 60, [1, 10, 100], [0.01, 0.1, 1.0])
    assert both.place(10, 0.1) == pytest.approx((60, 40))
    assert sum("5 %" in part for part in Axes(0, 9, 0, 9, [1, 2], [0.05, 0.1]).grid("%", 100)) == 1
