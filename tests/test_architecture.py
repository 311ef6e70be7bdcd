"""The walls of the building, held by reading the imports of every file."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "optsim"

BASE = {
    "errors",
    "config",
    "descriptions",
    "units",
    "problems",
    "quantities",
    "files",
    "progress",
    "cache",
    "claims",
    "foreign",
}

# Room or module -> what it may import besides BASE. A room that is not listed here is a failure.
ALLOWED: dict[str, set[str]] = {
    **{name: set() for name in BASE},
    "forward": set(),
    "scene": set(),
    "render": {"forward", "scene"},
    "optics": {"forward"},
    "sensor": {"forward"},
    "geometry": {"forward"},
    "known_calibration": {"forward", "camera", "calibrate", "knowledge"},
    "ledger": {"forward", "optics", "sensor"},
    "camera": {"forward", "optics", "sensor", "geometry", "ledger"},
    "origins": {"forward", "camera", "report"},
    "effects": {"camera"},
    "camera_table": {"camera", "effects", "hardware", "sensor"},
    "probe": {"forward", "camera", "coding", "effects", "optics", "scene"},
    "effect_sizes": {"forward", "effects", "probe"},
    "camera_plan": {"forward", "camera", "effects", "optics", "probe"},
    "focus": {"forward", "camera", "render", "scene"},
    "hardware": {"optics", "sensor", "camera", "forward"},
    "calibrate": {"forward", "knowledge"},
    "laboratory": {"forward", "camera", "calibrate"},
    "coding": {"forward", "calibrate"},
    "reconstruct": {"forward", "calibrate"},
    "metrics": {"forward"},
    "report": {"metrics"},
    "run_frames": set(),
    "evidence": set(),
    "knowledge": set(),
    "bench_calibration": {"calibrate", "camera", "evidence"},
    "doctor": {"render", "scene"},
}
# The top of the building: may import any room, and only each other.
TOP = {
    "gallery",
    "presets",
    "__main__",
    "experiment",
    "truth",
    "densities",
    "journal",
    "finished",
    "loop",
    "object_masks",
    "own_f_number",
    "job",
    "passes",
    "scoring",
    "explain",
    "train",
    "imported_clips",
    "run_calibrations",
    "cli",
    "cli_errors",
    "cli_groups",
    "cli_measure",
    "cli_options",
    "cli_reconstruct",
    "cli_train",
    "measurement",
    "trace",
    "benchmark",
    "stopwatch",
    "console",
    "catalogue",
    "experiment_schema",
}

# Rooms of variants (files that define a class with a ``kind``): these don't import each other. A wrapper is
# made of others and may.
ROOMS_OF_VARIANTS = ("coding", "reconstruct", "optics", "metrics", "sensor")
WRAPPERS = {"coding.motion_adaptive", "reconstruct.union"}
# The truth wall: what must never see a true parameter, a scene or a renderer.
BEHIND_THE_WALL = {"coding", "reconstruct", "calibrate"}
TRUTH = {
    "camera",
    "ledger",
    "geometry",
    "known_calibration",
    "laboratory",
    "bench_calibration",
    "origins",
    "effects",
    "effect_sizes",
    "focus",
    "probe",
    "camera_plan",
    "optics",
    "sensor",
    "hardware",
    "scene",
    "render",
    "loop",
    "truth",
}


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


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_imports_follow_the_table(path: Path) -> None:
    here = room(path)
    if here in TOP:
        return
    assert here in ALLOWED, f"{here} has no row in the import table"
    extra = rooms_of(imports(path)) - ALLOWED[here] - BASE - {here}
    assert not extra, f"{path.name} may not import {sorted(extra)}"


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_only_render_knows_mitsuba(path: Path) -> None:
    if room(path) != "render":
        assert not {n.split(".")[0] for n in imports(path)} & {"mitsuba", "drjit"}


def test_truth_wall_is_in_the_table() -> None:
    for behind in BEHIND_THE_WALL:
        assert not ALLOWED[behind] & TRUTH


def test_the_resolver_sees_every_form_of_import(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A check that cannot fail is no check: relative, aliased and package-level imports are all caught."""
    monkeypatch.setattr(sys.modules[__name__], "PACKAGE", tmp_path)
    for name in ("camera.py", "reconstruct"):
        (tmp_path / name).mkdir() if "." not in name else (tmp_path / name).touch()
    for text in (
        "from ..camera import X",
        "from optsim import camera",
        "import optsim.camera as c",
        "from .. import camera",
    ):
        sneaky = tmp_path / "reconstruct" / "sneaky.py"
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
    variants = {f"{name}.{p.stem}": p for p in (PACKAGE / name).glob("*.py") if is_variant(p)}
    for module, path in variants.items():
        if module not in WRAPPERS:
            known = {n.removeprefix("optsim.") for n in imports(path)}
            assert not [s for s in variants if s != module and any(k.startswith(s) for k in known)], module


def test_the_sibling_check_sees_the_variants() -> None:
    found = {p.stem for room_ in ROOMS_OF_VARIANTS for p in (PACKAGE / room_).glob("*.py") if is_variant(p)}
    assert found >= {"hdr_mosaic", "random_exposure", "normal_photography", "hdr_merge", "sparse_coding"}


def test_no_circles_between_rooms() -> None:
    edges = {r: {x for x in targets if x in ALLOWED} for r, targets in ALLOWED.items()}
    done: set[str] = set()
    while len(done) < len(edges):
        free = {r for r, targets in edges.items() if r not in done and targets <= done}
        assert free, f"a circle among {sorted(set(edges) - done)}"
        done |= free


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_files_stay_small(path: Path) -> None:
    assert len(path.read_text(encoding="utf-8").splitlines()) <= 400


def test_every_room_runs_without_the_renderer() -> None:
    modules = [
        ".".join(["optsim", *p.relative_to(PACKAGE).with_suffix("").parts]).removesuffix(".__init__")
        for p in FILES
        if room(p) not in {"render", "__main__"}
    ]
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
    assert imported("import optsim.cli", heavy) == []


def test_explain_compiles_nothing_and_needs_no_renderer() -> None:
    """Plan and effects come from small cameras: to load a compiled loop would take longer."""
    program = "from optsim.explain import explanation\nexplanation('demo', [])\n"
    heavy = {"numba", "llvmlite", "mitsuba", "drjit", "OpenEXR", "trimesh", "jinja2"}
    assert imported(program, heavy) == []
