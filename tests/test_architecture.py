"""The walls of the building, held by reading the imports of every file."""

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "optsim"

# The rooms of the house, lowest first: each may import those before it, never one after it.
LAYERS = (
    "core",
    "optics",
    "scene",
    "footage",
    "render",
    "calibration",
    "coding",
    "priors",
    "decoding",
    "camera",
    "metrics",
    "report",
    "experiment",
    "tasks",
    "dataset",
    "study",
    "testing",
    "presets",
    "app",
    "__main__",
)
# What a room may not import although it lies lower. The truth wall: schemes and decoders lie below the
# camera, so that they can't see its true parameters, and know neither scene nor renderer.
TRUTH = {"scene", "footage", "render"}
WALLS: dict[str, set[str]] = {
    "calibration": TRUTH,
    "coding": TRUTH,
    "priors": TRUTH,
    "decoding": TRUTH,
    "metrics": {*TRUTH, "camera", "calibration", "coding", "priors", "decoding"},
    "report": {*TRUTH, "camera", "calibration", "coding", "priors", "decoding"},
    "camera": {"render"},
    "tasks": {*LAYERS[1 : LAYERS.index("tasks")]},
}
# Rooms of variants (files that define a class with a ``kind``): these don't import each other. A wrapper is
# made of others and may.
ROOMS_OF_VARIANTS = ("coding", "decoding", "camera/parts", "metrics")
WRAPPERS = {"coding.motion_adaptive", "decoding.union"}


def imports(path: Path) -> set[str]:
    """Dotted names imported by a file, relative ones resolved, ``from optsim import x`` as optsim.x."""
    package = ["optsim", *path.relative_to(PACKAGE).parts[:-1]]
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            start = package[: len(package) - node.level + 1] if node.level else []
            module = ".".join([*start, *([node.module] if node.module else [])])
            names |= {f"{module}.{alias.name}" for alias in node.names}
    return names


def rooms_of(names: set[str]) -> set[str]:
    known = {p.stem if p.is_file() else p.name for p in PACKAGE.iterdir()}
    return {n.split(".")[1] for n in names if n.startswith("optsim.") and n.split(".")[1] in known}


FILES = sorted(p for p in PACKAGE.rglob("*.py") if p != PACKAGE / "__init__.py")


def room(path: Path) -> str:
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def module(path: Path) -> str:
    return ".".join(["optsim", *path.relative_to(PACKAGE).with_suffix("").parts]).removesuffix(".__init__")


def test_every_room_has_its_layer() -> None:
    assert {room(path) for path in FILES} == set(LAYERS)


def test_no_module_lies_at_the_top() -> None:
    assert {p.name for p in PACKAGE.glob("*.py")} == {"__init__.py", "__main__.py"}


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_imports_go_down_and_through_no_wall(path: Path) -> None:
    here = room(path)
    lower = set(LAYERS[: LAYERS.index(here) + 1]) - WALLS.get(here, set())
    extra = rooms_of(imports(path)) - lower
    assert not extra, f"{path.name} may not import {sorted(extra)}"


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_only_render_knows_mitsuba(path: Path) -> None:
    if room(path) != "render":
        assert not {n.split(".")[0] for n in imports(path)} & {"mitsuba", "drjit"}


def circles(graph: dict[str, set[str]]) -> set[str]:
    """What is left of a graph when everything whose imports are done has been taken out, both ways."""
    left = dict(graph)
    while free := {name for name, targets in left.items() if not targets & left.keys()}:
        left = {name: targets for name, targets in left.items() if name not in free}
    while free := left.keys() - set().union(*left.values()):
        left = {name: targets for name, targets in left.items() if name not in free}
    return set(left)


def test_no_circles_between_modules() -> None:
    """Imports inside functions count, too."""
    modules = {module(path): path for path in FILES}
    graph = {
        name: {n if n in modules else n.rpartition(".")[0] for n in imports(path)} & modules.keys()
        for name, path in modules.items()
    }
    assert not circles(graph)


def test_the_circle_check_sees_circles() -> None:
    graph = {"a": {"b"}, "b": {"c"}, "c": {"b", "d"}, "d": set()}
    assert circles(graph) == {"b", "c"}


def test_the_resolver_sees_every_form_of_import(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A check that cannot fail is no check: relative, aliased and package-level imports are all caught."""
    monkeypatch.setattr(sys.modules[__name__], "PACKAGE", tmp_path)
    for name in ("camera", "decoding"):
        (tmp_path / name).mkdir()
    for text in (
        "from ..camera import X",
        "from optsim import camera",
        "import optsim.camera as c",
        "from .. import camera",
    ):
        sneaky = tmp_path / "decoding" / "sneaky.py"
        sneaky.write_text(text)
        assert rooms_of(imports(sneaky)) == {"camera"}, text


def is_variant(path: Path) -> bool:
    classes = [
        n for n in ast.walk(ast.parse(path.read_text(encoding="utf-8"))) if isinstance(n, ast.ClassDef)
    ]
    fields = [f for c in classes for f in c.body if isinstance(f, ast.AnnAssign)]
    return any(isinstance(f.target, ast.Name) and f.target.id == "kind" for f in fields)


@pytest.mark.parametrize("name", ROOMS_OF_VARIANTS)
def test_siblings_do_not_know_each_other(name: str) -> None:
    dotted = name.replace("/", ".")
    variants = {f"{dotted}.{p.stem}": p for p in (PACKAGE / name).glob("*.py") if is_variant(p)}
    for sibling, path in variants.items():
        if sibling not in WRAPPERS:
            known = {n.removeprefix("optsim.") for n in imports(path)}
            others = [s for s in variants if s != sibling and any(k.startswith(s) for k in known)]
            assert not others, sibling


def test_the_sibling_check_sees_the_variants() -> None:
    found = {p.stem for room_ in ROOMS_OF_VARIANTS for p in (PACKAGE / room_).glob("*.py") if is_variant(p)}
    assert found >= {"hdr_mosaic", "random_exposure", "normal_photography", "hdr_merge", "sparse_coding"}


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_files_stay_small(path: Path) -> None:
    assert len(path.read_text(encoding="utf-8").splitlines()) <= 400


def test_every_room_runs_without_the_renderer() -> None:
    modules = [module(p) for p in FILES if room(p) not in {"render", "__main__"}]
    program = (
        "import sys, importlib\n"
        "sys.modules['mitsuba'] = None; sys.modules['drjit'] = None\n"
        f"for name in {modules!r}: importlib.import_module(name)\n"
    )
    subprocess.run([sys.executable, "-c", program], check=True, timeout=120)


def imported(program: str, heavy: set[str]) -> list[str]:
    """Which of some modules a program, run by itself, has imported in the end."""
    program += f"\nimport sys\nprint(*sorted({heavy!r} & set(sys.modules)))"
    out = subprocess.run(
        [sys.executable, "-c", program], check=True, timeout=60, capture_output=True, text=True
    )
    return out.stdout.split()


def test_help_is_quick_to_import() -> None:
    """The command line imports no heavy library until a command needs it."""
    heavy = {"numba", "mitsuba", "colour", "skimage", "scipy", "OpenEXR", "trimesh", "jinja2"}
    assert imported("import optsim.app.cli", heavy) == []


def test_explain_compiles_nothing_and_needs_no_renderer() -> None:
    """Plan and effects come from small cameras: to load a compiled loop would take longer."""
    program = "from optsim.experiment.explain import explanation\nexplanation('demo', [])\n"
    heavy = {"numba", "llvmlite", "mitsuba", "drjit", "OpenEXR", "trimesh", "jinja2"}
    assert imported(program, heavy) == []


# Words of an earlier private language: a name that needs one has a plainer one (docs/concepts.md).
RETIRED = {"crime", "luck", "picks", "says", "told", "unnatural", "untold"}


def retired(text: str) -> set[str]:
    """Retired words in the names that a file defines or uses."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(text)):
        match node:
            case ast.FunctionDef(name=name) | ast.ClassDef(name=name):
                names.add(name)
            case ast.Name(id=name) | ast.arg(arg=name) | ast.Attribute(attr=name):
                names.add(name)
            case _:
                pass
    words = {word.lower() for name in names for word in re.split(r"_|(?<=[a-z0-9])(?=[A-Z])", name)}
    return words & RETIRED


@pytest.mark.parametrize(
    "path", sorted(PACKAGE.rglob("*.py")), ids=lambda p: p.relative_to(PACKAGE).as_posix()
)
def test_no_name_uses_a_retired_word(path: Path) -> None:
    assert not retired(path.read_text(encoding="utf-8"))


def test_the_check_of_words_sees_them() -> None:
    assert retired("def f(told): return UnnaturalLight.luck") == {"told", "unnatural", "luck"}
