"""Rooms that moved are found by their old names, with a warning."""

import importlib
import sys

import pytest

import optsim


@pytest.mark.parametrize("old", sorted(optsim._MOVED))
def test_an_old_name_gives_the_room_and_warns(old: str) -> None:
    now = optsim._MOVED[old]
    sys.modules.pop(old, None)
    with pytest.warns(DeprecationWarning, match=f"{old} is {now} now"):
        found = importlib.import_module(old)
    assert found is importlib.import_module(now)
