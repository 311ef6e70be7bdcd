"""Methods that know the camera by a calibration of their own: which one they get, and what stays common."""

from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
from small_experiment import COLS, ROWS, moving_bar

from optsim.calibration.choice import CalibrationChoice
from optsim.camera.true_calibration import ideal_calibration
from optsim.core.errors import ConfigError
from optsim.core.quantities import RadianceVideo, Reconstruction
from optsim.experiment import calibrations, job, trace
from optsim.experiment.calibrations import calibrate
from optsim.experiment.experiment import Experiment, load_experiment
from optsim.experiment.loop import Result, planned, run, set_light
from optsim.experiment.scoring import Scorer, no_rivals, score
from optsim.footage.made import still

FRAMES = 4
# The adaptive scheme's mask shows what it knows, and so does the picture of the mosaic.
OWN = ("methods.adaptive.calibration=ideal", "methods.hdr_mosaic.calibration=ideal")


def small(*assignments: str, calibration: str = "true", n_frames: int = FRAMES) -> Experiment:
    return load_experiment(
        "demo",
        [
            f"n_frames={n_frames}",
            f"camera.panel_rows={ROWS}",
            f"camera.panel_cols={COLS}",
            f"camera.sensor.rows={3 * ROWS + 8}",
            f"camera.sensor.cols={3 * COLS + 8}",
            # The ideal camera has none.
            "camera.modulator.stuck_share=0.02",
            f"calibration={calibration}",
            "methods.adaptive.decoder.moving.kind=interpolation",
            "methods.random.decoder.kind=interpolation",
            "save_reconstructions=[]",
            *assignments,
        ],
    )


@pytest.fixture(scope="module")
def dark() -> RadianceVideo:
    """So dark that the camera runs open whatever is known of it: any calibration then sets the same light."""
    return moving_bar(small(), 0.8)


@pytest.fixture(scope="module")
def mixed(dark: RadianceVideo) -> Result:
    return run(small(*OWN), dark)


@pytest.mark.slow
def test_a_method_gets_what_an_experiment_of_its_calibration_gives(
    mixed: Result, dark: RadianceVideo
) -> None:
    """To the last bit, frames and pictures; the others get what they had without it."""
    whole = {name: run(small(calibration=name), dark) for name in ("true", "ideal")}
    assert all(each.light.nd_transmission == 1 for each in (mixed, *whole.values()))
    for name, own in (("adaptive", "ideal"), ("hdr_mosaic", "ideal"), ("normal", "true"), ("random", "true")):
        for one, other in zip(mixed.frames[name], whole[own].frames[name], strict=True):
            np.testing.assert_array_equal(one.code.levels, other.code.levels)
            np.testing.assert_array_equal(one.dn, other.dn)
        pairs = zip(mixed.reconstructions[name], whole[own].reconstructions[name], strict=True)
        for one, other in pairs:
            np.testing.assert_array_equal(one.valid, other.valid)
            np.testing.assert_array_equal(one.irradiance_w_m2, other.irradiance_w_m2)
    # Scheme and decoder alike: the other calibration would have given another mask, and another picture.
    codes = (each.frames["adaptive"][-1].code.moving for each in whole.values())
    assert not np.array_equal(*codes)
    pictures = (each.reconstructions["hdr_mosaic"][-1].irradiance_w_m2 for each in whole.values())
    assert not np.allclose(*pictures, rtol=0.05)


def test_all_are_scored_on_the_same_pixels(mixed: Result) -> None:
    valid = [mixed.calibrations[CalibrationChoice(name, 1)].valid for name in ("true", "ideal")]
    assert not np.array_equal(*valid), "or this tests nothing"
    counts: dict[tuple[str, str, str], set[int]] = {}
    for r in score(mixed):
        counts.setdefault((r.metric, r.region, r.phase), set()).add(r.n)
    assert all(len(n) == 1 for n in counts.values())


def test_light_is_set_by_the_calibration_of_the_experiment() -> None:
    experiment, _ = planned(small(*OWN, n_frames=1))
    bright = moving_bar(experiment, 3)
    _, light = set_light(experiment, bright, calibrate(experiment))
    _, ideal = set_light(experiment, bright, calibrate(experiment, CalibrationChoice("ideal", 1)))
    assert light.nd_transmission != pytest.approx(ideal.nd_transmission, rel=0.01)
    assert asdict(run(experiment, bright).light) == asdict(light)


def test_each_calibration_is_made_once_and_before_the_render(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[str] = []

    def noted(name: str):
        def make(camera: object, *_: object) -> object:
            made.append(name)
            return ideal_calibration(experiment.camera)

        return make

    def rendering(*_: object, **__: object) -> None:
        raise InterruptedError

    experiment = small(*OWN, "methods.random.calibration=true", calibration="bench")
    for name in ("true", "ideal"):
        monkeypatch.setattr(calibrations, f"{name}_calibration", noted(name))
    monkeypatch.setattr(calibrations, "bench_calibration", noted("bench"))
    monkeypatch.setattr(job, "render_truth", rendering)
    with pytest.raises(InterruptedError):
        job.execute(experiment, tmp_path)
    assert sorted(made) == ["bench", "ideal", "true"]


def test_what_the_bench_would_refuse_is_said_for_a_method_too(tmp_path: Path) -> None:
    tiny = ("camera.panel_rows=8", "camera.panel_cols=8")
    job.check(small(*tiny), tmp_path, None)
    with pytest.raises(ConfigError, match="at least 24 panel pixels"):
        job.check(small(*tiny, "methods.random.calibration=bench"), tmp_path, None)


def test_true_is_read_as_the_word_here_too() -> None:
    experiment = small("methods.random.calibration=true", calibration="ideal")
    assert [experiment.choice_of(method).operator for method in experiment.methods] == [
        *3 * ["ideal"],
        "true",
    ]


def test_a_trace_sees_the_frame_of_the_run(
    mixed: Result, dark: RadianceVideo, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(trace, "render_truth", lambda *_, **__: dark)
    last = mixed.frames["adaptive"][-1]
    found = trace.trace_experiment(small(*OWN), trace.TracedPixel(40, 50, last.index, "adaptive"))
    assert found.reading.drawn_dn == last.dn[40, 50]
    assert found.nd_transmission == mixed.light.nd_transmission


def test_claims_compare_schemes_that_know_the_same() -> None:
    experiment = small("methods.random.calibration=ideal", n_frames=1)
    image = np.full((3 * ROWS, 3 * COLS), 0.1, np.float32)
    timing = experiment.timing
    radiance = still(image, n_slots=timing.n_slots, slot_s=timing.slot_s, samples_per_pitch=3)
    scorer = Scorer(experiment, experiment.camera, experiment.camera.form_image(radiance), radiance)
    yes = np.ones((ROWS, COLS), np.bool_)
    names = [method.name for method in experiment.methods]
    scorer.add({name: Reconstruction(0, scorer.reference(0), yes, ~yes, ~yes) for name in names})
    found = scorer.results()
    assert {record.method for record in found["scores"]} == set(names)
    assert no_rivals(experiment) == ["adaptive", "random"]
