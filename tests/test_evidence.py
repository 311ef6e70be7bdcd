"""Evidence holds for code: prose about it may change, what it does may not."""

from pathlib import Path

import pytest

from optsim.core import code_hash
from optsim.experiment.evidence import check_names, load_check

VALIDATION = Path(__file__).parents[1] / "validation"

CODE = '''"""About the module."""

# A remark.
def twice(x: float) -> float:
    """Twice a number."""
    return 2 * x  # not halved
'''
REWORDED = '''"""Another sentence,
on two lines."""
def twice(x: float) -> float:

    """The number and itself."""
    # A longer remark.
    return 2 * x  # not halved
'''


OTHER = """
from optsim.before import given


def half(x: float) -> float:
    return given(x)
"""


def hash_of_modules(folder: Path, monkeypatch: pytest.MonkeyPatch, **modules: str) -> str:
    (folder / "optsim").mkdir(parents=True)
    monkeypatch.setattr(code_hash, "_PACKAGE", folder / "optsim")
    for name, text in modules.items():
        (folder / "optsim" / f"{name}.py").write_text(text, encoding="utf-8")
    return code_hash.hash_code(["optsim/*.py"])


@pytest.mark.parametrize(
    ("modules", "same"),
    [
        ({"one": REWORDED, "other": OTHER}, True),
        # Moved: to another module, to another place, or with what it imports.
        ({"moved": CODE, "other": OTHER}, True),
        ({"whole": CODE + OTHER}, True),
        ({"whole": OTHER + CODE.partition("\n")[2]}, True),
        ({"one": CODE, "other": OTHER.replace("optsim.before", "optsim.after")}, True),
        ({"one": CODE.replace("2 * x", "3 * x"), "other": OTHER}, False),
        ({"one": CODE.replace("twice", "double"), "other": OTHER}, False),
        ({"one": CODE.replace("return", "'text'\n    return"), "other": OTHER}, False),
        ({"one": CODE, "other": OTHER.replace("import given", "import taken as given")}, False),
        ({"one": CODE}, False),
    ],
)
def test_a_record_survives_moves_and_prose_but_no_new_code(
    modules: dict[str, str], same: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = hash_of_modules(tmp_path / "before", monkeypatch, one=CODE, other=OTHER)
    assert (hash_of_modules(tmp_path / "after", monkeypatch, **modules) == before) == same


def test_what_is_nowhere_has_no_hash_of_code() -> None:
    assert code_hash.hash_code(["optsim/nowhere/*.py"]) == "missing"


@pytest.mark.parametrize("name", check_names())
def test_every_check_says_what_it_claims_and_can_be_measured(name: str) -> None:
    check = load_check(VALIDATION / name / "check.py")
    assert all((check.CLAIM, check.ORACLE, check.SOURCE, check.REASON, check.FILES))
    assert check.TOLERANCE > 0
    assert callable(check.measure)
