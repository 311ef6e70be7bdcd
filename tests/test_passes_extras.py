"""Light groups, Stokes vector and denoised radiance of an export: right, labelled, and never mixed."""

import sys
from pathlib import Path

import numpy as np
import pytest
from small_experiment import SMALL

import optsim.dataset.export as exporting
from optsim.core.errors import BackendError, ConfigError, StorageError
from optsim.core.files import read_exr, read_json
from optsim.dataset import Extras, export_passes
from optsim.dataset.extras import channel_names
from optsim.dataset.slot_light import SlotLight, bright_during, named_groups
from optsim.experiment.experiment import Experiment, load_experiment
from optsim.experiment.truth import chosen_scene, truth_view
from optsim.render import choose_backend
from optsim.render.backend import BackendReport, activate
from optsim.render.full import slot_image
from optsim.render.stage import RenderStage
from optsim.render.stokes import render_stokes
from optsim.report.pass_sheet import pass_sheet
from optsim.scene import load_scene

# Slots of 5.56 ms: the pulses are on in slots 0 and 1 (80 % of it), off in 2 to 5, and so on.
SCENE = """
name = "three"
white_w_m2_sr = 2.0
max_depth = 4
camera = { position_m = [0, -2, 1.2], target_m = [0, 0.5, 0.5] }
[materials]
floor = { kind = "plastic", reflectance = 0.4, roughness = 0.3 }
wall = { reflectance = 0.6 }
ball = { reflectance = 0.8 }
[lamps]
steady = { center_m = [-1, 0, 2], edge_u_m = [0.5, 0, 0], edge_v_m = [0, -0.5, 0], radiance_w_m2_sr = 6 }
window = { center_m = [-1.4, 0, 1], edge_u_m = [0, 0.6, 0], edge_v_m = [0, 0, 0.6], radiance_w_m2_sr = 5 }
[lamps.pulsed]
center_m = [1, 0, 2]
edge_u_m = [0.5, 0, 0]
edge_v_m = [0, -0.5, 0]
radiance_w_m2_sr = 4
flicker = { kind = "pwm", frequency_hz = 30, duty = 0.3 }
[lamps.mains]
center_m = [0, 0.6, 2]
edge_u_m = [0.5, 0, 0]
edge_v_m = [0, -0.5, 0]
radiance_w_m2_sr = 5
flicker = { kind = "sine", frequency_hz = 100, depth = 0.9 }
[objects.floor]
kind = "quad"
material = "floor"
corner_m = [-4, -3, 0]
edge_u_m = [8, 0, 0]
edge_v_m = [0, 6, 0]
[objects.wall]
kind = "quad"
material = "wall"
corner_m = [-4, 1.5, 0]
edge_u_m = [8, 0, 0]
edge_v_m = [0, 0, 4]
[movers.ball]
kind = "pendulum"
pivot_m = [0, 0.4, 1.6]
length_m = 1.0
bob_radius_m = 0.3
swing_rad = 0.6
material = "ball"
"""
ALL = Extras(light_samples=16, stokes_samples=24, denoise=True)
DARK_SLOT, BRIGHT_SLOT = 3, 1


@pytest.fixture(scope="module")
def experiment(tmp_path_factory) -> Experiment:
    if choose_backend().preview:
        pytest.skip("only the scalar fallback works here")
    folder = tmp_path_factory.mktemp("scene") / "three"
    folder.mkdir()
    (folder / "scene.toml").write_text(SCENE)
    return load_experiment("demo", [*SMALL, f"scene.name={folder}"])


@pytest.fixture(scope="module")
def folder(experiment, tmp_path_factory) -> Path:
    pytest.importorskip("mitsuba_oidn")
    where = tmp_path_factory.mktemp("passes") / "out"
    for slots in (range(BRIGHT_SLOT, BRIGHT_SLOT + 1), range(DARK_SLOT, DARK_SLOT + 1)):
        export_passes(experiment, where, slots, extras=ALL)
    return where


def slot(folder: Path, number: int) -> tuple[dict[str, np.ndarray], dict]:
    return read_exr(folder / f"slot{number:06d}.exr")


def with_seed(experiment: Experiment, seed: int) -> Experiment:
    return experiment.model_copy(update={"render": experiment.render.model_copy(update={"seed": seed})})


def times(experiment: Experiment, number: int) -> tuple[float, float]:
    slot_s = experiment.timing.slot_s
    return number * slot_s, (number + 1) * slot_s


def test_the_groups_sum_to_the_whole_scene(experiment) -> None:
    """Ten pairs of pictures: z of each sample and of the sum; the lamps' choice differs, the mean doesn't."""
    activate()
    scene, n = chosen_scene(experiment), 10
    start_s, stop_s = times(experiment, BRIGHT_SLOT)
    bright = bright_during(scene, start_s, stop_s)
    assert bright is not None
    whole = RenderStage(bright, experiment.camera.view)
    sums, others = [], []
    for seed in range(n):
        light = SlotLight(scene, with_seed(experiment, seed), 32)
        groups = light.of(BRIGHT_SLOT)
        assert set(groups) == {"steady", "pwm", "sine"}
        sums.append(sum(groups.values()))
        poses, samples = light.shares(BRIGHT_SLOT)
        others.append(slot_image(whole, start_s, stop_s - start_s, samples, poses, (1000 + seed,))[0])
    one, other = np.array(sums), np.array(others)
    difference = one.mean(0) - other.mean(0)
    error = np.sqrt((one.var(0, ddof=1) + other.var(0, ddof=1)) / n)
    # Student's t of 18 degrees: beyond 6.5 twice 2e-6, 1728 samples: a false alarm in 140 seeds, which is
    # fixed. Lamps in view are the same in each picture but for rounding.
    assert np.abs(difference / np.maximum(error, 1e-5 * other.mean(0))).max() < 6.5
    totals = one.sum((1, 2)), other.sum((1, 2))
    spread = np.sqrt((totals[0].var(ddof=1) + totals[1].var(ddof=1)) / n)
    assert abs(totals[0].mean() - totals[1].mean()) < 4.5 * spread
    assert spread / totals[1].mean() < 0.01, "or the test would see nothing"


def test_each_group_is_as_bright_as_its_lamps_are_in_the_slot(experiment, folder) -> None:
    channels, said = slot(folder, BRIGHT_SLOT)
    dark, said_dark = slot(folder, DARK_SLOT)
    groups = said["further"]["Y.light"]["groups"]
    assert groups["steady"]["lamps"] == ["steady", "window"]
    assert groups["pwm"]["lamps"] == ["pulsed"]
    assert groups["steady"]["gain"] == 1
    assert groups["pwm"]["gain"] == pytest.approx(0.8 / 0.3, rel=1e-9)
    phase = 2 * np.pi * 100 * (BRIGHT_SLOT + 0.5) * experiment.timing.slot_s
    sine = 1 + 0.9 * np.sin(phase) * np.sinc(100 * experiment.timing.slot_s)
    assert groups["sine"]["gain"] == pytest.approx(sine, rel=1e-9)
    assert said_dark["further"]["Y.light"]["groups"]["pwm"]["gain"] == 0
    assert not dark["Y.light.pwm"].any()
    assert channels["Y.light.pwm"].mean() > 0.1 * channels["Y"].mean()
    assert said["further"]["Y.light"]["samples"] >= 16
    # Lamps that aren't in the group are black: the brightest fine samples are the lamps in view, if any.
    sums = sum(channels[name] for name in channels if name.startswith("Y.light."))
    for found, y in ((sums, channels), (channels["S0"], channels), (dark["S0"], dark)):
        # Noise of a fine sample is a third at most; 1728 of them, so the mean is within 1 % or so.
        assert found.mean(dtype=np.float64) == pytest.approx(y["Y"].mean(dtype=np.float64), rel=0.05)


def test_the_stokes_channels_are_the_pass_of_the_middle(experiment, folder) -> None:
    from optsim.render.plan import seed_of

    channels, said = slot(folder, BRIGHT_SLOT)
    start_s, stop_s = times(experiment, BRIGHT_SLOT)
    bright = bright_during(chosen_scene(experiment), start_s, stop_s)
    seed = seed_of(experiment.render.seed, "stokes", BRIGHT_SLOT)
    expected = render_stokes(bright, truth_view(experiment), (start_s + stop_s) / 2, 24, seed)
    for i in range(4):
        np.testing.assert_allclose(channels[f"S{i}"], expected[i], rtol=1e-4, atol=1e-6)
    floor = channels["id"] == int(next(k for k, v in said["id_table"].items() if v == "object/floor"))
    assert floor.mean() > 0.1
    assert np.abs(channels["S1"][floor]).mean() > 0.01 * channels["S0"][floor].mean(), (
        "else nothing is tested"
    )
    about = said["further"]["S"]
    assert about["samples"] == 24
    assert "horizontally" in about["signs"]["S1"]
    assert about["unit"] == "W m^-2 sr^-1"


def test_denoised_radiance_is_labelled_and_the_raw_one_stays(experiment, folder, tmp_path: Path) -> None:
    channels, said = slot(folder, BRIGHT_SLOT)
    export_passes(experiment, tmp_path / "plain", range(BRIGHT_SLOT, BRIGHT_SLOT + 1))
    plain, said_plain = slot(tmp_path / "plain", BRIGHT_SLOT)
    np.testing.assert_array_equal(channels["Y"], plain["Y"])
    assert {*channels} - {*plain} == {*channel_names(ALL, chosen_scene(experiment))}
    assert said_plain["further"] == {}
    rough = np.abs(np.diff(channels["Y"], axis=1)).mean()
    assert np.abs(np.diff(channels["Y.denoised"], axis=1)).mean() < 0.9 * rough
    about = said["further"]["Y.denoised"]
    assert about["label"].startswith("denoised")
    assert "never for accuracy figures" in about["meaning"]
    assert about["denoiser"].startswith("mitsuba-oidn")
    assert said["versions"]["mitsuba-oidn"]


def test_exports_of_other_channels_are_never_mixed(experiment, folder) -> None:
    before = {path: path.read_bytes() for path in folder.iterdir()}
    others = [
        Extras(),
        *(
            ALL.model_copy(update=u)
            for u in ({"light_samples": 17}, {"stokes_samples": None}, {"denoise": False})
        ),
    ]
    for extras in others:
        with pytest.raises(StorageError, match="further channels"):
            export_passes(experiment, folder, range(4), extras=extras)
    export_passes(experiment, folder, range(BRIGHT_SLOT, BRIGHT_SLOT + 1), extras=ALL)
    slots = [path for path in before if path.suffix == ".exr"]
    assert len(slots) == 2
    assert {path: path.read_bytes() for path in slots} == {path: before[path] for path in slots}
    assert read_json(folder / "manifest.json")["extras"] == ALL.model_dump()


def test_half_takes_the_further_radiance_too(experiment, folder, tmp_path: Path) -> None:
    extras = Extras(light_samples=16)
    export_passes(
        experiment, tmp_path / "half", range(BRIGHT_SLOT, BRIGHT_SLOT + 1), half=True, extras=extras
    )
    short, said = slot(tmp_path / "half", BRIGHT_SLOT)
    full, _ = slot(folder, BRIGHT_SLOT)
    assert "Y.light.pwm" in said["half"]
    np.testing.assert_allclose(short["Y.light.pwm"], full["Y.light.pwm"], rtol=2**-11, atol=3e-8)
    assert (short["Y.light.pwm"] != full["Y.light.pwm"]).any()


def test_what_is_missing_is_said_before_anything_is_rendered(experiment, tmp_path, monkeypatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("rendered")

    monkeypatch.setattr(exporting, "render_truth", refuse)
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "mitsuba_oidn", None)
        with pytest.raises(ConfigError, match=r"pip install 'optsim\[denoise\]'"):
            export_passes(experiment, tmp_path / "out", extras=Extras(denoise=True))
    fallback = BackendReport("scalar_rgb", "", True, "no LLVM here", ())
    with monkeypatch.context() as patch:
        patch.setattr("optsim.render.choose_backend", lambda _backend: fallback)
        with pytest.raises(BackendError, match=r"--stokes.*no LLVM here"):
            export_passes(experiment, tmp_path / "out", extras=Extras(stokes_samples=4))
    assert not (tmp_path / "out").exists()


def test_lamps_that_are_all_dark_leave_no_scene(experiment) -> None:
    scene = chosen_scene(experiment).only_lamps(["pulsed"])
    assert bright_during(scene, *times(experiment, DARK_SLOT)) is None
    bright = bright_during(scene, *times(experiment, BRIGHT_SLOT))
    assert bright is not None
    assert bright.lamps["pulsed"].radiance_w_m2_sr == pytest.approx(4 * 0.8 / 0.3)
    assert not bright.lamps["steady"].lit


def test_groups_of_one_kind_are_numbered() -> None:
    scene = load_scene("flicker_lamp")
    assert named_groups(scene) == {"steady": ("room", "steady"), "sine": ("mains",), "pwm": ("led",)}
    led = scene.lamps["led"].flicker.model_copy(update={"frequency_hz": 500.0})
    other = scene.lamps["mains"].model_copy(update={"flicker": led})
    several = scene.model_copy(update={"lamps": scene.lamps | {"mains": other}})
    assert named_groups(several) == {"steady": ("room", "steady"), "pwm1": ("led",), "pwm2": ("mains",)}


def test_the_sheet_shows_what_there_is(folder) -> None:
    channels, said = slot(folder, BRIGHT_SLOT)
    names = {int(number): name for number, name in said["id_table"].items()}
    extra = [name for name in channels if name.startswith(("Y.light.", "Y.denoised", "S"))]
    assert len(extra) == 8
    plain = pass_sheet({k: v for k, v in channels.items() if k not in extra}, names, "t")
    more = pass_sheet(channels, names, "t")
    # 9 panels and 7 more (S0 looks like Y), three a row.
    assert more.shape[0] > plain.shape[0] * 1.8
    changed = channels | {"S2": channels["S2"] - channels["S0"]}
    assert (pass_sheet(changed, names, "t") != more).any()


def test_the_command_line(monkeypatch, tmp_path: Path, capsys) -> None:
    from optsim.app.cli import main

    seen: list[Extras] = []
    monkeypatch.setattr("optsim.dataset.export_passes", lambda *_, extras, **__: seen.append(extras))

    def call(*words: str) -> tuple[int, str]:
        monkeypatch.setattr(sys, "argv", ["optsim", "render", "demo", *words])
        try:
            main()
        except SystemExit as stop:
            return int(stop.code or 0), capsys.readouterr().err
        return 0, capsys.readouterr().err

    out = ("--passes", "--out", str(tmp_path / "out"))
    assert call(*out, "--light-groups", "--denoise")[0] == 0
    assert call(*out, "--light-groups", "--stokes", "--samples", "9")[0] == 0
    assert call(*out)[0] == 0
    given = [Extras(light_samples=64, denoise=True), Extras(light_samples=9, stokes_samples=9), Extras()]
    assert seen == given
    for words, message in (
        (("--light-groups",), "--light-groups: got without --passes"),
        (("--stokes",), "--stokes: got without --passes"),
        (("--denoise",), "--denoise: got without --passes"),
        (("--samples", "0"), "--samples: got without --passes"),
        ((*out, "--samples", "8"), "add --light-groups or --stokes"),
        ((*out, "--stokes", "--samples", "0"), "stokes_samples: got 0"),
    ):
        code, err = call(*words)
        assert (code, message in err) == (2, True), err
    assert len(seen) == 3
