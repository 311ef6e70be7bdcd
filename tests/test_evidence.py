"""Evidence holds for code: prose about it may change, what it does may not."""

import shutil
from pathlib import Path

import pytest

import optsim
from optsim.core import code_hash
from optsim.experiment.evidence import check_names, load_check, records, status

VALIDATION = Path(__file__).parents[1] / "validation"

CODE = '''"""About the module."""

# A remark.
def twice(x: float) -> float:
    """Twice a number."""
    return 2 * x  # not halved


LIMIT = 3
"""About the limit."""
'''
REWORDED = '''"""Another sentence,
on two lines."""
def twice(x: float) -> float:

    """The number and itself."""
    # A longer remark.
    return 2 * x  # twice, '#' and all
LIMIT = 3
"""Otherwise about the limit."""
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
        ({"one": CODE.replace("= 3", "= 4"), "other": OTHER}, False),
        ({"one": CODE.replace("x  #", "x + len('#')  #"), "other": OTHER}, False),
        ({"one": CODE, "other": OTHER.replace("import given", "import taken as given")}, False),
        ({"one": CODE}, False),
    ],
)
def test_a_record_survives_moves_and_prose_but_no_new_code(
    modules: dict[str, str], same: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = hash_of_modules(tmp_path / "before", monkeypatch, one=CODE, other=OTHER)
    assert (hash_of_modules(tmp_path / "after", monkeypatch, **modules) == before) == same


def test_a_value_that_another_module_has_too_is_no_other_s(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With "A = 1" and "A = 2" elsewhere, a third A that becomes 2 must count."""
    rest = {"one": "A = 1\n", "other": "A = 2\n"}
    before = hash_of_modules(tmp_path / "before", monkeypatch, **rest, third="A = 1\n")
    assert hash_of_modules(tmp_path / "after", monkeypatch, **rest, third="A = 2\n") != before


MODULES = {
    "parts/__init__.py": "from optsim.parts.lens import Lens\nfrom optsim.parts.panel import Panel\n",
    "parts/lens.py": "from optsim.parts.glass import index\nclass Lens:\n    power = index\n",
    "parts/glass.py": "index = 1.5\n",
    "parts/panel.py": "class Panel:\n    rows = 3\n",
    "lazy/__init__.py": "import lazy_loader\n__getattr__ = lazy_loader.attach_stub(__name__, __file__)\n",
    "lazy/__init__.pyi": "from .light import light\n",
    "lazy/light.py": "def light():\n    from optsim.lazy import late\n    return late.LIGHT\n",
    "lazy/late.py": "LIGHT = 1\n",
    "command.py": "import optsim.tools.used\n",
    "tools/used.py": "A = 1\n",
    "tools/other.py": "A = 1\n",
    "core.py": "A = 1\n",
}
GLOBS = ["optsim/parts/*.py", "optsim/lazy/*.py", "optsim/command.py", "optsim/tools/*.py"]


def hash_of_effect(folder: Path, monkeypatch: pytest.MonkeyPatch, changed: dict[str, str]) -> str:
    """Hash what a check of a lens and of light covers."""
    for name, text in (MODULES | changed).items():
        place = folder / "optsim" / name
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_text(text, encoding="utf-8")
    check = folder / "check.py"
    check.write_text(
        "import optsim.core\nfrom optsim.lazy import light\nfrom optsim.parts import Lens\n", encoding="utf-8"
    )
    monkeypatch.setattr(code_hash, "_PACKAGE", folder / "optsim")
    return code_hash.hash_code(GLOBS, code_hash.imports_of([check]))


@pytest.mark.parametrize(
    ("changed", "same"),
    [
        ({"parts/new.py": "class New:\n    pass\n"}, True),
        # Even where the face of the room has the new part.
        (
            {
                "parts/new.py": "class New:\n    pass\n",
                "parts/__init__.py": MODULES["parts/__init__.py"] + "from optsim.parts.new import New\n",
            },
            True,
        ),
        ({"parts/panel.py": "class Panel:\n    rows = 4\n"}, True),
        ({"tools/other.py": "A = 2\n"}, True),
        ({"core.py": "A = 2\n"}, True),  # not among the files of the effect
        ({"parts/lens.py": MODULES["parts/lens.py"] + "\n# A remark.\n"}, True),
        ({"parts/lens.py": MODULES["parts/lens.py"].replace("= index", "= 2 * index")}, False),
        ({"parts/glass.py": "index = 1.6\n"}, False),
        ({"parts/lens.py": MODULES["parts/lens.py"] + "from optsim.parts.panel import Panel\n"}, False),
        ({"lazy/light.py": MODULES["lazy/light.py"].replace("late.LIGHT", "2 * late.LIGHT")}, False),
        ({"lazy/late.py": "LIGHT = 2\n"}, False),
        ({"command.py": "import optsim.tools.used\nA = 1\n"}, False),
        ({"tools/used.py": "A = 2\n"}, False),
    ],
)
def test_a_record_covers_what_its_check_reaches_by_imports(
    changed: dict[str, str], same: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = hash_of_effect(tmp_path / "before", monkeypatch, {})
    assert (hash_of_effect(tmp_path / "after", monkeypatch, changed) == before) == same


def validated_by(package: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, bool]:
    monkeypatch.setattr(code_hash, "_PACKAGE", package)
    return {row.effect: row.validated for row in status()}


def test_the_stored_records_cover_what_is_reached(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On a copy of the package: a new part changes none, other code changes those that reach it."""
    package = tmp_path / "optsim"
    before = validated_by(code_hash._PACKAGE, monkeypatch)
    shutil.copytree(Path(optsim.__file__).parent, package, ignore=shutil.ignore_patterns("__pycache__"))
    (package / "camera" / "parts" / "new.py").write_text("A = 1\n", encoding="utf-8")
    assert validated_by(package, monkeypatch) == before
    with (package / "optics" / "mueller.py").open("a", encoding="utf-8") as more:
        more.write("\n\nA = 1\n")
    after = validated_by(package, monkeypatch)
    assert before["mueller"]
    assert not after["mueller"]
    assert after["relay_overlap"] == before["relay_overlap"]


@pytest.mark.parametrize("name", check_names())
def test_every_record_knows_what_its_check_imports(name: str) -> None:
    imports = code_hash.imports_of((VALIDATION / name).glob("*.py"))
    assert imports
    assert records()[name].imports == imports


def test_what_is_nowhere_has_no_hash_of_code() -> None:
    assert code_hash.hash_code(["optsim/nowhere/*.py"]) == "missing"


@pytest.mark.parametrize("name", check_names())
def test_every_check_says_what_it_claims_and_can_be_measured(name: str) -> None:
    check = load_check(VALIDATION / name / "check.py")
    assert all((check.CLAIM, check.ORACLE, check.SOURCE, check.REASON, check.FILES))
    assert check.TOLERANCE > 0
    assert callable(check.measure)
