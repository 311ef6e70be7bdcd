"""Keys of stored results hold for code: prose about it may change, what it does may not."""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest

from optsim.core import code_hash
from optsim.core.cache import Cache
from optsim.core.code_hash import hash_files
from optsim.core.quantities import Timing, View
from optsim.dataset import building
from optsim.dataset.spec import DatasetSpec
from optsim.experiment.experiment import load_experiment
from optsim.experiment.resume import run_key
from optsim.render import truth
from optsim.render.settings import RenderSettings
from optsim.scene import load_scene

CODE = '''"""About the module."""
LIMIT = 3
"""About the limit."""


def twice(x: float, *, near: bool = False) -> float:
    """Twice a number."""
    return 2 * x if x in {"one", "two", "three"} else LIMIT
'''
REWORDED = '''"""About the module,
at length."""

# A remark.
LIMIT = 3  # another


def twice(x: float, *, near: bool = False) -> float:

    """The number and itself."""
    # A longer remark.
    return 2 * x if x in {"one", "two", "three"} else LIMIT
'''
OTHER_CODE = {
    "value": CODE.replace("LIMIT = 3", "LIMIT = 4"),
    "kind of a value": CODE.replace("LIMIT = 3", "LIMIT = 3.0"),
    "operator": CODE.replace("2 * x", "2 + x"),
    "name": CODE.replace("LIMIT", "BOUND"),
    "default": CODE.replace("= False", "= True"),
    "annotation": CODE.replace("near: bool", "near: int"),
    "text": CODE.replace("three", "four"),
    "order": CODE.replace("LIMIT = 3\n", "") + "LIMIT = 3\n",
}


def package(folder: Path, monkeypatch: pytest.MonkeyPatch, text: str, name: str = "one") -> None:
    """Make a package with this module in the rooms whose code is hashed."""
    for room in ("scene", "render"):
        (folder / "optsim" / room).mkdir(parents=True)
        (folder / "optsim" / room / f"{name}.py").write_text(text, encoding="utf-8")
    monkeypatch.setattr(code_hash, "_PACKAGE", folder / "optsim")


def files(monkeypatch: pytest.MonkeyPatch) -> str:
    return hash_files(["optsim/**/*.py"])


def key_of_a_run(monkeypatch: pytest.MonkeyPatch) -> str:
    return run_key(load_experiment("demo"))


def identity_of_the_truth(monkeypatch: pytest.MonkeyPatch) -> str:
    class Found(Exception):
        pass

    def plan(*given: object, **named: object) -> None:
        raise Found(given[7])

    monkeypatch.setattr(truth, "RenderPlan", plan)
    monkeypatch.setattr(truth, "activate", lambda _: SimpleNamespace(variant="any"))
    with pytest.raises(Found) as found:
        truth.render_truth(
            load_scene("wheel"), View(6, 8, 1, 0.1), Timing(1 / 180, 36, 1), RenderSettings(), cache=Cache()
        )
    return str(found.value)


def key_of_a_sequence(monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.setattr(building, "renderer", lambda _: ["any"])
    spec = DatasetSpec.model_validate({"name": "set", "scenes": {"half_moving": ["0:1"]}})
    return building.tasks_of(spec, Path(), "npy", {})[0].key


KEYS = [files, key_of_a_run, identity_of_the_truth, key_of_a_sequence]


@pytest.mark.parametrize("key", KEYS)
def test_prose_leaves_a_key_alone_and_code_does_not(
    key: Callable[[pytest.MonkeyPatch], str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    package(tmp_path / "before", monkeypatch, CODE)
    before = key(monkeypatch)
    package(tmp_path / "reworded", monkeypatch, REWORDED)
    assert key(monkeypatch) == before
    for what, text in OTHER_CODE.items():
        package(tmp_path / what, monkeypatch, text)
        assert key(monkeypatch) != before, what
    package(tmp_path / "renamed", monkeypatch, CODE, name="other")
    assert key(monkeypatch) != before


def test_each_process_finds_the_same_hash() -> None:
    """Sets and texts hash by chance in each process of Python."""
    command = "from optsim.core.code_hash import hash_files; print(hash_files(['optsim/**/*.py']))"
    found = {
        subprocess.run(
            [sys.executable, "-c", command],
            env={**os.environ, "PYTHONHASHSEED": seed},
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for seed in ("1", "2")
    }
    assert len(found) == 1
