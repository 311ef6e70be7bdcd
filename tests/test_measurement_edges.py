"""Measurements at their edges: shutters closed for a while, hot and saturated pixels, and what is misread."""

import hashlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from skimage.io import imread
from test_measurement import COLS, ROWS, SLOTS, code, decoded, light, measured
from typer.testing import CliRunner

from optsim import __version__
from optsim.app.cli import app
from optsim.camera.hardware import demo
from optsim.camera.laboratory import measure_bench
from optsim.camera.probe import shrunk
from optsim.core.errors import ConfigError, StorageError, ValueCheckError
from optsim.core.files import read_exr, write_exr
from optsim.decoding import ALL, GaussianMixture, Interpolation, MotionDeblurring, SparseCoding
from optsim.experiment.measurement import Sensor, coded_measurement, decode_measurement
from optsim.experiment.measurement.files import MeasurementFiles, measurement_files, read_measurement
from optsim.experiment.measurement.pictures import draw_slots

NARROW = 8  # side of a tile of bumps that repeats


def moving(slots: int = 36) -> Any:
    """A pattern that drifts, (slot, v, u), around 0.5."""
    v, u = np.mgrid[:32, :32]
    return np.stack([0.5 + 0.4 * np.sin((u + 0.4 * t) / 3) * np.cos(v / 4) for t in range(slots)])


def bumps(slots: int = 36, opened: int = 36) -> Any:
    first = np.tile(np.random.default_rng(3).integers(0, opened - 2, (NARROW, NARROW)), (4, 4))
    slot = np.arange(slots)[:, None, None]
    return ((slot >= first) & (slot < first + 3)).astype(float)


def psnr(estimate: Any, truth: Any) -> float:
    return float(10 * np.log10(truth.max() ** 2 / np.mean((estimate - truth) ** 2)))


def test_slots_after_the_last_that_opens_are_not_scored(tmp_path: Path) -> None:
    truth, opened = 1000 * moving(), bumps(opened=28)
    truth[28:] = 0
    found = coded_measurement((truth * opened).sum(axis=0), opened, truth=truth)
    assert (found.calibration.slots_per_frame, found.calibration.coded_slots) == (36, 28)
    record = decode_measurement(found, Interpolation(), tmp_path / "out")
    assert (record["slots"], record["slots_opened"], record["valid_share"]) == (36, 28, 1.0)
    video = decoded(found)[0]
    assert record["psnr_db"][0] == pytest.approx(
        10 * np.log10(truth.max() ** 2 / np.mean((video[:28] - truth[:28]) ** 2)), abs=1e-3
    )
    # One in the middle is nobody's either; all of them closed say nothing at all.
    opened[10] = 0
    found = coded_measurement((truth * opened).sum(axis=0), opened, truth=truth)
    assert decode_measurement(found, Interpolation(), tmp_path / "gap")["slots_opened"] == 27
    shut = coded_measurement(np.ones((32, 32)), np.zeros((36, 32, 32)), truth=truth)
    record = decode_measurement(shut, Interpolation(), tmp_path / "shut")
    assert (record["valid_share"], record["psnr_db"]) == (0.0, [None])


@pytest.mark.parametrize("hot", [1e3, 1e5, 1e7])
def test_what_is_too_bright_takes_no_numbers_from_the_others(hot: float) -> None:
    truth, opened = moving(), bumps()
    image = (truth * opened).sum(axis=0)
    image[5, 5] = hot
    clipped = coded_measurement(image, opened, sensor=Sensor(read_noise=1e-3, saturation=5))
    seen = clipped.calibration.observe(clipped.frames[0])
    assert seen.saturated.sum() == 1
    assert seen.saturated[5, 5]
    np.testing.assert_allclose(np.delete(seen.signal, 165), np.delete(image, 165), atol=1e-4)
    # Nobody says that it is too bright: then it is refused rather than read in steps of noise.
    if hot > 1e3:
        with pytest.raises(ValueCheckError, match=r"16 bits, in steps of .*cure: sensor\.saturation"):
            coded_measurement(image, opened, sensor=Sensor(read_noise=1e-3))
    # Light that noise is larger than its steps is read whatever its span.
    coded_measurement(image * 0 + np.where(image == hot, 1e5, image), opened, sensor=Sensor(read_noise=2.0))


def test_noise_nobody_stated_is_no_more_than_eight_bits_have() -> None:
    image = (255 * moving() * bumps()).sum(axis=0)

    def noise(given: Any, **sensor: float) -> float:
        known = coded_measurement(given, bumps(), sensor=Sensor(**sensor)).calibration
        return float(known.read_noise_dn / known.responsivity_dn[0, 0])

    assert noise(np.rint(image)) == 1
    assert noise(image) == pytest.approx(1, rel=1e-3)
    for scale in (1 / 255, 1e-12):
        bright = np.percentile(np.abs(image * scale), 90)
        assert noise(image * scale) == pytest.approx(bright / 255, rel=1e-3)
    assert noise(image / 255, read_noise=0.25) == pytest.approx(0.25, rel=1e-3)
    # So the same film is as good in either unit.
    by_scale = [
        psnr(decoded(coded_measurement(image * s, bumps()), GaussianMixture())[0], 255 * s * moving())
        for s in (1.0, 1 / 255)
    ]
    assert by_scale[0] == pytest.approx(by_scale[1], abs=0.7)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ALL)
def test_light_is_linear_in_the_unit_for_every_decoder(kind: Any) -> None:
    opened, decoder = bumps(), kind()
    if kind is MotionDeblurring:
        # It wants one code for all. Told the velocity: rounding tips a search for it either way.
        opened, decoder = np.ones((32, 32)) * bumps()[:, :1, :1], MotionDeblurring(velocity_px=(0.0, 0.4))
    image = (moving() * opened).sum(axis=0)

    def video(scale: float) -> Any:
        sensor = Sensor(read_noise=1e-2 * scale)
        return decoded(coded_measurement(image * scale, opened, sensor=sensor), decoder)[0] / scale

    expected = video(1.0)
    for scale in (1e-12, 1e12):
        error = np.sqrt(np.mean((video(scale) - expected) ** 2))
        assert error < 1e-3 * expected.mean(), f"{scale:g}"


@pytest.mark.parametrize("kind", [GaussianMixture, SparseCoding])
def test_saturated_pixels_are_no_measurement(kind: Any, tmp_path: Path) -> None:
    truth = 85 * moving()
    truth[:, 8:20, 8:20] += 600
    image = np.minimum((truth * bumps()).sum(axis=0), 255).astype(np.uint8)
    found = coded_measurement(image, bumps())
    decoder = kind(uncertainty=True) if kind is GaussianMixture else kind()
    (video,) = decoder.decode(found.frames, found.calibration)
    np.testing.assert_array_equal(video.interpolated, image == 255)
    assert 0.1 < video.interpolated.mean() < 0.6
    if video.uncertainty_w_m2 is not None:
        doubtful = video.uncertainty_w_m2[:, image == 255]
        assert (doubtful >= video.irradiance_w_m2[:, image == 255]).all()
        sure = image < 200
        assert (video.uncertainty_w_m2[:, sure] < 0.5 * video.irradiance_w_m2[:, sure]).mean() > 0.5
    record = decode_measurement(found, decoder, tmp_path / "out")
    assert record["interpolated_share"] == pytest.approx((image == 255).mean())
    stored, _ = read_exr(tmp_path / "out" / "reconstruction" / "000000.exr")
    np.testing.assert_array_equal(stored["interpolated"], image == 255)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"truth": np.ones((2, SLOTS + 4, ROWS, COLS))}, r"truth: got \(2, 16, 24, 20\), expected 2 x 12"),
        ({"truth": light() + 0j}, "truth: got complex128, expected real numbers; take one part"),
        ({"truth": np.array(["a"])}, "truth: got <U1, expected real numbers"),
        ({"truth": [[1.0], [1.0, 2.0]]}, "truth: .*expected one array of numbers"),
        ({"moving": [[1]]}, r"moving: got \(1, 1\), expected one mask"),
        ({"image": np.array([[None]])}, "image: got object, expected real numbers"),
        ({"image": np.zeros((0, ROWS, COLS))}, "none of them empty"),
        ({"code": code()[:0]}, "none of them empty"),
        ({"code": np.moveaxis(code(), 0, -1)}, "the slots come last"),
        ({"image": np.ones((ROWS, COLS, 3))}, "the image has colours"),
        ({"image": np.ones((2, ROWS, COLS + 1))}, "need a calibration"),
        ({"image": np.ones((ROWS + 1, COLS, 3))}, "need a calibration"),
    ],
)
def test_what_is_no_array_of_numbers_is_refused(given: dict[str, Any], message: str) -> None:
    arrays: dict[str, Any] = {"image": measured(light(), code()), "code": code(), **given}
    with pytest.raises(ValueCheckError, match=message):
        coded_measurement(
            arrays["image"], arrays["code"], truth=arrays.get("truth"), moving=arrays.get("moving")
        )


def test_saturation_below_black_is_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", image=measured(light(), code()), code=code())
    with pytest.raises(ConfigError, match="saturation: got 100, expected more than black, 500"):
        measurement_files(tmp_path / "a.npz", ["sensor.black=500", "sensor.saturation=100"])


@pytest.mark.parametrize("scale", [1e-3, 0.2, 5.0, 1e3])
def test_a_truth_of_another_unit_than_the_image_is_refused(scale: float) -> None:
    truth, opened = 1000 * moving(), bumps()
    image = (truth * opened).sum(axis=0) + 64
    with pytest.raises(ValueCheckError, match=r"truth: under the code .* expected light in the image's unit"):
        coded_measurement(image, opened, sensor=Sensor(black=64), truth=scale * truth)
    for near in (0.5, 1.0, 2.0):  # a gain that nobody calibrated
        coded_measurement(image, opened, sensor=Sensor(black=64), truth=near * truth)
    with pytest.raises(ValueCheckError, match=r"sensor\.black: got 5000, but no count of the image is"):
        coded_measurement(image, opened, sensor=Sensor(black=5000))
    # In the dark there is nothing to compare.
    noise = np.random.default_rng(1).normal(64, 2, image.shape)
    coded_measurement(noise, opened, sensor=Sensor(black=64, read_noise=2), truth=0 * truth)


def test_a_key_of_the_decoder_that_nobody_named_is_told_as_it_is_written(tmp_path: Path) -> None:
    path = tmp_path / "shot.npz"
    np.savez(path, image=np.ones((ROWS, COLS)), code=np.ones((SLOTS, ROWS, COLS)))
    with pytest.raises(
        ConfigError, match=r"decoder\.stride: unknown key; keys here are: .*sigma_px"
    ) as refused:
        measurement_files(path, ["decoder.stride=1"])
    assert "decoder.interpolation" not in str(refused.value)


def test_a_code_that_opens_no_pixel_is_no_measurement(tmp_path: Path) -> None:
    path = tmp_path / "shot.npz"
    np.savez(path, image=np.full((ROWS, COLS), 7.0), code=np.zeros((SLOTS, ROWS, COLS)))
    done = CliRunner().invoke(app, ["reconstruct", str(path), "--out", str(tmp_path / "out")])
    assert done.exit_code == 0
    assert "No pixel is valid" in done.stderr


def test_slots_that_an_exr_lacks_are_named(tmp_path: Path) -> None:
    image, codes = measured(light(), code()), code()
    channels = {f"slot{k}": each.astype(np.float32) for k, each in enumerate(codes)}
    np.savez(tmp_path / "a.npz", image=image)
    (tmp_path / "m.toml").write_text('image = "a.npz"\ncode = "code"\n')
    files = measurement_files(tmp_path / "m.toml", [])

    def write(name: str, *missing: str) -> None:
        there = {slot: each for slot, each in channels.items() if slot not in missing}
        write_exr(tmp_path / "code" / name, there, attributes={})

    write("0.exr")
    expected = coded_measurement(image, codes).frames[0].code.levels
    np.testing.assert_array_equal(read_measurement(files).frames[0].code.levels, expected)
    write("1.exr", "slot11")
    with pytest.raises(ValueCheckError, match=r"1\.exr holds 11 channels .* expected 12 .* as 0\.exr"):
        read_measurement(files)
    write("1.exr", "slot5", "slot6")
    with pytest.raises(ValueCheckError, match=r"1\.exr: got channels .*; missing: 5, 6"):
        read_measurement(files)


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("bench")
    measure_bench(shrunk(demo(), 40), np.random.default_rng(5)).write(folder)
    return folder


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda image, levels: (image[:50, :50], levels),
            r"image: got \(50, 50\) pixels, expected \(99, 129\)",
        ),
        (lambda image, levels: (np.pad(image, 8), levels), r"image: got \(115, 145\) pixels"),
        (lambda image, levels: (image, levels[:24]), r"code: got \(24, 30, 40\), expected \(36, 30, 40\)"),
        (lambda image, levels: (image, levels * 4), "code: got values from 0 to 1020, expected drive levels"),
        (lambda image, levels: (image, levels / 255 - 0.5), r"code: got values from -0\.5 to 0\.5"),
        (lambda image, levels: (image, np.where(levels > 0, np.nan, 0.0)), "code: got values from nan"),
        (lambda image, levels: (image.astype(float), levels), "image: got float64"),
    ],
)
def test_what_no_bench_has_seen_is_refused(bench: Path, tmp_path: Path, change: Any, message: str) -> None:
    levels = np.zeros((36, 30, 40), np.uint16)
    levels[:3] = 255
    image, codes = change(np.full((99, 129), 3000, np.uint16), levels)
    np.savez(tmp_path / "a.npz", image=image, code=codes)
    files = MeasurementFiles(image=str(tmp_path / "a.npz"), code=str(tmp_path / "a.npz"), bench=str(bench))
    with pytest.raises(ValueCheckError, match=message):
        read_measurement(files)


def test_a_method_belongs_to_a_run(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", image=measured(light(), code()), code=code())
    given = ["reconstruct", str(tmp_path / "a.npz"), "--method", "random", "--out", str(tmp_path / "o")]
    found = CliRunner().invoke(app, given)
    assert isinstance(found.exception, ConfigError)
    assert "is no folder of a run" in str(found.exception)


def test_one_array_alone_is_told_what_it_lacks(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.ones((8, 8)))
    with pytest.raises(ConfigError, match=r"one file of \.npy, expected image and code"):
        measurement_files(tmp_path / "a.npy", [])


def test_a_measurement_that_is_mostly_saturated_or_without_truth_is_said_so(tmp_path: Path) -> None:
    for level, words in ((4000.0, "100% of the pixels are saturated"), (50.0, "says no truth")):
        np.savez(tmp_path / "a.npz", image=np.full((ROWS, COLS), level), code=code())
        given = [
            str(tmp_path / "a.npz"),
            "--set",
            "sensor.saturation=4000",
            "--out",
            str(tmp_path / str(level)),
        ]
        found = CliRunner().invoke(app, ["reconstruct", *given])
        assert found.exit_code == 0
        assert words in found.output
        assert ("saturated:" in found.output) == (level == 4000)


def test_a_record_says_what_was_decoded_and_by_which_version(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", image=measured(light(), code()), code=code())
    files = measurement_files(tmp_path / "a.npz", ["sensor.read_noise=2"])
    record = decode_measurement(read_measurement(files), Interpolation(), tmp_path / "out")
    said = record["measurement"]
    assert (said["image"], said["sensor"]["read_noise"]) == (str(tmp_path / "a.npz"), 2)
    want = hashlib.sha256((tmp_path / "a.npz").read_bytes()).hexdigest()
    assert said["sha256"] == {str(tmp_path / "a.npz"): want}
    assert "decoder" not in said
    assert record["optsim"] == __version__


def test_pictures_show_light_as_screens_do_and_the_truth_below(tmp_path: Path) -> None:
    truth = np.ones((2, 8, 8))
    truth[1, :, 4:] = 0.5
    found = coded_measurement(
        truth.sum(axis=0), np.ones((2, 8, 8)), truth=truth, sensor=Sensor(read_noise=0.1)
    )
    (video,) = Interpolation().decode(found.frames, found.calibration)
    draw_slots(tmp_path / "a.png", found, video)
    image = imread(tmp_path / "a.png")
    wide = 164  # of a picture and the gap beside it
    assert image.shape == (20 + 2 * wide, 3 * wide)
    right = [image[20 + wide * row + 80, wide * col + 120] for row in (0, 1) for col in (1, 2)]
    # Every slot was open alike: decoded it is .75 in both, in truth 1 and .5.
    assert right == [round(255 * each ** (1 / 2.2)) for each in (0.75, 0.75, 1.0, 0.5)]


def test_a_damaged_prior_is_named(tmp_path: Path) -> None:
    path = tmp_path / "mine.npz"
    np.savez(path, atoms=np.ones((2, 8, 8, 36)))
    path.write_bytes(path.read_bytes()[:-200])
    found = coded_measurement(np.ones((16, 16)), np.ones((36, 16, 16)))
    with pytest.raises(StorageError, match=r"mine\.npz is not a (dictionary|mixture)"):
        decoded(found, SparseCoding(dictionary=str(path)))
