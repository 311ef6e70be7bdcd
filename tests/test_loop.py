"""The closed loop on footage instead of a render: latency, streams, and the light rule."""

import numpy as np
import pytest

from optsim.core.errors import ConfigError, GeometryError
from optsim.core.random_streams import stream
from optsim.experiment.experiment import load_experiment
from optsim.experiment.loop import Result, run
from optsim.experiment.scoring import score
from optsim.footage.made import footage
from optsim.metrics import Scores

ROWS, COLS, FRAMES = 24, 32, 6


def scene(seed: int = 0) -> np.ndarray:
    """A static texture with a bright patch swinging over it, out of step with the frames."""
    rng = np.random.default_rng(seed)
    texture = np.kron(rng.uniform(0.02, 0.15, (ROWS // 2, COLS // 2)), np.ones((6, 6))).astype(np.float32)
    frames = np.repeat(texture[None], FRAMES * 36, 0)
    for slot in range(FRAMES * 36):
        col = round(36 + 18 * np.sin(2 * np.pi * slot / 50))
        frames[slot, 24:42, col : col + 12] = 0.3
    return frames


@pytest.fixture(scope="module")
def small():
    return load_experiment(
        "demo",
        [
            f"n_frames={FRAMES}",
            f"camera.panel_rows={ROWS}",
            f"camera.panel_cols={COLS}",
            f"camera.sensor.rows={3 * ROWS + 8}",
            f"camera.sensor.cols={3 * COLS + 8}",
            "calibration=true",
            "save_reconstructions=[]",
        ],
    )


@pytest.fixture(scope="module")
def radiance(small):
    return footage(scene(), slot_s=small.timing.slot_s, samples_per_pitch=3, white_w_m2_sr=0.4)


@pytest.fixture(scope="module")
def result(small, radiance) -> Result:
    return run(small, radiance)


@pytest.mark.slow
def test_every_method_gives_every_frame(result: Result) -> None:
    for name in ("adaptive", "normal", "hdr_mosaic", "random"):
        assert [f.index for f in result.frames[name]] == list(range(FRAMES))
        assert [r.index for r in result.reconstructions[name]] == list(range(FRAMES))


def test_what_drifts_after_calibration_is_in_the_frames_and_decoders_do_not_know(
    small, radiance, result
) -> None:
    """One CCD pixel to the right: so are the frames, but for noise, and the calibration is as it was."""
    drifted = small.model_copy(
        update={"drift": {"relay": {"shift_x_px": 1.0}}, "methods": small.methods[1:2]}
    )
    late = run(drifted, radiance)
    for field in ("responsivity_dn", "centre_col", "crosstalk"):
        np.testing.assert_array_equal(getattr(late.calibration, field), getattr(result.calibration, field))
    assert late.camera.relay.shift_x_px == 1
    assert late.experiment.camera.relay.shift_x_px == 0
    before, after = (each.frames["normal"][0].dn.astype(float) for each in (result, late))
    lit = np.s_[8:-8, 8:-8]
    noise = np.sqrt(2 * before[lit].mean() / small.camera.sensor.gain_e)
    assert np.abs(np.roll(before, 1, axis=1) - after)[lit].mean() < noise
    assert np.abs(before - after)[lit].mean() > 3 * noise


def test_a_drift_that_goes_on_is_in_each_frame_as_if_it_had_stopped_there(small, radiance) -> None:
    """Half a CCD pixel a frame, after a quarter: each frame is that of a camera which stands still there."""
    one = small.model_copy(update={"methods": small.methods[1:2], "n_frames": 3})

    def frames(drift_px: float, per_frame: object) -> list[np.ndarray]:
        drift = {"relay": {"shift_x_px": drift_px}}
        going_on = {"relay": {"shift_x_px": per_frame}} if per_frame else {}
        changed = one.model_copy(update={"drift": drift, "drift_per_frame": going_on})
        return [frame.dn for frame in run(changed, radiance).frames["normal"]]

    found = frames(0.25, 0.5)
    for k, dn in enumerate(found):
        np.testing.assert_array_equal(dn, frames(0.25 + 0.5 * k, None)[k])
    assert np.abs(found[1].astype(float) - found[2]).mean() > 1


@pytest.mark.parametrize(
    ("rate", "message"),
    [
        ("relay.shfit_x_px=1", r"drift_per_frame: key of a number 'relay\.shfit_x_px'.*'relay\.shift_x_px'"),
        ("relay.focus='field'", r"drift_per_frame: key of a number 'relay\.focus'"),
        ("relay.shift_x_px=true", r"drift_per_frame\.relay\.shift_x_px: got True, expected a change a frame"),
        ("relay.defocus_m='1 kg'", r"drift_per_frame\.relay\.defocus_m: .*kg"),
        (
            "relay.shift_x_px=40",
            r"after drift of 9 times relay\.shift_x_px = 40: .* at most 162 fit when centred",
        ),
        ("objective.f_number=0.1", r"drift_per_frame\.objective: got one.*let the relay"),
    ],
)
def test_a_drift_that_cannot_go_on_is_refused(rate: str, message: str) -> None:
    with pytest.raises((ConfigError, GeometryError), match=message):
        load_experiment("demo", [f"drift_per_frame.{rate}"])


@pytest.mark.parametrize(
    ("drift", "message"),
    [
        ("relay.shfit_x_px=1", r"drift: .*\n.*relay\.shfit_x_px: unknown key; did you mean 'shift_x_px'"),
        ("relay.shift_x_px=400", r"after drift of relay\.shift_x_px = 400: .* at most 162 fit when centred"),
        ("objective.focal_length_m=20e-3", r"drift\.objective: got one.*let the relay"),
        ("sensor.rows=400", r"drift: got .*size of the CCD"),
        ("modulator.field_rate_hz=90", r"drift: got .*the timing"),
    ],
)
def test_drift_that_cannot_be_is_refused(drift: str, message: str) -> None:
    with pytest.raises((ConfigError, GeometryError), match=message):
        load_experiment("demo", [f"drift.{drift}"])


@pytest.mark.slow
def test_the_same_experiment_gives_the_same_frames(small, radiance, result: Result) -> None:
    again = run(small, radiance)
    for name, frames in result.frames.items():
        for one, other in zip(frames, again.frames[name], strict=True):
            np.testing.assert_array_equal(one.dn, other.dn)


def test_methods_have_their_own_photons() -> None:
    draws = [stream(1, "shot", name, 0).random(4) for name in ("adaptive", "random")]
    assert not np.array_equal(*draws)
    np.testing.assert_array_equal(draws[0], stream(1, "shot", "adaptive", 0).random(4))


@pytest.mark.slow
def test_latency_hides_frames(small, radiance) -> None:
    """With latency L, the code of frame f is chosen from frames up to f - L: none for f < L."""
    for latency in (1, 3):
        experiment = small.model_copy(
            update={"camera": small.camera.model_copy(update={"latency_frames": latency})}
        )
        moving = [f.code.moving.all() for f in run(experiment, radiance).frames["adaptive"]]
        # Two frames must have arrived before anything can be called static.
        assert moving[: latency + 1] == [True] * (latency + 1)
        assert not moving[latency + 1]


def test_the_adaptive_code_follows_the_motion(result: Result) -> None:
    from optsim.metrics.oracle import oracle_moving

    last = FRAMES - 1
    mask = result.frames["adaptive"][last].code.moving
    oracle = oracle_moving(result.reference(last), result.reference(last - 1), np.float32(0))
    assert (mask & oracle).sum() / oracle.sum() > 0.9
    assert mask.mean() < 0.8


def test_light_rule_reaches_its_share_or_says_so(result: Result) -> None:
    light = result.light
    assert light.nd_transmission <= 1
    share = light.percentile_dn / light.saturation_dn
    wanted = result.experiment.light.saturation_share * min(1, 1 / light.wanted_transmission)
    assert share == pytest.approx(wanted, rel=1e-6)


def test_scores_rank_what_must_be_ranked(result: Result) -> None:
    """Where things move, a long exposure loses to a temporal code; all values are finite."""
    records = score(result)
    assert all(r.value is None or np.isfinite(r.value) for r in records)
    psnr = {
        r.method: r.value
        for r in records
        if r.metric.startswith("PSNR") and r.region == "moving" and r.phase == "steady"
    }
    assert psnr["random"] > psnr["normal"] + 1
    assert psnr["adaptive"] > psnr["normal"] + 1


def test_scores_show_themselves(result: Result) -> None:
    found = score(result)
    for shown in (found._repr_html_(), str(found)):
        assert "adaptive" in shown
        assert "nan" not in shown.lower()
        assert "steady phase" in shown
    head, *rows = str(found).splitlines()
    assert {len(row) for row in rows} == {len(head)}
    psnr = next(r for r in found if r.method == "random" and r.phase == "steady")
    line = next(row for row in rows if row.startswith(f"{psnr.metric}, {psnr.region}"))
    assert f"{psnr.value:.2f}" in line.split()


def test_a_result_says_what_it_is_in_a_line(result: Result) -> None:
    said = repr(result)
    assert repr(result.experiment.name) in said
    assert all(name in said for name in result.frames)
    assert len(said) < 200


def test_a_truth_that_is_none_is_refused(small) -> None:
    for wrong, name in ((None, "NoneType"), (np.ones(3), "ndarray")):
        with pytest.raises(ConfigError, match=rf"radiance: got {name}, .* render_truth\(experiment\)"):
            run(small, wrong)  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="assignments: got 'n_frames=4', expected a list"):
        load_experiment("demo", "n_frames=4")


def test_scores_that_never_settle_show_how_far_they_came(result: Result) -> None:
    early = Scores(r for r in score(result) if r.phase != "steady")
    assert {"warm-up", "merging"} == {r.phase for r in early}
    html = early._repr_html_()
    assert "merging phase" in html
    assert html.count("<tr>") > 3
