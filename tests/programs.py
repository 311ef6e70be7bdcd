"""Programs of ``validation/`` as modules, for tests of what they compute."""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest

_PLACE = Path(__file__).parent.parent / "validation"


def program(name: str) -> ModuleType:
    """Load a program, with what it imports from beside it."""
    spec = importlib.util.spec_from_file_location(f"validation_{name}", _PLACE / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "path", [str(_PLACE), *sys.path])
        spec.loader.exec_module(module)
    return module
