"""The glue between truth, camera and scores, on footage: light rule, states of the loop, scorer."""

import math
from dataclasses import replace

import numpy as np
import pytest

from optsim.core.quantities import ExposureCode, PanelState, RadianceVideo, Reconstruction
from optsim.core.random_streams import stream
from optsim.decoding import HdrMerge
from optsim.experiment.calibrations import calibrate, calibrate_all
from optsim.experiment.experiment import Experiment, load_experiment
from optsim.experiment.loop import capture, set_light
from optsim.experiment.scoring import Scorer, no_rivals
from optsim.footage.made import footage, still
from optsim.metrics import PairTally, luminous_efficacy_lm_w

ROWS, COLS = 24, 32


def small(*assignments: str, n_frames: int = 2, preset: str = "demo") -> Experiment:
    return load_experiment(
        preset,
        [
            f"n_frames={n_frames}",
            f"camera.panel_rows={ROWS}",
            f"camera.panel_cols={COLS}",
            f"camera.sensor.rows={3 * ROWS + 8}",
            f"camera.sensor.cols={3 * COLS + 8}",
            # The same field as the whole demo: cos^4 is 0.79 in the corners.
            f"camera.objective.focal_length_m='{12.5 * COLS / 600} mm'",
            "calibration=true",
            "save_reconstructions=[]",
            *assignments,
        ],
    )


def flat(experiment: Experiment, radiance: float) -> RadianceVideo:
    image = np.full((3 * ROWS, 3 * COLS), radiance, np.float32)
    return still(
        image,
        n_slots=experiment.timing.n_slots,
        slot_s=experiment.timing.slot_s,
        samples_per_pitch=3,
        white_w_m2_sr=0.4,
    )


def scorer(experiment: Experiment, radiance: RadianceVideo, nd: float = 1.0) -> Scorer:
    camera = experiment.camera.with_nd(nd)
    return Scorer(experiment, camera, camera.form_image(radiance), radiance)


@pytest.mark.parametrize("overlap", ["true", "false"])
def test_the_light_rule_predicts_what_the_camera_reads(overlap: str) -> None:
    """All-on, settled: the interior's percentile in a real frame is the one that the rule says."""
    experiment = small(f"camera.overlap={overlap}", "camera.relay.glare_share=0")
    image = np.full((3 * ROWS, 3 * COLS), 0.5, np.float32)
    # The brightest tenth of the interior lies in the corners, where shading matters.
    image[:18, :18] = image[:18, -18:] = image[-18:, :18] = image[-18:, -18:] = 1.0
    outside = np.zeros(image.shape, np.bool_)
    outside[21:51, 30:66] = True
    image[outside] = 3.0
    radiance = replace(
        still(image, n_slots=72, slot_s=experiment.timing.slot_s, samples_per_pitch=3), outside=outside
    )
    calibration = calibrate(experiment)
    camera, light = set_light(experiment, radiance, calibration)
    clip = (calibration.saturation_dn - calibration.black_dn)[calibration.valid]
    assert light.saturation_dn == pytest.approx(np.median(clip), rel=1e-6)
    assert light.nd_transmission < 1
    code = ExposureCode(np.full((36, ROWS, COLS), 255, np.uint8), np.zeros((ROWS, COLS), np.bool_))
    settled = PanelState(np.full((ROWS, COLS), np.pi, np.float32), np.full((ROWS, COLS), 255, np.uint8))
    frame, _ = camera.expose(camera.form_image(radiance), 0, code, settled, np.random.default_rng(0))
    raw = frame.dn[calibration.centre_row, calibration.centre_col] - calibration.black_dn
    inside = calibration.valid & ~outside.reshape(ROWS, 3, COLS, 3).any(axis=(1, 3))
    assert np.percentile(raw[inside], 90) == pytest.approx(light.percentile_dn, rel=0.04)


def test_capture_passes_the_panel_on_and_draws_new_photons() -> None:
    experiment = small()
    radiance = flat(experiment, 0.2)
    known = calibrate_all(experiment)
    camera, _ = set_light(experiment, radiance, known[experiment.calibration_choice])
    truth = camera.form_image(radiance)
    frames = capture(experiment, camera, truth, known)["normal"]
    panel = None
    for index, frame in enumerate(frames):
        photons = stream(experiment.seed, "shot", "normal", index)
        again, panel = camera.expose(truth, index, frame.code, panel, photons)
        np.testing.assert_array_equal(again.dn, frame.dn)
    assert not np.array_equal(frames[0].dn, frames[1].dn)


@pytest.mark.parametrize("source", ["true", "ideal", "bench"])
def test_the_calibration_asked_for_is_the_one_made(source: str) -> None:
    assert calibrate(small(f"calibration={source}")).source == source


def test_a_change_from_frame_to_frame_counts_as_motion_and_one_within_the_noise_does_not() -> None:
    experiment = small()
    frames = np.full((72, 3 * ROWS, 3 * COLS), 0.2, np.float32)
    frames[36:, 30:42, 30:42] = 0.3
    scores = scorer(
        experiment, footage(frames, slot_s=experiment.timing.slot_s, samples_per_pitch=3, white_w_m2_sr=0.4)
    )
    assert not scores.moving(0).any(), "still within the first frame"
    assert scores.moving(1)[11:13, 11:13].all()
    assert not scores.moving(1)[:5].any()
    # A slot of 0.002 W m^-2 sr^-1 is some 5 e- under 9 e- of read noise: 5 % of it is no visible change.
    dark = scorer(
        experiment,
        footage(
            (frames / 100 * np.where(frames > 0.25, 0.7, 1)).astype(np.float32),
            slot_s=1 / 180,
            samples_per_pitch=3,
        ),
    )
    assert not dark.moving(1).any()


def test_the_noise_ceiling_is_the_psnr_of_half_the_difference() -> None:
    """A half difference d everywhere, behind any lens shading and density, is 10 log10(white^2 / d^2)."""
    experiment = small("camera.objective.glare_share=0", n_frames=6)
    radiance = replace(flat(experiment, 0.2), half_difference=flat(experiment, 0.004))
    records = scorer(experiment, radiance, nd=0.3).noise_ceiling()
    psnr = [r.value for r in records if r.metric == "PSNR[peak=white]" and r.region == "all"]
    assert psnr
    assert psnr == pytest.approx([40.0] * len(psnr), abs=0.02)


def test_luminance_is_that_of_the_scene_whatever_the_density() -> None:
    experiment = small("camera.objective.glare_share=0")
    scores = scorer(experiment, flat(experiment, 0.2), nd=0.25)
    luminance = scores.scale.luminance_cd_m2(scores.reference(0))
    np.testing.assert_allclose(luminance, 0.2 * luminous_efficacy_lm_w(), rtol=1e-4)


def test_photons_are_electrons() -> None:
    experiment = small("camera.relay.glare_share=0")
    radiance = flat(experiment, 0.02)
    calibration = calibrate(experiment)
    scores = scorer(experiment, radiance)
    frames = capture(experiment, scores.camera, scores.truth, {experiment.calibration_choice: calibration})
    row = next(r for r in scores.photons(frames) if r.method == "normal")
    frame = frames["normal"][1]
    settled = PanelState(np.full((ROWS, COLS), np.pi, np.float32), np.full((ROWS, COLS), 255, np.uint8))
    expected, _ = scores.camera.expected_electrons(scores.truth, 1, frame.code, settled)
    picked = expected[calibration.centre_row, calibration.centre_col][calibration.valid]
    # The first slot of the first frame finds the panel dark; the gain is 0.96 e-/DN.
    assert row.mean_e == pytest.approx(picked.mean(), rel=0.02)
    assert row.saturated_share == 0


def test_glare_lowers_the_ratio_of_window_and_interior() -> None:
    experiment = small()
    outside = np.zeros((3 * ROWS, 3 * COLS), np.bool_)
    outside[:24, :24] = True
    image = np.where(outside, 100, 0.01).astype(np.float32)
    radiance = replace(
        still(image, n_slots=72, slot_s=experiment.timing.slot_s, samples_per_pitch=3), outside=outside
    )
    scores = scorer(experiment, radiance)
    before, after = scores.window_ratio(glare=False), scores.window_ratio(glare=True)
    assert before is not None
    assert after is not None
    assert 1.5 * after < before <= 1e4


@pytest.mark.parametrize("ratio", [3.0, 2.88])
def test_a_uniform_static_scene_reads_back_through_the_mosaic_at_any_ratio(ratio: float) -> None:
    """At 2.88 the picked CCD pixel wanders over the panel pixel, so its share of neighbours' light varies."""
    experiment = small(
        f"camera.relay.magnification={ratio * 4.54 / 20}", "camera.relay.glare_share=0", n_frames=4
    )
    radiance = flat(experiment, 0.2)
    calibration = calibrate(experiment)
    camera, _ = set_light(experiment, radiance, calibration)
    truth = camera.form_image(radiance)
    frames = capture(experiment, camera, truth, {experiment.calibration_choice: calibration})["hdr_mosaic"]
    last = list(HdrMerge().decode(frames, calibration))[-1]
    middle = np.s_[5:-5, 5:-5]
    quotient = (last.irradiance_w_m2[0] / camera.reference(truth, 3)[0])[middle][last.valid[middle]]
    assert quotient.mean() == pytest.approx(1, abs=0.02)
    assert quotient.std() < 0.05


def test_all_methods_are_scored_on_the_pixels_that_all_hold_valid() -> None:
    """A method that gives up what is hard for others too must not gain, nor must it lose its own coverage."""
    experiment = small(n_frames=1)
    judge = scorer(experiment, flat(experiment, 0.1))
    truth = judge.reference(0)
    everywhere, nowhere = np.ones((ROWS, COLS), np.bool_), np.zeros((ROWS, COLS), np.bool_)
    bold = truth.copy()
    bold[:, :4] *= 3
    timid_valid = everywhere.copy()
    timid_valid[:4] = False
    judge.add(
        {
            "bold": Reconstruction(0, bold, everywhere, nowhere, nowhere),
            "timid": Reconstruction(0, truth * np.float32(1.01), timid_valid, nowhere, nowhere),
        }
    )
    scores = {r.method: r for r in judge.board.records(judge.tallies) if r.region == "all"}
    assert scores["bold"].n == scores["timid"].n == 36 * (ROWS - 4) * COLS
    assert scores["bold"].flag == "identical"
    held = {c.method: c.valid for c in judge.board.coverage(judge.tallies) if c.region == "all"}
    assert held == {"bold": 1.0, "timid": pytest.approx(1 - 4 / ROWS)}


def test_other_decoders_of_the_adaptive_scheme_are_no_rivals() -> None:
    experiment = small(preset="figure4")
    other = experiment.methods[0].model_copy(update={"name": "adaptive_other"})
    experiment = experiment.model_copy(update={"methods": (*experiment.methods, other)})
    assert no_rivals(experiment) == ["adaptive", "adaptive_paper", "adaptive_other"]


def test_rivals_know_what_the_adaptive_method_knows() -> None:
    assert no_rivals(small("methods.random.calibration=ideal")) == ["adaptive", "random"]
    others = ["adaptive", "normal", "hdr_mosaic", "random"]
    assert no_rivals(small("methods.adaptive.calibration=ideal")) == others


def test_a_run_sets_each_method_beside_the_adaptive_one() -> None:
    """Steady frames only: 5 and 6 at a latency of one frame; half of the picture is outside."""
    experiment = small(n_frames=7)
    outside = np.zeros((3 * ROWS, 3 * COLS), np.bool_)
    outside[:, : 3 * (COLS // 2)] = True
    judge = scorer(experiment, replace(flat(experiment, 0.1), outside=outside))
    yes = np.ones((ROWS, COLS), np.bool_)
    for index in range(7):
        truth = judge.reference(index)
        bad = truth * np.float32(1.1)
        bad[:, :, : COLS // 2] = truth[:, :, : COLS // 2] * np.float32(1.3)
        kept = judge.add(
            {
                "adaptive": Reconstruction(index, truth * np.float32(1.05), yes, ~yes, ~yes),
                "random": Reconstruction(index, bad, yes, ~yes, ~yes),
            }
        )
        assert [each.method for each in kept if isinstance(each, PairTally)] == ["random"] * (index >= 5)
    found = judge.results()
    stops = {r.area: r for r in found["pairs"] if r.unit == "stops" and r.region == "all"}
    assert stops["room"].theirs == pytest.approx(math.log2(1.1), rel=0.02)
    assert stops["window"].theirs == pytest.approx(math.log2(1.3), rel=0.02)
    assert stops["room"].ours == pytest.approx(math.log2(1.05), rel=0.02)
    assert {v.verdict for v in found["claims"]} == {"undecided"}
    assert {v.area for v in found["claims"]} == {"room", "window"}
