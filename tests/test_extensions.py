"""Classes of another installed package are listed, run and scored as our own; wrong ones end in one line."""

import json
import os
import shutil
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
from small_experiment import SMALL
from test_cli import cli  # noqa: F401  a fixture

from optsim import testing
from optsim.camera.hardware import demo
from optsim.coding import ALL as SCHEMES
from optsim.core import extensions
from optsim.core.errors import ConfigError
from optsim.decoding import Interpolation
from optsim.experiment.experiment import load_experiment
from optsim.metrics import SAMPLE_METRICS
from optsim.scene import Scene, load_scene
from optsim.scene.movers import Card

FLAG = {"center_m": (0.0, 1.0, 1.0), "size_m": (0.4, 0.3), "velocity_m_s": (0.5, 0.0, 0.0)}
FOREIGN = Path(__file__).parent / "support" / "foreign_package"


def installed(place: Path) -> Path:
    """Build the package's wheel and unpack it, as an installer does."""
    hatchling = pytest.importorskip("hatchling.build")
    source = place / "source"
    shutil.copytree(FOREIGN, source, ignore=shutil.ignore_patterns("__pycache__"))
    before = Path.cwd()
    os.chdir(source)
    try:
        wheel = hatchling.build_wheel(str(place))
    finally:
        os.chdir(before)
    zipfile.ZipFile(place / wheel).extractall(place / "site")
    return place / "site"


@pytest.fixture
def foreign(tmp_path_factory, monkeypatch):
    monkeypatch.syspath_prepend(installed(tmp_path_factory.mktemp("foreign")))
    extensions.offered.cache_clear()
    yield
    extensions.offered.cache_clear()
    sys.modules.pop("optsim_sketch", None)


def offering(place: Path, group: str, target: str, text: str = "") -> None:
    """A package that offers something under a name, as files on the path."""
    about = place / "wrong-1.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: wrong\nVersion: 1\n")
    (about / "entry_points.txt").write_text(f"[{group}]\nwrong = {target}\n")
    (place / "wrong_package.py").write_text(text)


@pytest.mark.usefixtures("foreign")
@pytest.mark.parametrize(
    ("what", "name"),
    [
        ("decoders", "sketch_flat"),
        ("metrics", "mean-error[white]"),
        ("parts", "sketch_dusty"),
        ("objects", "sketch_flag"),
    ],
)
def test_they_are_listed_beside_ours(cli, what, name):  # noqa: F811
    code, out, _ = cli("list", what)
    assert code == 0
    assert any(line.startswith(name) for line in out.splitlines())
    assert len(out.splitlines()) > 3


@pytest.mark.usefixtures("foreign")
def test_they_keep_our_contracts():
    from optsim_sketch import DustyRelay, Flag, Flat, MeanError

    testing.check_decoder(Flat())
    testing.check_metric(MeanError())
    testing.check_part(DustyRelay(**demo().relay.model_dump()), "relay")
    testing.check_object(Flag(material="grey", **FLAG))


@pytest.mark.parametrize("metric", SAMPLE_METRICS, ids=lambda m: m.kind)
def test_our_metrics_keep_the_contract_that_is_offered(metric):
    testing.check_metric(metric)


@pytest.mark.parametrize("scheme", SCHEMES, ids=lambda part: part.__name__)
def test_our_schemes_keep_the_contract_that_is_offered(scheme):
    testing.check_scheme(scheme())


def test_a_broken_contract_is_said():
    class Late(Interpolation):
        def decode(self, frames, calibration):
            return super().decode(list(frames)[::-1], calibration)

    class Negative(Interpolation):
        def decode(self, frames, calibration):
            for each in super().decode(frames, calibration):
                object.__setattr__(each, "irradiance_w_m2", each.irradiance_w_m2 - np.float32(1))
                yield each

    testing.check_decoder(Interpolation())
    for decoder, said in ((Late(), "in order"), (Negative(), "not negative")):
        with pytest.raises(AssertionError, match=said):
            testing.check_decoder(decoder)


@pytest.mark.usefixtures("foreign")
def test_they_run_and_are_scored(cli, tmp_path):  # noqa: F811
    sets = [f"--set={each}" for each in (*SMALL, "calibration=true", "camera.relay.kind=sketch_dusty")]
    words = ["run", "demo", "--methods", "random", "--out", "run", *sets]
    code, _, shown = cli(*words, "--set=methods.random.decoder={kind='sketch_flat'}")
    assert code == 0, shown
    results = json.loads((tmp_path / "run" / "results.json").read_text())
    assert results["experiment"]["methods"][0]["decoder"] == {"kind": "sketch_flat"}
    assert results["experiment"]["camera"]["relay"]["dust_share"] == 0.1
    scored = [each for each in results["class_series"] if each["metric"] == "mean-error[white]"]
    assert any(0 < value < 10 for each in scored for value in each["values"] if value is not None)
    # Its version and its code are part of what a run's numbers follow from.
    assert results["versions"]["optsim.decoders: sketch_flat"].startswith("optsim-sketch 0.2, ")


@pytest.mark.usefixtures("foreign")
def test_a_foreign_relay_takes_light_away():
    clean, dusty = (
        load_experiment("demo", [*SMALL, *more]).camera
        for more in ((), ("camera.relay.kind=sketch_dusty", "camera.relay.dust_share=0.25"))
    )
    rows = [{row.stage: row.value for row in each.ledger(1.0)} for each in (clean, dusty)]
    assert rows[1]["relay stop"] == pytest.approx(0.75 * rows[0]["relay stop"])


@pytest.mark.usefixtures("foreign")
def test_a_foreign_mover_moves_in_a_scene():
    table = load_scene("flying_solids").model_dump()
    flag = {"kind": "sketch_flag", "material": "grey", **FLAG}
    table |= {"materials": {**table["materials"], "grey": {"kind": "diffuse", "reflectance": 0.5}}}
    scene = Scene.model_validate({**table, "movers": {"flag": flag}})
    assert scene.model_dump()["movers"]["flag"]["sinks_m_s"] == 0.2
    before, after = (scene.singles()["flag"].vertices(time_s) for time_s in (0.0, 1.0))
    still = Card(material="grey", **FLAG)
    np.testing.assert_allclose(after - before, still.vertices(1.0) - still.vertices(0.0) - (0, 0, 0.2))
    with pytest.raises(ConfigError, match="sinks_m: unknown key"):
        Scene.model_validate({**table, "movers": {"flag": {**flag, "sinks_m": 1}}})


@pytest.mark.usefixtures("foreign")
def test_a_wrong_key_of_a_foreign_class_ends_in_one_line():
    with pytest.raises(ConfigError, match=r"optsim\.parts: sketch_dusty.*\n.*dusty_share: unknown key"):
        load_experiment("demo", ["camera.relay.kind=sketch_dusty", "camera.relay.dusty_share=0.1"])
    with pytest.raises(ConfigError, match="kind"):
        load_experiment("demo", ["methods.random.decoder={kind='sketch_flatt'}"])


@pytest.mark.parametrize(
    ("target", "text", "said"),
    [
        ("wrong_package:Missing", "", "AttributeError"),
        ("wrong_package:thing", "thing = 3", "got 3, expected a subclass of Part with kind = 'wrong'"),
        (
            "wrong_package:Other",
            "from optsim.core.config import Part\nclass Other(Part):\n    kind: str = 'x'\n",
            "kind = 'wrong'",
        ),
    ],
)
def test_a_wrong_offer_ends_in_one_line(cli, tmp_path, monkeypatch, target, text, said):  # noqa: F811
    offering(tmp_path, extensions.DECODERS, target, text)
    monkeypatch.syspath_prepend(tmp_path)
    extensions.offered.cache_clear()
    try:
        code, _, shown = cli("list", "decoders")
    finally:
        extensions.offered.cache_clear()
        sys.modules.pop("wrong_package", None)
    assert code == 2
    assert said in shown
    assert "fix: mend or uninstall wrong" in " ".join(shown.split())
