"""Modules that moved are found by their old names, with a warning."""

import importlib
import sys

import pytest

from optsim.core.old_names import MOVED, new_name


@pytest.mark.parametrize("old", [*MOVED, "optsim.scene.recording.tiff", "optsim.reconstruct.hdr_merge"])
def test_an_old_name_gives_the_module_and_warns(old: str) -> None:
    new = new_name(old)
    assert new is not None
    for name in [name for name in sys.modules if name == old]:
        del sys.modules[name]
    with pytest.warns(DeprecationWarning, match=f"{old} is {new} now"):
        found = importlib.import_module(old)
    assert found is importlib.import_module(new)


def test_a_name_that_holds_is_no_old_one() -> None:
    for name in ("optsim.camera", "optsim.experiment", "optsim.scene", "optsim.optics.psf", "numpy"):
        assert new_name(name) is None
    with pytest.raises(ModuleNotFoundError):
        importlib.import_module("optsim.nowhere")
