"""What long measurements of ``validation/`` keep: recalled as long as it would come out the same."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from programs import program

from optsim.experiment.experiment import load_experiment


@pytest.fixture
def kept() -> Callable[..., dict[str, Any]]:
    return program("kept").kept


def test_only_what_would_come_out_the_same_is_recalled(kept, tmp_path) -> None:
    path, demo = tmp_path / "found.json", load_experiment("demo")
    assert kept(path, demo, lambda: {"db": 27.5}) == {"db": 27.5}
    assert kept(path, demo, lambda: {"db": 1.0}) == {"db": 27.5}
    assert kept(path, load_experiment("demo", ["seed=2"]), lambda: {"db": 2.0}) == {"db": 2.0}
    assert kept(path, demo, lambda: {"db": 3.0}) == {"db": 3.0}


def test_a_broken_file_is_measured_anew(kept, tmp_path) -> None:
    path = tmp_path / "found.json"
    path.write_text("{broken", encoding="utf-8")
    assert kept(path, load_experiment("demo"), lambda: {"db": 1.0}) == {"db": 1.0}


def test_a_measurement_that_fails_keeps_what_was_found_before(kept, tmp_path) -> None:
    path, demo = tmp_path / "found.json", load_experiment("demo")
    kept(path, demo, lambda: {"db": 27.5})
    with pytest.raises(ZeroDivisionError):
        kept(path, load_experiment("demo", ["seed=2"]), lambda: {"db": 1 / 0})
    assert kept(path, demo, lambda: {"db": 1.0}) == {"db": 27.5}
