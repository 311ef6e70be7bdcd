"""Evidence holds for code: prose about it may change, what it does may not."""

from pathlib import Path

import pytest

from optsim import evidence

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


@pytest.mark.parametrize(
    ("changed", "same"),
    [
        (REWORDED, True),
        (CODE.replace("2 * x", "3 * x"), False),
        (CODE.replace("twice", "double"), False),
        (CODE.replace("return", "'text'\n    return"), False),
    ],
)
def test_a_record_survives_new_prose_and_no_new_code(
    changed: str, same: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(evidence, "_PACKAGE", tmp_path / "optsim")
    for folder, text in (("before", CODE), ("after", changed)):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "file.py").write_text(text, encoding="utf-8")
    hashes = []
    for folder in ("before", "after"):
        (tmp_path / "optsim").mkdir(exist_ok=True)
        (tmp_path / "optsim" / "file.py").write_text((tmp_path / folder / "file.py").read_text())
        evidence._code_of.cache_clear()
        hashes.append(evidence.hash_code(["optsim/*.py"]))
    assert (hashes[0] == hashes[1]) == same
    assert evidence.hash_files(["before/*.py"]) != evidence.hash_files(["after/*.py"])
