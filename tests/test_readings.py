"""What is read of the CCD for a panel pixel: one CCD pixel, or the mean of a square of them.

Bounds on noise are five standard errors: a false alarm in 2 million.
"""

from dataclasses import replace

import numpy as np
import pytest
from small_camera import small, uniform_light
from small_experiment import COLS, ROWS, moving_bar

from optsim.calibration import Bench, Calibration, calibrate_from
from optsim.calibration.choice import CalibrationChoice, widest_reading
from optsim.calibration.demixed import demixed_frame
from optsim.camera.camera import CodedCamera
from optsim.camera.hardware import demo
from optsim.camera.laboratory import measure_bench
from optsim.camera.true_calibration import ideal_calibration, true_calibration
from optsim.core.errors import ConfigError
from optsim.core.quantities import CodedFrame, ExposureCode
from optsim.decoding import HdrMerge, hdr_merge
from optsim.experiment import calibrations, loop
from optsim.experiment.experiment import Experiment, load_experiment
from optsim.experiment.measurement.files import measurement_files, read_measurement
from optsim.experiment.scoring import Scorer, no_rivals
from optsim.optics.readings import brightest, mean_reading


@pytest.fixture(scope="module")
def camera() -> CodedCamera:
    """At ratio 2.9, shifted and turned, so that squares lie anyhow on pixels."""
    return small()


@pytest.fixture(scope="module")
def bench(camera: CodedCamera) -> Bench:
    return measure_bench(camera, np.random.default_rng(1))


@pytest.fixture(scope="module")
def one(bench: Bench) -> Calibration:
    return calibrate_from(bench)


@pytest.fixture(scope="module")
def nine(bench: Bench) -> Calibration:
    return calibrate_from(bench, 3)


def test_squares_are_read_pixel_by_pixel_and_go_on_at_the_border() -> None:
    image = np.random.default_rng(3).integers(0, 2**16, (2, 9, 11)).astype(np.uint16)
    row, col = np.array([[0, 4], [8, 5]]), np.array([[0, 6], [10, 2]])
    for side in (1, 3, 5):
        half = side // 2
        for v, u in np.ndindex(2, 2):
            ys = np.clip(np.arange(row[v, u] - half, row[v, u] + half + 1), 0, 8)
            xs = np.clip(np.arange(col[v, u] - half, col[v, u] + half + 1), 0, 10)
            square = image[:, ys][:, :, xs].astype(np.float64)
            mean, most = (f(image, row, col, side)[:, v, u] for f in (mean_reading, brightest))
            np.testing.assert_allclose(mean, square.mean(axis=(1, 2)), rtol=1e-6)
            np.testing.assert_array_equal(most, square.max(axis=(1, 2)))
    assert mean_reading(image, row, col, 3).dtype == np.float32


def test_nine_pixels_are_the_mean_over_a_panel_pixel_where_it_covers_nine() -> None:
    """No moire, no texture missed: blocks of an image of the CCD, cut by hand."""
    small = demo().model_copy(update={"panel_rows": 24, "panel_cols": 32})
    straight = {"shift_y_px": 0.0, "shift_x_px": 0.0, "rotation_rad": 0.0, "distortion": 0.0}
    small = small.model_copy(
        update={
            "relay": small.relay.model_copy(update=straight),
            "sensor": small.sensor.model_copy(update={"rows": 72, "cols": 96}),
        }
    )
    assert small.ratio == pytest.approx(3, abs=1e-9)
    dn = np.random.default_rng(4).integers(1000, 9000, (72, 96)).astype(np.uint16)
    code = ExposureCode(np.full((36, 24, 32), 255, np.uint8), np.zeros((24, 32), np.bool_))
    calibration = ideal_calibration(small, 3)
    seen = calibration.observe(CodedFrame(0, dn, code))
    blocks = dn.reshape(24, 3, 32, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(
        seen.signal * calibration.responsivity_dn + calibration.black_dn, blocks, rtol=1e-5
    )
    assert calibration.valid.all()


@pytest.mark.slow
def test_a_bench_finds_the_true_reading(
    camera: CodedCamera, bench: Bench, one: Calibration, nine: Calibration
) -> None:
    true = true_calibration(camera, 3)
    same = (nine.centre_row == true.centre_row) & (nine.centre_col == true.centre_col)
    error = (nine.responsivity_dn / true.responsivity_dn - 1)[same]
    # The objective's glare is in the flats and not in the parts' numbers: 1e-3.
    assert abs(np.mean(error)) < 2e-3
    assert np.std(error) == pytest.approx(nine.gain_uncertainty, rel=0.1)
    # Nine times the electrons in it.
    assert one.gain_uncertainty / nine.gain_uncertainty == pytest.approx(3, rel=0.02)
    assert nine.dn_per_e == pytest.approx(true.dn_per_e, rel=0.01)
    assert nine.read_noise_dn == pytest.approx(true.read_noise_dn, rel=0.01)
    # A mean of 16 darks and 3072 readings, to five of its standard errors.
    error_dn = nine.read_noise_dn / np.sqrt(16 * nine.black_dn.size)
    assert np.mean(nine.black_dn - true.black_dn) == pytest.approx(0, abs=5 * error_dn)
    # All that a kernel gathers, with the noise of a fit: own light most of all.
    inner = (slice(4, -4), slice(4, -4))
    off = nine.crosstalk[inner] - true.crosstalk[inner]
    assert np.sqrt(np.mean(off**2)) < 0.006
    assert np.mean(off[:, :, 3, 3]) == pytest.approx(0, abs=0.01)
    # A wider square sees more of its neighbours.
    assert np.median(nine.own_share) < np.median(one.own_share) - 0.05
    assert nine.response.leak == pytest.approx(one.response.leak, rel=0.02)


@pytest.mark.parametrize("side", [1, 3])
def test_noise_is_as_predicted_and_light_is_found(
    camera: CodedCamera, one: Calibration, nine: Calibration, side: int
) -> None:
    known = one if side == 1 else nine
    rng = np.random.default_rng(8)
    code, irradiance, light = uniform_light(camera, known.responsivity_dn, rng)
    truth = camera.form_image(light)
    pair = [camera.expose(truth, 0, code, camera.panel_at_rest(), rng)[0] for _ in range(2)]
    first, second = (known.observe(frame) for frame in pair)
    squared = (first.signal - second.signal) ** 2 / (first.variance + second.variance)
    assert np.mean(squared) == pytest.approx(1, abs=5 * np.sqrt(2 / squared.size))
    sample, _ = demixed_frame(known, pair[0], known.panel_at_rest(), "undone")
    # What fields do to rims beyond mixing, no bench can know: test_laboratory.py has the same.
    assert np.mean(sample.signal / sample.exposure / irradiance) == pytest.approx(1, abs=7e-3)


def test_noise_of_nine_is_a_third(one: Calibration, nine: Calibration) -> None:
    dn = np.full((156, 204), 8000, np.uint16)
    code = ExposureCode(np.full((36, 48, 64), 255, np.uint8), np.zeros((48, 64), np.bool_))
    sigmas = [np.sqrt(c.observe(CodedFrame(0, dn, code)).variance) for c in (one, nine)]
    assert np.median(sigmas[0] / sigmas[1]) == pytest.approx(3, rel=0.01)


def test_one_saturated_pixel_of_nine_makes_the_reading_a_bound(one: Calibration, nine: Calibration) -> None:
    dn = np.full((156, 204), 3000, np.uint16)
    dn[nine.centre_row[20, 30] + 1, nine.centre_col[20, 30] - 1] = 2**14 - 1
    code = ExposureCode(np.full((36, 48, 64), 255, np.uint8), np.zeros((48, 64), np.bool_))
    clipped = nine.observe(CodedFrame(0, dn, code)).saturated
    assert clipped[20, 30]
    # At 2.9 CCD pixels to a panel pixel squares overlap here and there.
    assert 1 <= clipped.sum() <= 2
    # That of the pixel which clips first: nine levels are none above that of the middle.
    assert (nine.saturation_dn <= one.saturation_dn).all()
    assert (nine.saturation_dn < one.saturation_dn).mean() > 0.7
    full = CodedFrame(0, np.full_like(dn, 2**14 - 1), code)
    assert nine.observe(full).saturated[nine.valid].all()


def experiment(*assignments: str) -> Experiment:
    size = (
        f"camera.panel_rows={ROWS}", f"camera.panel_cols={COLS}",
        f"camera.sensor.rows={3 * ROWS + 8}", f"camera.sensor.cols={3 * COLS + 8}",
        "methods.adaptive.decoder.moving.kind=interpolation", "methods.random.decoder.kind=interpolation",
        "save_reconstructions=[]", "calibration=true", "n_frames=2",
    )  # fmt: skip
    return load_experiment("demo", [*size, *assignments])


@pytest.mark.slow
def test_each_method_reads_as_it_says_and_claims_leave_it_out() -> None:
    chosen = experiment("methods.random.reading_px=3")
    light = moving_bar(chosen, 0.8)
    result, plain = loop.run(chosen, light), loop.run(experiment(), light)
    assert set(result.calibrations) == {CalibrationChoice("true", 1), CalibrationChoice("true", 3)}
    for name, ours in result.reconstructions.items():
        theirs = plain.reconstructions[name][-1].irradiance_w_m2
        assert np.array_equal(ours[-1].irradiance_w_m2, theirs) == (name != "random")
    used, plainly = (
        {
            row.method: row.mean_e
            for row in Scorer(r.experiment, r.camera, r.truth, r.radiance).photons(r.frames)
        }
        for r in (result, plain)
    )
    # A little less: pixels are darker at their borders, where a neighbour is closed.
    assert used["random"] / plainly["random"] == pytest.approx(9, rel=0.05)
    assert used["normal"] == plainly["normal"]
    assert no_rivals(chosen) == ["adaptive", "random"]


def test_the_bench_is_measured_once_for_all_readings(monkeypatch: pytest.MonkeyPatch) -> None:
    measured: list[int] = []
    monkeypatch.setattr(calibrations, "measure_bench", lambda *_: measured.append(1))
    monkeypatch.setattr(calibrations, "bench_calibration", lambda _, __, side, measure: (measure(), side)[1])
    chosen = experiment("calibration=bench", "methods.random.reading_px=3")
    known = {CalibrationChoice("bench", 1): 1, CalibrationChoice("bench", 3): 3}
    assert calibrations.calibrate_all(chosen) == known
    assert len(measured) == 1


@pytest.mark.parametrize(
    ("assignment", "message"),
    [
        ("reading_px=2", "reading_px: got 2, expected an odd number"),
        ("reading_px=0", "reading_px"),
        ("reading_px=11", "reading_px"),
        ("reading_px=5", "reading_px: got 5, expected at most 3: a panel pixel covers 3 CCD pixels"),
        ("methods.random.reading_px=5", "methods, 'random': reading_px: got 5, expected at most 3"),
    ],
)
def test_squares_that_cannot_be_read_are_refused(assignment: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        experiment(assignment)


@pytest.mark.parametrize(
    ("ratio", "widest"), [(0.3, 1), (1, 1), (2, 1), (2.49, 1), (2.51, 3), (2.88, 3), (3, 3), (5, 5), (10, 11)]
)
def test_the_widest_square_is_hardly_wider_than_a_pixel(ratio: float, widest: int) -> None:
    assert widest_reading(ratio) == widest


def test_a_measurement_reads_squares_with_a_bench_only(
    tmp_path_factory: pytest.TempPathFactory, bench: Bench, nine: Calibration
) -> None:
    folder = tmp_path_factory.mktemp("measured")
    bench.write(folder / "bench")
    image = np.random.default_rng(6).integers(100, 9000, (156, 204)).astype(np.uint16)
    levels = np.full((36, 48, 64), 255, np.uint8)
    np.savez(folder / "shot.npz", image=image, code=levels)
    text = f'image = "{folder}/shot.npz"\ncode = "{folder}/shot.npz"\nreading_px = 3\n'
    (folder / "with.toml").write_text(text + f'bench = "{folder}/bench"\n')
    (folder / "without.toml").write_text(text)
    found = read_measurement(measurement_files(folder / "with.toml", []))
    frame = CodedFrame(0, image, ExposureCode(levels, np.ones((48, 64), np.bool_)))
    np.testing.assert_array_equal(
        found.calibration.observe(found.frames[0]).signal, nine.observe(frame).signal
    )
    with pytest.raises(ConfigError, match="reading_px: got 3 without a bench"):
        read_measurement(measurement_files(folder / "without.toml", []))


def test_what_a_reading_misses_of_its_pixel_is_that_of_its_width(
    nine: Calibration, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[float] = []

    def missed(light: np.ndarray, _: np.ndarray, ratio: float) -> np.ndarray:
        told.append(ratio)
        return light

    monkeypatch.setattr(hdr_merge, "missed", missed)
    dn = np.full((156, 204), 3000, np.uint16)
    code = ExposureCode(np.full((36, 48, 64), 255, np.uint8), np.zeros((48, 64), np.bool_))
    list(HdrMerge().decode([CodedFrame(0, dn, code)], nine))
    assert told == [pytest.approx(2.9 / 3, rel=0.02)]


def test_squares_that_leave_the_ccd_are_not_valid(camera: CodedCamera) -> None:
    geometry = replace(camera.relay_geometry(), shift_y_px=-12.0, shift_x_px=9.0)
    row, col, one = geometry.ccd_pixels(3)
    *same, whole = geometry.ccd_pixels(3, 3)
    np.testing.assert_array_equal(same, (row, col))
    inner = one & (row > 0) & (row < 155) & (col > 0) & (col < 203)
    assert inner.sum() < one.sum() < one.size
    np.testing.assert_array_equal(whole, inner)
