"""The command line: good input, wrong input, exit codes, and nothing rendered before input is checked."""

import json
import re
import subprocess
import sys
from io import StringIO
from pathlib import Path

import pytest
from rich.console import Console

from optsim.app.cli import main
from optsim.camera import skip
from optsim.experiment.experiment import load_experiment
from optsim.experiment.explain import explanation, show


def optsim(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, *words: str
) -> tuple[int, str, str]:
    """Run the command line in this process: exit code, stdout, stderr."""
    monkeypatch.setattr(sys, "argv", ["optsim", *words])
    code = 0
    try:
        main()
    except SystemExit as stop:
        code = stop.code if isinstance(stop.code, int) else 0
    captured = capsys.readouterr()
    return code, captured.out, captured.err


@pytest.fixture
def cli(capsys, monkeypatch, tmp_path):
    monkeypatch.setenv("OPTSIM_CACHE", str(tmp_path / "cache"))
    monkeypatch.chdir(tmp_path)
    return lambda *words: optsim(capsys, monkeypatch, *words)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("run", "dmeo", "--dry-run"), "did you mean 'demo'"),
        (("run", "nowhere/none.toml", "--dry-run"), "no such file"),
        (("run", "demo", "--dry-run", "--set", "camera.latency_frame=3"), "did you mean 'latency_frames'"),
        (
            ("explain", "demo", "--set", "name="),
            "name: got '', expected a letter, then letters, digits, _ and -",
        ),
        (("run", "demo", "--dry-run", "--set", "camera.objective.focal_length_m='12 s'"), "unit 's'"),
        (("run", "demo", "--dry-run", "--set", "n_frames=0"), "n_frames"),
        (("run", "demo", "--dry-run", "--methods", "adaptive,randm"), "did you mean 'random'"),
        (("run", "demo", "--dry-run", "--methods", ""), "unknown method ''"),
        (("run", "demo", "--dry-run", "--set", "scene.name=window_roon"), "window_room"),
        (("run", "demo", "--dry-run", "--set", "scene.variation=corssing"), "crossing"),
        (("run", "paper_prototype", "--dry-run", "--set", "camera.relay.magnification=0.681"), "fit"),
        (("run", "demo", "--dry-run", "--backend", "llvm_ad_bogus"), "llvm_ad_bogus"),
        (("run", "demo", "--dry-run", "--set", "camera.hardware=dmeo"), "did you mean 'demo'"),
        (("run", "demo", "--dry-run", "--set", "overlap=false"), "did you mean 'camera.overlap'"),
        (
            ("run", "demo", "--dry-run", "--set", "camera.panel_rows=8", "--set", "camera.panel_cols=8"),
            "at least 24 panel pixels",
        ),
        (("run", "demo", "--dry-run", "--set", "methods.1.scheme.open_slots=99"), "'normal'"),
        (("list", "scenez"), "scenes"),
        (("benchmark", "omp.k2"), "omp.k2000"),
        (("init", "demo2"), "demo"),
    ],
)
def test_bad_input_exits_2_with_the_cure(cli, words, message) -> None:
    code, _, err = cli(*words)
    assert code == 2
    assert message in err
    assert "Traceback" not in err


def test_bad_usage_exits_2(cli) -> None:
    assert cli("run")[0] == 2
    assert cli("run", "demo", "--bogus")[0] == 2
    assert cli("bogus")[0] == 2


def test_dry_run_renders_nothing(cli, tmp_path: Path) -> None:
    code, out, _ = cli("run", "demo", "--dry-run", "--json")
    assert code == 0
    assert json.loads(out)["experiment"]["name"] == "demo"
    assert not (tmp_path / "reports").exists()


def test_some_methods_of_an_experiment_can_run_alone(cli) -> None:
    code, out, _ = cli("run", "demo", "--dry-run", "--json", "--methods", "random, adaptive")
    assert code == 0
    chosen = json.loads(out)["experiment"]
    assert [method["name"] for method in chosen["methods"]] == ["adaptive", "random"]
    assert chosen["save_reconstructions"] == ["adaptive", "random"]


def test_explain_prints_geometry_ledger_and_latency(cli) -> None:
    code, out, _ = cli("explain", "paper_prototype", "--json")
    record = json.loads(out)
    assert code == 0
    assert record["geometry"]["fits"]
    assert record["latency"]["chosen_frames"] == 3
    assert record["latency"]["first_steady"] == 7
    assert (record["latency"]["coded_slots"], record["latency"]["slots_per_frame"]) == (36, 36)
    assert {"mid-grey", "white"} == set(record["ledger"])


@pytest.mark.parametrize(("n_frames", "enough"), [(5, False), (6, True)])
def test_explain_says_when_the_steady_phase_is_never_reached(cli, n_frames: int, enough: bool) -> None:
    _, out, _ = cli("explain", "demo", "--set", f"n_frames={n_frames}")
    assert ("take 6 or more (n_frames)" not in " ".join(out.split())) == enough


@pytest.mark.parametrize("slots", [6, 9])
def test_explain_says_when_the_ccd_cannot_keep_up(cli, slots: int) -> None:
    # 368 of 1440 rows.
    slower = ("--set", "camera.sensor.readout_s='150 ms'", "--set", f"camera.slots_per_frame={slots}")
    _, out, _ = cli("explain", "demo", *slower)
    assert ("38.3 ms to read one" in " ".join(out.split())) == (slots == 6)


def test_explain_shows_what_does_not_fit(cli) -> None:
    code, out, _ = cli("explain", "paper_prototype", "--set", "camera.relay.magnification=0.681")
    assert code == 2
    assert "does not fit" in out
    assert "camera.relay.magnification" in out


def test_a_geometry_that_fits_nothing_is_told_at_once_with_the_cure(monkeypatch: pytest.MonkeyPatch) -> None:
    def planning(*_: object) -> None:
        pytest.fail("took pictures with a camera of 23 GB")

    monkeypatch.setattr("optsim.camera.probe.make_probe", planning)
    found = explanation("demo", ["camera.relay.magnification=100"])
    assert not found["geometry"]["fits"]
    assert found["plan"] is None
    assert "lower camera.relay.magnification" in found["misfit"]
    assert any("lower camera.relay.magnification" in str(item) for item in show(found))


@pytest.mark.parametrize("side", [1, 2, 4])
def test_a_panel_of_a_few_pixels_is_explained_too(side: int) -> None:
    found = explanation("demo", [f"camera.panel_rows={side}", f"camera.panel_cols={side}"])
    assert found["geometry"]["fits"]
    assert [choice["skip"] for choice in found["plan"]["choices"]] == [row.name for row in skip.ALL]


def test_a_variation_may_be_a_number() -> None:
    scene = load_experiment("demo", ["scene.name=wheel", "scene.variation=7"]).scene
    assert scene is not None
    assert scene.variation == "7"


def test_an_output_folder_of_another_run_is_refused(cli, tmp_path: Path) -> None:
    other = tmp_path / "other"
    other.mkdir()
    (other / "precious.txt").write_text("mine")
    code, _, err = cli("run", "demo", "--dry-run", "--out", str(other))
    assert code == 2
    assert "holds no run" in err
    (other / "experiment.json").write_text('{"fingerprint": "0"}')
    code, _, err = cli("run", "demo", "--dry-run", "--out", str(other))
    assert code == 2
    assert "another experiment" in err
    assert (other / "precious.txt").read_text() == "mine"
    for command in (["render", "demo"], ["trace", "demo", "--pixel", "1,1"], ["benchmark"]):
        code, _, err = cli(*command, "--out", str(other))
        assert code == 2
        assert "not an empty folder" in err


def test_what_an_output_cannot_be_is_said(cli, tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(tmp_path / "nowhere")
    (tmp_path / "file").write_text("mine")
    (tmp_path / "made" / "x").mkdir(parents=True)
    (tmp_path / "made" / "experiment.json").write_text("[]")
    for out, words in (
        ("link", "is a broken link, expected a folder"),
        ("file", "is a file"),
        ("made", "got list, expected a JSON object"),
        ("x" * 300, "too long"),
    ):
        code, _, err = cli("run", "demo", "--dry-run", "--out", str(tmp_path / out))
        assert code == 2
        assert words in err
    code, _, err = cli("reconstruct", str(tmp_path / "made"), "--out", str(tmp_path / "new"))
    assert code == 2
    assert "got list, expected a JSON object" in err
    (tmp_path / "made" / "experiment.json").write_text("{}")
    assert "what 'optsim run' writes" in cli("reconstruct", str(tmp_path / "made"), "--out", "new")[2]


def test_a_copy_of_a_file_has_its_name(cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub" / "mine.toml").write_text("name = 'mine'\n")
    assert cli("init", "sub/mine.toml")[0] == 0
    assert (tmp_path / "mine.toml").read_text() == "name = 'mine'\n"


def test_a_place_that_takes_no_file_is_refused_before_any_work(cli) -> None:
    for command in (["run", "demo"], ["render", "demo"], ["init", "demo"], ["reconstruct", "a.npz"]):
        code, _, err = cli(*command, "--out", "/proc/none/here")
        assert code == 2
        assert "/proc" in err
        assert re.search("cannot (be )?writ", err)


def test_init_copies_a_preset_that_loads_and_never_overwrites(cli, tmp_path: Path) -> None:
    assert cli("init", "demo")[0] == 0
    assert cli("run", "./demo.toml", "--dry-run")[0] == 0
    assert cli("init", "demo")[0] == 2


def test_lists_and_schema(cli) -> None:
    for what in ("scenes", "presets", "schemes", "decoders", "metrics"):
        code, out, _ = cli("list", what, "--json")
        assert code == 0
        assert all(row["about"] for row in json.loads(out)), what
    code, out, _ = cli("config", "schema")
    assert code == 0
    assert "methods" in json.loads(out)["properties"]
    assert cli("config", "schema", "seed")[1].startswith("seed: Of all random numbers")
    code, _, err = cli("config", "schema", "sed")
    assert (code, "did you mean 'seed'" in err) == (2, True)
    code, out, _ = cli("config", "show", "demo", "--set", "seed=7")
    assert json.loads(out)["seed"] == 7
    assert cli("cache", "show", "--json")[0] == 0


def test_version_and_interruption() -> None:
    program = [sys.executable, "-m", "optsim", "--version"]
    out = subprocess.run(program, capture_output=True, text=True, check=True).stdout
    assert out.startswith("optsim 0.")


def test_interruption_is_a_clean_message(cli, monkeypatch: pytest.MonkeyPatch) -> None:
    from optsim.experiment import job

    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(job, "execute", interrupted)
    code, _, err = cli("run", "demo")
    assert code == 130
    assert "What is finished is kept" in err
    assert "Traceback" not in err


def test_a_cache_folder_that_is_a_file_is_no_traceback(cli, tmp_path: Path, monkeypatch) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("OPTSIM_CACHE", str(tmp_path / "file"))
    _, out, err = cli("doctor")
    assert "Traceback" not in out + err
    code, _, err = cli("run", "demo", "--dry-run")
    assert code == 2
    assert "is a file, expected a folder" in err


def test_a_tolerance_is_an_override_like_any_other(cli) -> None:
    code, out, _ = cli("explain", "demo", "--tolerance", "0", "--json")
    assert code == 0
    plan = json.loads(out)["plan"]
    assert plan["tolerance"] == 0
    assert plan["bound"] == 0
    assert not next(c["skipped"] for c in plan["choices"] if c["skip"] == "moving_tails")
    code, _, err = cli("explain", "demo", "--tolerance", "-1")
    assert code == 2
    assert "tolerance" in err


def test_an_explanation_for_people_has_units_and_says_what_clips() -> None:
    text = StringIO()
    page = Console(width=200, file=text)
    for item in show(explanation("demo", ["methods.random.calibration=ideal"])):
        page.print(item)
    said = text.getvalue()
    assert "calibration of adaptive: bench, normal: bench, hdr_mosaic: bench, random: ideal" in said
    assert "120 x 160" in said
    assert "CCD pixels a panel pixel" in said
    assert "cone of f/4, f/6 on the panel" in said
    # White is 1.9 times the full well without the light rule's density, mid-grey a third.
    assert "of the full well: clips" in said.split("photon ledger, white")[1]
    assert "clips" not in said.split("photon ledger, white")[0]


def test_a_dry_run_says_that_there_is_no_steady_phase(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for n_frames, said in ((5, True), (10, False)):
        words = ("run", "demo", "--dry-run", "--set", f"n_frames={n_frames}")
        code, out, err = optsim(capsys, monkeypatch, *words)
        told = " ".join(f"{out} {err}".split())
        assert code == 0
        assert "demo: fine" in told
        assert ("5 coded frames end before the steady phase: take 6" in told) == said


def every_command(group, path=()):
    """All commands below a group, each with the words that call it."""
    for name, command in getattr(group, "commands", {}).items():
        yield (*path, name), command
        yield from every_command(command, (*path, name))


def test_help_keeps_what_stands_in_brackets(capsys, monkeypatch):
    """Rich's markup would take "[one a core]" for a tag, and print nothing."""
    from typer.main import get_command

    from optsim.app.cli import app

    monkeypatch.setenv("COLUMNS", "200")
    checked = 0
    for words, command in every_command(get_command(app)):
        wanted = [part for each in command.params for part in re.findall(r"\[.*?\]", each.help or "")]
        if wanted:
            shown = re.sub(r"[│\s]+", " ", optsim(capsys, monkeypatch, *words, "--help")[1])
            for part in wanted:
                assert part in shown, (words, part)
                checked += 1
    assert checked > 20
