"""A coded frame from the arrays of its sample: by the lines of the manual, and without noise."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from optsim.camera.true_calibration import true_calibration
from optsim.core.files import write_exr, write_json
from optsim.core.quantities import RadianceVideo
from optsim.dataset import build_dataset, load_spec, open_dataset
from optsim.dataset.arrays import BY_SCHEME
from optsim.dataset.coded_arrays import write_explained, write_light
from optsim.dataset.reading import Sample
from optsim.experiment.experiment import Experiment, load_experiment
from optsim.experiment.loop import capture, set_light
from optsim.experiment.run_folder import write_calibrations, write_frames
from optsim.footage.made import footage
from optsim.render import choose_backend

PAGE = Path(__file__).parents[1] / "docs/how-to/datasets.md"
ROWS, COLS, FRAMES = 48, 64, 2
SMALL = [
    f"n_frames={FRAMES}",
    f"camera.panel_rows={ROWS}",
    f"camera.panel_cols={COLS}",
    "camera.sensor.rows=160",
    "camera.sensor.cols=208",
    "calibration='true'",
]
# Six sigma of a mean over 2 x 2900 residuals is 0.06; what the lines leave out is systematic.
MOST = 1.1


def film(experiment: Experiment) -> RadianceVideo:
    """Texture of single fine samples that a bar crosses, beside a window 100 times as bright."""
    rng = np.random.default_rng(5)
    still = rng.uniform(0.04, 0.2, (3 * ROWS, 3 * COLS))
    still[20:60, 120:160] = 10.0 * rng.uniform(0.5, 1.0, (40, 40))
    frames = np.repeat(still[None], experiment.timing.n_slots, 0)
    for slot in range(len(frames)):
        left = 5 + slot
        frames[slot, 80:110, left : left + 24] = 0.4
    light = frames.astype(np.float32)
    return footage(light, slot_s=experiment.timing.slot_s, samples_per_pitch=3, white_w_m2_sr=0.4)


@pytest.fixture(scope="module")
def sample(tmp_path_factory: pytest.TempPathFactory) -> Sample:
    folder = tmp_path_factory.mktemp("sequence")
    whole = load_experiment("demo", SMALL)
    methods = tuple(each for each in whole.methods if each.name in ("random", "hdr_mosaic"))
    experiment = whole.model_copy(update={"methods": methods})
    known = dict.fromkeys([experiment.calibration_choice], true_calibration(experiment.camera))
    radiance = film(experiment)
    camera, light = set_light(experiment, radiance, known[experiment.calibration_choice])
    truth = camera.form_image(radiance)
    frames = capture(experiment, camera, truth, known)
    seed = folder / "seed1"
    write_calibrations(experiment, seed, known)
    write_frames(seed, frames)
    write_light(folder, camera, truth, FRAMES, half=True)
    for name, taken in frames.items():
        write_explained(seed, name, camera, truth, known[experiment.calibration_choice], taken)
    facts = {
        "irradiance_per_radiance": camera.irradiance_per_radiance,
        "nd_transmission": light.nd_transmission,
    }
    write_json(seed / "light.json", facts)
    # The reader finds a sequence by its slots of truth.
    write_exr(folder / "truth/slot000000.exr", {"Y": radiance.load(0).start}, attributes={"id_table": {}})
    expected_e, _ = camera.expected_electrons(truth, 0, frames["random"][0].code, None)
    return Sample(folder, 1, {"name": "made", "camera": camera, "expected_e": expected_e})


def lines() -> dict[str, Any]:
    """Functions of the manual that explain a frame."""
    (code,) = [
        each
        for each in re.findall(r"^```python\n(.*?)^```$", PAGE.read_text(), re.DOTALL | re.MULTILINE)
        if "def explained" in each
    ]
    there: dict[str, Any] = {}
    exec(code[: code.index("\nsample = open_dataset")], there)
    return there


def residuals(sample: Sample, scheme: str, frame: int, said: np.ndarray) -> np.ndarray:
    row, col = sample["operator/row"], sample["operator/col"]
    read, sigma = (sample[f"{kind}/{scheme}"][frame][row, col] for kind in ("frames", "sigma"))
    seen = sample["calibration/valid"] & (read < sample["calibration/saturation_dn"])
    assert seen.mean() > 0.5
    return ((read - said) / sigma)[seen]


@pytest.mark.parametrize("frame", range(FRAMES))
@pytest.mark.parametrize("scheme", ["random", "hdr_mosaic"])
def test_the_lines_of_the_manual_explain_a_frame_within_its_noise(sample, scheme, frame):
    residual = residuals(sample, scheme, frame, lines()["explained"](sample, scheme, frame))
    assert np.sqrt(np.mean(residual**2)) < MOST


def test_what_the_lines_leave_out_is_small_in_a_later_frame_too(sample):
    """Without noise: the panel still answers to the code of the frame before."""
    said = lines()["explained"](sample, "hdr_mosaic", 1)
    row, col = sample["operator/row"], sample["operator/col"]
    expected, sigma = (sample[f"{kind}/hdr_mosaic"][1][row, col] for kind in ("expected", "sigma"))
    seen = sample["calibration/valid"] & (expected < sample["calibration/saturation_dn"])
    off = ((expected - said) / sigma)[seen]
    assert np.sqrt(np.mean(off**2)) < 0.33


@pytest.mark.parametrize("left_out", ["light", "core", "tails", "mirrored", "transmission"])
def test_each_array_matters(sample, left_out):
    """Without any of them the frame is no longer explained."""

    class Without(dict):
        def __missing__(self, name):
            array = np.array(sample[name])
            if name == "light_on_panel" and left_out == "light":
                # Each panel pixel's mean: what a code's own grid shows.
                cells = array.reshape(len(array), ROWS, 3, COLS, 3).mean((2, 4))
                array = cells.repeat(3, axis=1).repeat(3, axis=2)
            if name == f"operator/{left_out}":
                array = array * 0
            if name.startswith("transmission/") and left_out == "transmission":
                whole = sample[name.replace("transmission", "weights")]
                array = whole.repeat(3, axis=2).repeat(3, axis=3)
            return array

    whole, part = (lines()["explained"](each, "hdr_mosaic", 0) for each in (sample, Without()))
    before, after = (np.mean(residuals(sample, "hdr_mosaic", 0, said) ** 2) for said in (whole, part))
    assert after > before + (0.005 if left_out == "mirrored" else 0.02)


def test_expected_and_sigma_are_mean_and_deviation_of_many_frames(sample):
    """Of 400 frames with the photons drawn anew, by this test's own sums."""
    camera, expected_e = sample.about["camera"], sample.about["expected_e"]
    rng = np.random.default_rng(3)
    n, total, squares = 400, 0.0, 0.0
    for _ in range(n):
        dn = camera.sensor.digitise(expected_e, camera.exposure_s, camera.serial_number, rng)[0].astype(float)
        total, squares = total + dn, squares + dn**2
    mean, deviation = total / n, np.sqrt((squares / n - (total / n) ** 2) * n / (n - 1))
    said, sigma = sample["expected/random"][0], sample["sigma/random"][0]
    # A tenth of the well from full: the bend is convex there, and the mean of a bent signal is not the bent
    # mean; above it the clip narrows the noise.
    clear = said < 0.9 * camera.sensor.max_dn
    clear &= said < sample["calibration/saturation_dn"].min()
    z = ((mean - said) / (sigma / np.sqrt(n)))[clear]
    # Of 30 000 pixels, five sigma: a false alarm in 60 runs of the suite.
    assert abs(z).max() < 5.5
    assert np.mean(z) == pytest.approx(0, abs=0.05)
    ratio = (deviation / sigma)[clear]
    assert np.mean(ratio) == pytest.approx(1, abs=0.004)
    assert np.std(ratio) == pytest.approx(1 / np.sqrt(2 * (n - 1)), rel=0.1)


def test_target_is_the_mean_of_the_light_over_each_panel_pixel(sample):
    light, target = sample["light_on_panel"], sample["target"]
    assert target.shape == (FRAMES, 36, ROWS, COLS)
    cells = light.reshape(FRAMES, 36, ROWS, 3, COLS, 3).mean((3, 5), dtype=np.float64)
    # The lens shades light_on_panel alone; a smooth map, the same in all slots.
    shading = np.median(cells / target, axis=(0, 1))
    np.testing.assert_allclose(cells, target * shading, rtol=3e-3)
    assert 0.9 < shading.min() <= shading.max() < 1.01


def test_every_array_says_its_unit_and_axes(sample):
    for name in sample:
        array, axes = sample[name], sample.axes(name)
        assert sample.unit(name)
        listed = [each for each in re.sub(r"\(.*?\)", "c", axes).split(",") if each.strip()]
        if not axes.startswith("("):
            assert array.size == 1 or array.ndim == len(listed), name
    assert {f"{kind}/random" for kind in BY_SCHEME} <= {*sample, "reconstructions/random"}


@pytest.mark.slow
@pytest.mark.parametrize("scene", ["flying_solids", "window_room"])
def test_the_lines_explain_four_rendered_frames_of_each_scene(tmp_path, scene):
    """By what the bench knows, from a set that a build made."""
    if choose_backend().preview:
        pytest.skip("only the scalar fallback works here")
    text = f"""
name = "explained"
n_frames = 4
schemes = ["random", "hdr_mosaic", "normal"]
half = true
reconstruct = true
[scenes]
{scene} = ["3"]
[cameras.main]
panel_rows = {ROWS}
panel_cols = {COLS}
sensor = {{ rows = 160, cols = 208 }}
objective = {{ focal_length_m = "1.3333 mm" }}
[noise]
train = {{ share = 0.3 }}
"""
    (tmp_path / "spec.toml").write_text(text)
    outcome = build_dataset(load_spec(str(tmp_path / "spec.toml")), tmp_path / "set", workers=1)
    assert outcome.failed == {}
    sample = open_dataset(tmp_path / "set").train[0]
    for scheme in ("random", "hdr_mosaic", "normal"):
        for frame in range(4):
            residual = residuals(sample, scheme, frame, lines()["explained"](sample, scheme, frame))
            assert np.sqrt(np.mean(residual**2)) < MOST, (scheme, frame)
    # A reconstruction is radiance, as the target is.
    ratio = sample["reconstructions/normal"] / sample["target"]
    assert np.nanmedian(ratio) == pytest.approx(1, abs=0.1)
