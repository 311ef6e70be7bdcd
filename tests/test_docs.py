"""README and manual say what the code does: commands parse, keys exist, code runs, links lead somewhere."""

import importlib.util
import os
import pkgutil
import re
import shlex
import sys
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import typer
from small_experiment import SMALL
from test_cli import cli  # noqa: F401  a fixture

import optsim
from optsim.app.cli import app
from optsim.core.errors import GeometryError
from optsim.core.files import write_exr
from optsim.experiment.experiment import Experiment, load_experiment
from optsim.scene import load_scene

ROOT = Path(__file__).parents[1]
PAGES = ("README.md", *sorted(p.relative_to(ROOT).as_posix() for p in (ROOT / "docs").rglob("*.md")))
# Reads a run's files, and is run on some by tests/test_run_calibrations.py.
OF_A_RUN = "docs/how-to/calibration.md"
# Takes a frame, and is run on one by tests/test_linear_operator.py.
OF_A_FRAME = "docs/how-to/decoder.md"
# Reads a data set, and is run on one by tests/test_dataset.py.
OF_A_DATASET = "docs/how-to/datasets.md"
COARSE = [
    *SMALL,
    "scene.name=./my_room",
    "methods=[{name = 'a', scheme = {kind = 'random_exposure'}, decoder = {kind = 'interpolation'}}]",
    "save_reconstructions=[]",
    "calibration=ideal",
    "render.static_error=2",
    "render.change_error=2",
    "render.moving_error=2",
    "render.interpolation_error=1",
]
# Made, or told from the user's own files, rather than shipped.
OWN = ("mine", "shots", "film", "a.npy", "b.mat", "./", "/data", "reports/runs", "shot.")
# Shown because it says why a camera doesn't fit.
NO_FIT = ("optsim explain paper_prototype --set camera.relay.magnification=0.681",)
# Done in seconds, and needing nothing: these run.
QUICK = re.compile(r"optsim (list|config|cache show|init|run demo --dry-run)")


def blocks(language: str) -> Iterator[tuple[str, str]]:
    """Code of all pages, each once, with its page."""
    seen: set[str] = set()
    for page in PAGES:
        text = (ROOT / page).read_text(encoding="utf-8")
        for code in re.findall(rf"^```{language}\n(.*?)^```$", text, re.DOTALL | re.MULTILINE):
            if code not in seen:
                seen.add(code)
                yield page, code


def lines() -> list[str]:
    """Commands of all pages, without their comments: those in blocks, and whole ones in a sentence."""
    found = [line for _, code in blocks("") for line in code.splitlines()]
    for page in PAGES:
        found += re.findall(r"`((?:optsim|make) [^`]+)`", (ROOT / page).read_text(encoding="utf-8"))
    words = (" ".join(line.partition(" #")[0].removeprefix(".venv/bin/").split()) for line in found)
    return sorted({line for line in words if line.startswith(("optsim ", "make "))})


def toml(page: str, start: str) -> str:
    (code,) = [code for where, code in blocks("toml") if where == page and code.startswith(start)]
    return code


def write_scene(folder: Path) -> None:
    (folder / "my_room").mkdir()
    (folder / "my_room" / "scene.toml").write_text(toml("docs/how-to/scene.md", "name"))


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def words_of(line: str) -> list[str]:
    return shlex.split(line)[1:]


OPTSIM = [line for line in lines() if line.startswith("optsim ")]


@pytest.mark.parametrize("line", [line for line in OPTSIM if "COMMAND" not in line and " RUN" not in line])
def test_commands_parse_and_their_keys_exist(line: str) -> None:
    words = words_of(line)
    command: Any = typer.main.get_command(app)
    name, rest = words[0], words[1:]
    while name is not None:
        assert name in command.commands, name
        command = command.commands[name]
        name = rest.pop(0) if getattr(command, "commands", None) else None
    # Whole commands are of the right form; a name in a sentence may leave its arguments out.
    required = [p for p in command.params if p.param_type_name == "argument" and p.required]
    if not rest and required:
        return
    found = command.make_context(line, list(rest))
    sets = found.params.get("assignments") or []
    experiment = found.params.get("experiment")
    if experiment and not experiment.startswith(OWN):
        shipped = [each for each in sets if not each.partition("=")[2].startswith(OWN)]
        if line in NO_FIT:
            with pytest.raises(GeometryError):
                load_experiment(experiment, shipped)
        else:
            load_experiment(experiment, shipped)


def test_quick_commands_run(cli: Callable[..., tuple[int, str, str]]) -> None:  # noqa: F811
    done = 0
    # What one makes another reads.
    for line in sorted(OPTSIM, key=lambda each: "init" not in each):
        if QUICK.match(line) and "COMMAND" not in line:
            code, _, err = cli(*words_of(line))
            assert code == 0, f"{line}: {err}"
            done += 1
    assert done > 5


def test_targets_of_make_exist() -> None:
    targets = set(re.findall(r"^([a-z0-9-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    named = {shlex.split(line)[1] for line in lines() if line.startswith("make ")}
    assert named
    assert named <= targets


def test_python_of_the_tour_runs(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(optsim, "load_experiment", lambda name, **_: load_experiment(name, COARSE))
    (code,) = [code for page, code in blocks("python") if "render_truth" in code]
    write_scene(folder)
    there: dict[str, Any] = {}
    exec(code, there)
    assert there["scores"]


def test_python_of_measurements_runs(folder: Path) -> None:
    rng = np.random.default_rng(0)
    codes = (rng.random((1, 8, 24, 24)) < 0.4).astype(float)
    there: dict[str, Any] = {"images": codes.sum(axis=1) * 20.0, "codes": codes}
    (code,) = [code for page, code in blocks("python") if page == "docs/how-to/measurement.md"]
    exec(code, there)
    assert (folder / "out" / "results.json").is_file()


def test_python_of_extensions_runs_and_its_offers_are_those_of_the_package() -> None:
    (code,) = [code for page, code in blocks("python") if page == "docs/how-to/extend.md"]
    exec(code, {})
    offers = tomllib.loads(toml("docs/how-to/extend.md", "[project.entry-points"))
    package = ROOT / "tests" / "support" / "foreign_package" / "pyproject.toml"
    wanted = tomllib.loads(package.read_text(encoding="utf-8"))["project"]["entry-points"]
    assert offers["project"]["entry-points"] == wanted


def test_all_python_is_run_by_a_test() -> None:
    pages = [page for page, code in blocks("python") if "render_truth" not in code]
    told = {"docs/how-to/measurement.md", "docs/how-to/extend.md"}
    assert set(pages) == told | {OF_A_RUN, OF_A_FRAME, OF_A_DATASET}


def test_the_scene_loads_with_its_variations(folder: Path) -> None:
    write_scene(folder)
    for variation in ("main", "slow", "3"):
        assert load_scene("./my_room", variation).name == "my_room"


@pytest.mark.parametrize("kind", ["picture", "sunsky"])
def test_the_scene_loads_under_each_sky(kind: str, folder: Path) -> None:
    write_scene(folder)
    write_exr(Path("my_room/panorama.exr"), {"Y": np.ones((32, 64), np.float32)}, attributes={})
    with Path("my_room/scene.toml").open("a") as file:
        file.write(toml("docs/how-to/scene.md", f'[sky]\nkind = "{kind}"'))
    sky = load_scene("./my_room").sky
    assert sky is not None
    assert sky.kind == kind


@pytest.mark.parametrize("page", ["docs/how-to/scheme.md", "docs/how-to/decoder.md"])
def test_methods_join_an_experiment(page: str, folder: Path, cli: Callable[..., Any]) -> None:  # noqa: F811
    cli("init", "demo", "--out", "mine.toml")
    with Path("mine.toml").open("a") as file:
        file.write(toml(page, "[[methods]]"))
    assert len(load_experiment("./mine.toml", []).methods) == 5


def test_keys_of_footage_exist(folder: Path) -> None:
    code = toml("docs/how-to/footage.md", "[source.footage]")
    uncommented = tomllib.loads(re.sub(r"^# ", "", code, flags=re.MULTILINE))
    known = Experiment.model_json_schema()["$defs"]["FootageSource"]["properties"]
    assert set(uncommented["source"]["footage"]) <= set(known)


def test_the_ten_concepts_have_their_homes() -> None:
    text = (ROOT / "docs" / "concepts.md").read_text(encoding="utf-8")
    homes = re.findall(r"^\| [A-Z]\w+ \| .* \| `(optsim[\w.]+)` \|$", text, flags=re.MULTILINE)
    assert len(homes) == 10
    for home in homes:
        assert pkgutil.resolve_name(home)


def test_all_toml_is_toml() -> None:
    found = [tomllib.loads(code) for _, code in blocks("toml")]
    assert len(found) == 12


@pytest.mark.parametrize("page", PAGES)
def test_links_lead_to_files(page: str) -> None:
    text = (ROOT / page).read_text(encoding="utf-8")
    for link in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", text):
        assert os.path.exists((ROOT / page).parent / link), link


def test_the_readme_is_short_and_names_its_commands() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 200
    assert text.count("![") == 1
    for command in ("make setup", "make demo", "make test"):
        assert command in text


@pytest.fixture(scope="module")
def reference() -> Any:
    spec = importlib.util.spec_from_file_location("reference", ROOT / "docs" / "reference.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["reference"] = module
    spec.loader.exec_module(module)
    return module


def test_the_reference_has_every_command_and_option(reference: Any) -> None:
    page = reference.commands()
    for name, command in typer.main.get_command(app).commands.items():
        assert f"## optsim {name}\n" in page
        for parameter in command.params:
            shown = parameter.metavar or parameter.name.upper()
            assert (parameter.opts[0] if parameter.param_type_name == "option" else shown) in page


def test_the_reference_has_every_key(reference: Any) -> None:
    page = reference.experiment_keys()
    schema = Experiment.model_json_schema()
    for table in (schema, *schema["$defs"].values()):
        for key in table["properties"]:
            assert f"| `{key}` |" in page
    assert "`methods.NAME.decoder.moving`" in page
    assert "| `radiance_w_m2_sr` |" in reference.scene_keys()


def test_the_reference_has_what_is_shipped_and_its_records(reference: Any) -> None:
    for name in ("window_room", "demo", "shutter_grid", "union", "fringing"):
        assert f"| `{name}` |" in reference.shipped()
    assert "| [smear](#smear) | pass |" in reference.validation()


def test_links_out_of_the_manual_stay_in_it(reference: Any) -> None:
    text = "[a](../../reports/measured.md#x) [b](../physics.md) [c](../../scenes/wheel/README.md)"
    told = reference.on_page_markdown(
        text, page=SimpleNamespace(file=SimpleNamespace(src_uri="how-to/scene.md"))
    )
    assert told == "[a](../reports/measured.md#x) [b](../physics.md) [c](../scenes/wheel/README.md)"
    back = reference.on_page_markdown(
        "[a](../docs/how-to/studies.md#x) [b](claims.md)",
        page=SimpleNamespace(file=SimpleNamespace(src_uri="reports/prototype.md")),
    )
    assert back == "[a](../how-to/studies.md#x) [b](claims.md)"
