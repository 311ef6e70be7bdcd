"""Which frames, slots and pixels a run's scores are of, on footage whose answer is known beforehand."""

from dataclasses import replace

import numpy as np
import pytest
from test_scoring import COLS, ROWS, scorer, small

from optsim.core.quantities import CodedFrame, ExposureCode, RadianceVideo, Reconstruction
from optsim.footage.made import footage

EVERYWHERE, NOWHERE = np.ones((ROWS, COLS), np.bool_), np.zeros((ROWS, COLS), np.bool_)
PATCH = np.s_[10:14, 10:14]


def by_frame(radiances: list[float], patch: list[float] | None = None) -> RadianceVideo:
    """Even light that may step from frame to frame, otherwise in a patch of 4 x 4 panel pixels."""
    levels = np.array([radiances, patch or radiances], np.float32)[:, :, None, None, None]
    frames = levels * np.ones((1, 1, 36, 3 * ROWS, 3 * COLS), np.float32)
    frames[0, :, :, 30:42, 30:42] = frames[1, :, :, 30:42, 30:42]
    stack = frames[0].reshape(-1, 3 * ROWS, 3 * COLS)
    return footage(stack, slot_s=1 / 180, samples_per_pitch=3, white_w_m2_sr=0.4)


@pytest.mark.parametrize("electrons", [90, 900])
@pytest.mark.parametrize(("share", "moves"), [(0.93, False), (1.07, True)])
def test_motion_is_a_step_of_two_sigma_of_shot_and_read_noise(
    electrons: float, share: float, moves: bool
) -> None:
    experiment = small("camera.effects.all=ideal", "camera.effects.read_noise=nominal")
    a_slot = {row.stage: row.value for row in experiment.camera.ledger(1.0)}["electrons a slot"]
    read_e = experiment.camera.sensor.read_noise_e
    assert 5 < read_e < 15
    step = share * 2 * np.sqrt(electrons + read_e**2)
    radiance = by_frame([(electrons - step) / a_slot, electrons / a_slot])
    assert (scorer(experiment, radiance).moving(1) == moves).all()


def test_each_frame_is_scored_with_its_own_truth_and_mask() -> None:
    """A patch steps between frames 1 and 2: it moves in frame 2 alone, for scores and for masks."""
    experiment = small(n_frames=4)
    moved = NOWHERE.copy()
    moved[PATCH] = True
    judge = scorer(experiment, by_frame([0.1] * 4, [0.1, 0.1, 0.2, 0.2]))
    per_radiance = judge.camera.irradiance_per_radiance
    frames = []
    for index in range(4):
        # Light by hand: nearly right, since glare and blur of the objective are in the reference.
        light = np.full((36, ROWS, COLS), 0.1 * per_radiance, np.float32)
        light[:, *PATCH] *= 2 if index >= 2 else 1
        judge.add({"hand": Reconstruction(index, light, EVERYWHERE, NOWHERE, NOWHERE)})
        mask = moved if index == 2 else NOWHERE
        code = ExposureCode(np.zeros((36, ROWS, COLS), np.uint8), mask)
        frames.append(CodedFrame(index, np.zeros((80, 104), np.uint16), code))
    in_moving = [int(tally.samples[0, 0]) for tally in judge.tallies]
    assert in_moving[:2] == [0, 0]
    assert in_moving[3] == 0
    # Blur and glare carry the step a pixel further.
    assert 16 <= in_moving[2] <= 36
    errors = [tally.sums[2].sum() / tally.samples.sum() for tally in judge.tallies]
    # The wrong frame's truth would be off by 0.1 of 0.4 in 16 of 768 pixels.
    assert max(errors) < 0.3 * (0.1 / 0.4) ** 2 * 16 / 768
    agreed = judge.masks({m.name: tuple(frames) for m in experiment.methods})["masks"]
    assert [row.precision for row in agreed] == [None, None, 1.0, None]
    assert agreed[2].recall >= 16 / 36


def test_what_is_said_of_slots_with_the_shutter_closed_is_not_scored() -> None:
    experiment = small("camera.overlap=false", n_frames=1)
    coded = experiment.camera.coded_slots
    assert coded < 36
    judge = scorer(experiment, by_frame([0.1]))
    light = judge.reference(0).copy()
    light[coded:] *= 2
    judge.add({"one": Reconstruction(0, light, EVERYWHERE, NOWHERE, NOWHERE)})
    for record in judge.board.records(judge.tallies):
        if record.region == "all":
            assert (record.flag, record.n) == ("identical", coded * ROWS * COLS)


@pytest.mark.parametrize("latency", [1, 3])
def test_phases_and_the_noise_ceiling_follow_the_experiments_latency(latency: int) -> None:
    """Frames that are not yet steady have ten times the noise."""
    n_frames = latency + 7
    experiment = small(
        "camera.objective.glare_share=0", f"camera.latency_frames={latency}", n_frames=n_frames
    )
    noise = [0.04] * (latency + 4) + [0.004] * 3
    radiance = replace(by_frame([0.2] * n_frames), half_difference=by_frame(noise))
    judge = scorer(experiment, radiance)
    phases = [judge.board.phase(index) for index in range(n_frames)]
    assert phases == ["warm-up"] * (latency + 1) + ["merging"] * 3 + ["steady"] * 3
    records = [r for r in judge.noise_ceiling() if r.metric == "PSNR[peak=white]" and r.region == "all"]
    assert [r.phase for r in records] == ["steady"]
    assert records[0].value == pytest.approx(20 * np.log10(0.4 / 0.004), abs=0.05)


def test_the_window_ratio_is_of_the_brightest_outside_and_the_darkest_inside() -> None:
    """Percentiles of what is laid on the panel: levels that rise along the rows, a window on the left."""
    experiment = small("camera.effects.all=ideal", n_frames=1)
    levels = np.repeat(np.geomspace(0.01, 1, COLS)[None], ROWS, axis=0)
    levels[:, :8] = np.linspace(20, 40, ROWS)[:, None]
    outside = np.zeros((3 * ROWS, 3 * COLS), np.bool_)
    outside[:, :24] = True
    fine = np.kron(levels, np.ones((3, 3))).astype(np.float32)
    radiance = replace(
        footage(np.repeat(fine[None], 36, axis=0), slot_s=1 / 180, samples_per_pitch=3), outside=outside
    )
    expected = np.percentile(levels[:, :8], 95) / np.percentile(levels[:, 8:], 5)
    found = scorer(experiment, radiance).window_ratio(glare=False)
    # Diffraction blurs the steps a little.
    assert found == pytest.approx(expected, rel=0.05)


def test_stated_errors_are_judged_on_the_pixels_that_all_methods_hold_valid() -> None:
    """Half of the picture is wrong, and one method gives it up: neither is judged there."""
    judge = scorer(small(n_frames=1), by_frame([0.1]))
    light = judge.reference(0)
    spread = np.full_like(light, 0.1 * light.mean())
    wrong = light + spread
    wrong[:, : ROWS // 2] += 9 * spread[:, : ROWS // 2]
    lower = EVERYWHERE.copy()
    lower[: ROWS // 2] = False
    judge.add(
        {
            name: Reconstruction(0, wrong, valid, NOWHERE, NOWHERE, spread)
            for name, valid in (("bold", EVERYWHERE), ("timid", lower))
        }
    )
    for record in judge.results()["uncertainty"]:
        if record.region == "all":
            assert record.n == 36 * ROWS // 2 * COLS
            assert record.rms == pytest.approx(1, rel=1e-4)


def test_pairs_are_of_each_rival_of_coded_slots_and_of_any_pixel_that_sees_the_window() -> None:
    """Wrong in closed slots alone, the rivals have no error; a fine sample of window makes a window pixel."""
    experiment = small("camera.overlap=false", n_frames=7)
    coded = experiment.camera.coded_slots
    outside = np.zeros((3 * ROWS, 3 * COLS), np.bool_)
    # Of ten columns of panel pixels, the last by one of its three samples.
    outside[:, :28] = True
    judge = scorer(experiment, replace(by_frame([0.1] * 7), outside=outside))
    rivals = ("random", "normal")
    for index in range(7):
        light = judge.reference(index)
        late = light.copy()
        late[coded:] *= 2
        videos = {"adaptive": light, **dict.fromkeys(rivals, late)}
        judge.add(
            {name: Reconstruction(index, each, EVERYWHERE, NOWHERE, NOWHERE) for name, each in videos.items()}
        )
    steady = [k for k in range(7) if judge.board.phase(k) == "steady"]
    assert steady
    assert [(pair.method, pair.index) for pair in judge.pairs] == [
        (name, k) for k in steady for name in rivals
    ]
    for pair in judge.pairs:
        assert not pair.sums.any()
        np.testing.assert_array_equal(pair.counts.sum(axis=2), [[ROWS * (COLS - 10), ROWS * 10]] * 2)


def test_the_oracle_takes_each_frames_own_noise_of_the_truth() -> None:
    """A change since the frame before that one half has the other way round; then noise that stays."""
    experiment = small("camera.objective.glare_share=0", n_frames=2)
    light = by_frame([0.3, 0.2])
    for noise, moves in (([0.15, 0.0], False), ([0.15, 0.15], True)):
        judge = scorer(experiment, replace(light, half_difference=by_frame(noise)))
        assert judge.moving(1).all() == moves
        assert judge.moving(1).any() == moves
