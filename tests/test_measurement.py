"""Measurements of any camera: arrays and files mean the same, and decoders get what was measured."""

import json
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from scipy.io import savemat
from skimage.metrics import peak_signal_noise_ratio

from optsim.app.cli import app
from optsim.calibration import calibrate_from
from optsim.camera.hardware import demo
from optsim.camera.laboratory import measure_bench
from optsim.camera.probe import shrunk
from optsim.camera.true_calibration import true_calibration
from optsim.coding import RandomExposure
from optsim.core.errors import ConfigError, OptsimError, StorageError, ValueCheckError
from optsim.core.files import read_exr, write_exr, write_png8, write_png16
from optsim.core.quantities import ExposureCode, Floats, RadianceVideo, Segment
from optsim.decoding import GaussianMixture, Interpolation, Union
from optsim.experiment.measurement import Sensor, coded_measurement, decode_measurement, read_measurement
from optsim.experiment.measurement.coded import code_levels
from optsim.experiment.measurement.files import measurement_files

SLOTS, ROWS, COLS = 12, 24, 20


def code(seed: int = 0) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Bumps of two slots."""
    first = np.random.default_rng(seed).integers(0, SLOTS - 1, (ROWS, COLS))
    slot = np.arange(SLOTS)[:, None, None]
    return ((slot >= first) & (slot < first + 2)).astype(np.float64)


def light(frames: int = 2) -> np.ndarray[Any, np.dtype[np.float64]]:
    """A slope that brightens with time, (frame, slot, v, u)."""
    v, u = np.mgrid[:ROWS, :COLS]
    still = 20 + 2 * v + u
    return np.array([[still * (1 + 0.02 * (f * SLOTS + t)) for t in range(SLOTS)] for f in range(frames)])


def measured(truth: Any, codes: Any) -> Any:
    return (truth * codes).sum(axis=1)


def decoded(measurement: Any, decoder: Any = None) -> Floats:
    found = (decoder or Interpolation()).decode(measurement.frames, measurement.calibration)
    return np.array([video.irradiance_w_m2 for video in found])


def test_even_light_comes_back_in_counts_a_slot() -> None:
    truth = np.full((2, SLOTS, ROWS, COLS), 37.5)
    found = coded_measurement(measured(truth, code()), code())
    np.testing.assert_allclose(decoded(found), 37.5, rtol=1e-4)
    assert found.rounded == 0
    assert found.unit == "counts a slot"


def test_black_is_taken_off_and_noise_below_it_stays() -> None:
    rng = np.random.default_rng(1)
    dark = 100 + rng.normal(0, 3, (ROWS, COLS))
    found = coded_measurement(dark, code(), sensor=Sensor(black=100.0, read_noise=3.0))
    seen = found.calibration.observe(found.frames[0])
    np.testing.assert_allclose(seen.signal, dark - 100, atol=1e-3)
    # Half of the pixels are below black: 240 of 480, sigma 11.
    assert 190 < (seen.signal < 0).sum() < 290
    np.testing.assert_allclose(seen.variance[seen.signal <= 0], 9.0, rtol=1e-3)


def test_shot_noise_is_that_of_the_stated_gain_in_any_unit() -> None:
    for scale in (1.0, 1e-3, 1e4):
        image = np.full((ROWS, COLS), 400.0) * scale + np.linspace(0, 0.5, COLS) * scale
        sensor = Sensor(counts_per_electron=0.25 * scale, read_noise=2 * scale)
        found = coded_measurement(image, code(), sensor=sensor)
        variance = found.calibration.observe(found.frames[0]).variance / scale**2
        np.testing.assert_allclose(variance, 400 * 0.25 + 4, rtol=2e-3)


def test_light_is_linear_in_the_unit_of_the_image() -> None:
    image = measured(light(), code())
    one = decoded(coded_measurement(image, code()))
    other = decoded(coded_measurement(image * 1e-6, code(), sensor=Sensor(read_noise=1e-6)))
    np.testing.assert_allclose(other, one * 1e-6, rtol=1e-3)


def test_full_wells_are_told_from_the_type_or_as_stated() -> None:
    image = np.full((ROWS, COLS), 250, np.uint8)
    image[3, 4] = 255
    for given, sensor, want in (
        (image, None, 1),
        (image, Sensor(saturation=250), ROWS * COLS),
        (image.astype(float), None, 0),
        (image.astype(np.uint16), None, 0),
    ):
        found = coded_measurement(given, code(), sensor=sensor)
        assert found.calibration.observe(found.frames[0]).saturated.sum() == want


def test_what_is_not_finite_is_a_dead_pixel_and_counted(tmp_path: Path) -> None:
    image = measured(light(), code())
    image[0, 5, 6] = np.nan
    found = coded_measurement(image, code())
    assert not found.calibration.valid[5, 6]
    assert found.calibration.valid.sum() == ROWS * COLS - 1
    for video in Interpolation().decode(found.frames, found.calibration):
        assert np.isfinite(video.irradiance_w_m2).all()
    whole = coded_measurement(measured(light(), code()), code())
    for each, dead in ((found, 1), (whole, 0)):
        assert decode_measurement(each, Interpolation(), tmp_path / str(dead))["dead_pixels"] == dead


def test_grey_weights_are_rounded_and_it_is_said_how_far() -> None:
    weights = np.random.default_rng(2).random((SLOTS, ROWS, COLS))
    levels, rounded = code_levels(weights)
    shown = np.sin(levels / 255 * np.pi / 2) ** 2
    assert rounded == np.abs(shown - weights).max()
    # Half a level where the sine squared is steepest: pi/2/255/2.
    assert 0.0025 < rounded <= np.pi / 4 / 255
    found = coded_measurement(measured(light(), weights), weights)
    calibrated, _ = found.calibration.weights(found.frames[0].code, None)
    assert np.abs(calibrated - weights).max() == pytest.approx(rounded, abs=1e-6)
    whole, exact = code_levels((weights > 0.5).astype(np.uint8) * np.uint8(255))
    assert exact == 0
    assert set(np.unique(whole)) == {0, 255}


def test_one_code_for_all_images_or_one_each() -> None:
    codes = np.stack([code(0), code(1)])
    found = coded_measurement(measured(light(), codes), codes)
    assert not np.array_equal(found.frames[0].code.levels, found.frames[1].code.levels)
    np.testing.assert_array_equal(found.frames[1].code.levels, code_levels(code(1))[0])


@pytest.fixture
def arrays() -> dict[str, Any]:
    truth = light()
    return {"image": np.rint(measured(truth, code())).astype(np.uint16), "code": code(), "truth": truth}


def same(found: Any, arrays: dict[str, Any]) -> None:
    want = coded_measurement(arrays["image"], arrays["code"], truth=arrays["truth"])
    for a, b in zip(found.frames, want.frames, strict=True):
        np.testing.assert_array_equal(a.dn, b.dn)
        np.testing.assert_array_equal(a.code.levels, b.code.levels)
    np.testing.assert_allclose(np.array(found.truth), np.array(want.truth), rtol=1e-6)
    assert found.calibration.slots_per_frame == SLOTS


def test_array_files_by_both_sets_of_names_and_orders_of_axes(tmp_path: Path, arrays: Any) -> None:
    np.savez(tmp_path / "a.npz", **arrays)
    same(read_measurement(measurement_files(tmp_path / "a.npz", [])), arrays)
    time_last = {
        "meas": np.moveaxis(arrays["image"], 0, -1),
        "mask": np.moveaxis(arrays["code"], 0, -1),
        "orig": np.moveaxis(arrays["truth"].reshape(-1, ROWS, COLS), 0, -1),
    }
    savemat(tmp_path / "b.mat", time_last)
    same(read_measurement(measurement_files(tmp_path / "b.mat", [])), arrays)


@pytest.mark.parametrize("kind", ["png", "exr"])
def test_folders_of_images_that_a_toml_file_names(tmp_path: Path, arrays: Any, kind: str) -> None:
    for k, image in enumerate(arrays["image"]):
        write_png16(tmp_path / "image" / f"{k}.png", image)
    if kind == "png":
        for k, slot in enumerate(arrays["code"]):
            write_png8(tmp_path / "code" / f"{k:02d}.png", (255 * slot).astype(np.uint8))
    else:
        for k in range(2):
            # As people number them, without zeros: 10 comes after 9, not after 1.
            names = {f"slot{t}": each.astype(np.float32) for t, each in enumerate(arrays["code"])}
            write_exr(tmp_path / "code" / f"{k}.exr", names, attributes={})
    for k, pictures in enumerate(arrays["truth"]):
        names = {f"slot{t:02d}": each.astype(np.float32) for t, each in enumerate(pictures)}
        write_exr(tmp_path / "truth" / f"{k}.exr", names, attributes={})
    (tmp_path / "m.toml").write_text('image = "image/*.png"\ncode = "code"\ntruth = "truth"\n')
    found = read_measurement(measurement_files(tmp_path / "m.toml", []))
    same(found, arrays)
    names = [path for each in ("image", "code", "truth") for path in (tmp_path / each).iterdir()]
    assert set(cast("dict[str, str]", found.origin["sha256"])) == {str(name) for name in names}


def test_codes_of_all_images_one_after_the_other(tmp_path: Path, arrays: Any) -> None:
    both = np.concatenate([code(0), code(1)])
    np.savez(tmp_path / "a.npz", image=arrays["image"], code=both)
    found = read_measurement(measurement_files(tmp_path / "a.npz", [f"slots={SLOTS}"]))
    np.testing.assert_array_equal(found.frames[1].code.levels, code_levels(code(1))[0])
    with pytest.raises(ConfigError, match=r"slots: got 7, .* 24 pictures"):
        read_measurement(measurement_files(tmp_path / "a.npz", ["slots=7"]))


def test_a_measurement_decodes_into_a_folder(tmp_path: Path, arrays: Any) -> None:
    found = coded_measurement(arrays["image"], arrays["code"], truth=arrays["truth"])
    record = decode_measurement(found, Interpolation(), tmp_path / "out", peak=255.0)
    channels, said = read_exr(tmp_path / "out" / "reconstruction" / "000001.exr")
    stack = np.stack([channels[f"slot{t:02d}"] for t in range(SLOTS)])
    np.testing.assert_array_equal(stack, decoded(found)[1])
    assert said["unit"] == "counts a slot"
    want = peak_signal_noise_ratio(arrays["truth"][1], stack.astype(float), data_range=255)
    assert record["psnr_db"][1] == pytest.approx(want, abs=2e-3)
    assert json.loads((tmp_path / "out" / "results.json").read_text()) == record
    for name in ("slots.png", "film.gif"):
        assert (tmp_path / "out" / name).stat().st_size > 500
    with pytest.raises(StorageError, match="not an empty folder"):
        decode_measurement(found, Interpolation(), tmp_path / "out")


def test_a_decoder_s_uncertainty_is_written_with_the_light(tmp_path: Path) -> None:
    image, shown = np.full((ROWS, COLS), 500, np.uint16), np.zeros((36, ROWS, COLS))
    shown[:18] = 1
    found = coded_measurement(image, shown)
    decode_measurement(found, GaussianMixture(uncertainty=True), tmp_path / "sure")
    decode_measurement(found, GaussianMixture(), tmp_path / "silent")
    sure, _ = read_exr(tmp_path / "sure" / "reconstruction" / "000000.exr")
    silent, _ = read_exr(tmp_path / "silent" / "reconstruction" / "000000.exr")
    # The half that nothing was seen of is less sure: found 10.7 against 9.0 counts.
    assert sure["sigma30"].mean() > 1.1 * sure["sigma05"].mean() > 0
    assert set(sure) - set(silent) == {f"sigma{slot:02d}" for slot in range(36)}


def test_without_a_truth_there_is_no_score(tmp_path: Path, arrays: Any) -> None:
    found = coded_measurement(arrays["image"], arrays["code"])
    record = decode_measurement(found, Interpolation(), tmp_path / "out")
    assert record["psnr_db"] is None
    assert record["psnr_peak"] is None


def test_the_command(tmp_path: Path, arrays: Any) -> None:
    from typer.testing import CliRunner

    np.savez(tmp_path / "a.npz", **arrays)
    line = ["reconstruct", str(tmp_path / "a.npz"), "--out", str(tmp_path / "out"), "--json"]
    ran = CliRunner().invoke(app, [*line, "--set", "decoder.sigma_px=0.5", "--peak", "255"])
    assert ran.exit_code == 0, ran.output
    record = json.loads(ran.stdout)
    assert record["decoder"]["sigma_px"] == 0.5
    assert record["slots"] == SLOTS
    assert len(record["psnr_db"]) == 2
    both = CliRunner().invoke(
        app, [*line[:2], "--decoder", "sparse_coding", "--set", "decoder.kind=interpolation"]
    )
    assert isinstance(both.exception, ConfigError)
    assert "decoder.kind says the same; drop one" in str(both.exception)
    # Said before anything is read: no such measurement, but that comes second.
    again = CliRunner().invoke(
        app, ["reconstruct", str(tmp_path / "none.npz"), "--out", str(tmp_path / "out")]
    )
    assert isinstance(again.exception, StorageError)
    assert "not an empty folder" in str(again.exception)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"code": code()[:, :, 1:]}, r"\(24, 19\) pixels.*bench"),
        ({"code": code() * 2}, r"code: got values from 0 to 2 of float64.*cure: divide"),
        ({"code": np.stack([code()] * 3)}, r"2 images .* and 3 codes"),
        ({"image": np.zeros(7)}, r"image \(1?,?.*7.*expected \(v, u\)"),
        ({"truth": light(1)}, r"truth: got .* expected 2 x 12"),
    ],
)
def test_what_does_not_fit_is_refused(arrays: Any, change: Any, message: str) -> None:
    given = {**arrays, **change}
    with pytest.raises(ValueCheckError, match=message):
        coded_measurement(given["image"], given["code"], truth=given["truth"])


def test_files_that_are_wrong_are_named(tmp_path: Path, arrays: Any) -> None:
    np.savez(tmp_path / "a.npz", picture=arrays["image"], code=arrays["code"])
    with pytest.raises(ConfigError, match=r"image: .*a\.npz holds code, picture, expected image or meas"):
        read_measurement(measurement_files(tmp_path / "a.npz", []))
    with pytest.raises(StorageError, match=r"no such file: .*b\.npz"):
        measurement_files(tmp_path / "b.npz", [])
    (tmp_path / "m.toml").write_text('image = "nowhere"\ncode = "a.npz"\n')
    with pytest.raises(StorageError, match=r"^image: no such file or folder: .*nowhere"):
        read_measurement(measurement_files(tmp_path / "m.toml", []))
    (tmp_path / "m.toml").write_text('image = "a.npz"\ncode = "a.npz"\n')
    with pytest.raises(ConfigError, match=r"image: .*a\.npz holds code, picture, expected image or meas"):
        read_measurement(measurement_files(tmp_path / "m.toml", []))
    (tmp_path / "m.toml").write_text('imge = "a.npz"\ncode = "a.npz"\n')
    with pytest.raises(ConfigError, match=r"imge: unknown key; did you mean 'image'"):
        measurement_files(tmp_path / "m.toml", [])


def test_masks_say_where_a_union_takes_the_video(tmp_path: Path, arrays: Any) -> None:
    """The upper half of the first image, the lower half of the second; from arrays and from pictures."""
    masks = np.zeros((2, ROWS, COLS), np.uint8)
    masks[0, : ROWS // 2] = masks[1, ROWS // 2 :] = 255
    np.savez(tmp_path / "a.npz", image=arrays["image"], code=arrays["code"], moving=masks)
    for k, mask in enumerate(masks):
        write_png8(tmp_path / "moving" / f"{k}.png", mask)
    both = measurement_files(tmp_path / "a.npz", [])
    pictures = measurement_files(tmp_path / "a.npz", [f"moving={tmp_path / 'moving'}"])
    for found in (read_measurement(both), read_measurement(pictures)):
        for frame, mask in zip(found.frames, masks, strict=True):
            np.testing.assert_array_equal(frame.code.moving, mask > 0)
        union = Union(moving=Interpolation())
        for video, mask in zip(union.decode(found.frames, found.calibration), masks, strict=True):
            np.testing.assert_array_equal(video.moving, mask > 0)
    with pytest.raises(ValueCheckError, match=r"moving: got \(3, 24, 20\), expected one .* or 2 of them"):
        coded_measurement(arrays["image"], arrays["code"], moving=np.ones((3, ROWS, COLS)))


def test_what_cannot_be_scored_or_decoded_is_said_before_decoding(tmp_path: Path, arrays: Any) -> None:
    gaps = arrays["truth"].astype(float)
    gaps[0, 0, 0, :3] = np.nan
    with pytest.raises(ValueCheckError, match="truth: 3 of its numbers are not finite"):
        coded_measurement(arrays["image"], arrays["code"], truth=gaps)
    with pytest.raises(ValueCheckError, match="image: got complex128"):
        coded_measurement(arrays["image"] + 0j, arrays["code"])
    found = coded_measurement(arrays["image"], arrays["code"], truth=arrays["truth"])
    for peak in (-3.0, 0.0):
        with pytest.raises(ConfigError, match="--peak: got"):
            decode_measurement(found, Interpolation(), tmp_path / "out", peak=peak)


def test_a_prior_of_too_few_slots_is_refused_with_the_cure(arrays: Any) -> None:
    long = np.tile(arrays["code"], (4, 1, 1))[:40]
    with pytest.raises(OptsimError, match=r"36 slots, expected at least 40 slots.*total_variation"):
        decoded(coded_measurement(arrays["image"], long), GaussianMixture())


@pytest.mark.parametrize("name", ["a.npz", "a.mat"])
def test_damaged_files_are_named(tmp_path: Path, arrays: Any, name: str) -> None:
    whole = tmp_path / name
    (savemat if name.endswith("mat") else lambda path, values: np.savez(path, **values))(whole, arrays)
    stored = whole.read_bytes()
    for content in (b"", b"no arrays", stored[: len(stored) // 2]):
        whole.write_bytes(content)
        with pytest.raises(StorageError, match=rf"{name} cannot be read as a"):
            read_measurement(measurement_files(whole, []))


@pytest.mark.slow
def test_frames_of_a_camera_that_a_bench_knows(tmp_path: Path) -> None:
    camera = shrunk(demo(), 40)
    bench = measure_bench(camera, np.random.default_rng(5))
    bench.write(tmp_path / "bench")
    levels = RandomExposure().init(true_calibration(camera), np.random.default_rng(1)).levels(0)
    code = ExposureCode(levels, np.ones(levels.shape[1:], np.bool_))
    view, slots = camera.view, camera.slots_per_frame
    flat = np.full((view.rows, view.cols), 0.3, np.float32)
    still = RadianceVideo.on_view(
        view,
        camera.slot_s,
        lambda _: Segment(flat, flat, (), slots),
        slots_per_segment=slots,
        n_slots=slots,
    )
    frame, _ = camera.expose(camera.form_image(still), 0, code, None, np.random.default_rng(2))
    write_png16(tmp_path / "frame.png", frame.dn)
    np.savez(tmp_path / "code.npz", code=levels)
    (tmp_path / "m.toml").write_text('image = "frame.png"\ncode = "code.npz"\nbench = "bench"\n')
    found = read_measurement(measurement_files(tmp_path / "m.toml", []))
    want = [*Interpolation().decode([frame], calibrate_from(bench))]
    np.testing.assert_array_equal(decoded(found)[0], want[0].irradiance_w_m2)
    assert found.unit == "W m^-2 on the modulator"
    middle = decoded(found)[0][:, 5:-5, 5:-5].mean()
    assert middle == pytest.approx(0.3 * camera.irradiance_per_radiance, rel=0.05)
    with pytest.raises(ConfigError, match=r"sensor: got one and a bench"):
        read_measurement(measurement_files(tmp_path / "m.toml", ["sensor.black=3"]))
