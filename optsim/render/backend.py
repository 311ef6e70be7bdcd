"""Choice of the Mitsuba variant, probed in a subprocess before Mitsuba is imported here.

Dr.Jit 1.5 with an LLVM older than 17 kills the process at its first path-traced kernel: it emits
``llvm.minimum``, which these cannot lower on x86. Dr.Jit also picks up a system LLVM by itself. So a library
is chosen first, and a subprocess path traces a pixel with it. Only a library that survives is used.
"""

from __future__ import annotations

import contextlib
import functools
import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from optsim.core.cache import default_folder, hash_of
from optsim.core.errors import BackendError, ConfigError, StorageError, unknown_name
from optsim.core.files import read_json, write_json
from optsim.core.threads import CORES

VARIANTS = ("cuda_ad_mono", "llvm_ad_mono", "scalar_rgb")
OLDEST_LLVM = 17
_LLVM_CURE = (
    "cure: install karellen-llvm-core (x86-64 Linux), or a system LLVM >= 17 and set DRJIT_LIBLLVM_PATH to it"
)
_MARK = "PROBE"
_PROBE = """
import json, sys
import mitsuba as mi
mi.set_variant(sys.argv[1])
box = mi.cornell_box()
box["sensor"]["film"]["width"] = box["sensor"]["film"]["height"] = 2
box["integrator"] = {"type": "path", "max_depth": 3}
image = mi.render(mi.load_dict(box), spp=4)
total = float(sum(v for v in image.numpy().ravel())) if hasattr(image, "numpy") else 1.0
import drjit as dr
llvm = list(dr.detail.llvm_version()) if "llvm" in sys.argv[1] else []
print("PROBE" + json.dumps({"total": total, "llvm": llvm}))
"""


@dataclass(frozen=True)
class Attempt:
    """Probe of one variant: its library, whether it rendered, and its message."""

    variant: str
    library: str
    works: bool
    message: str


@dataclass(frozen=True)
class BackendReport:
    """The chosen backend and the reason."""

    variant: str  # Of Mitsuba.
    library: str  # LLVM library it uses; empty for Dr.Jit's own choice, or none.
    preview: bool  # The scalar fallback, whose truth is of preview quality.
    reason: str  # One line for users.
    attempts: tuple[Attempt, ...]  # Probes, in order.


def versions() -> dict[str, str]:
    """Versions of the libraries that decide a render."""
    found: dict[str, str] = {"python": ".".join(map(str, sys.version_info[:2]))}
    for package in ("mitsuba", "drjit", "numpy", "scipy", "scikit-image"):
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "missing"
    return found


@functools.cache
def choose_backend(backend: str | None = None) -> BackendReport:
    """Find a variant that renders; probes are cached on disk, so later calls cost nothing.

    Parameters
    ----------
    backend : str, optional
        Required variant.

    Raises
    ------
    BackendError
        When Mitsuba is missing, or the required variant does not work, with the cure.
    ConfigError
        For a variant that optsim does not use.
    """
    if backend is not None and backend not in VARIANTS:
        raise unknown_name("backend", backend, VARIANTS)
    if "missing" in (versions()["mitsuba"], versions()["drjit"]):
        raise BackendError(
            "mitsuba and drjit are not installed; cure: pip install mitsuba==3.9.1 drjit==1.5.0"
        )
    attempts: list[Attempt] = []
    for variant, library in _candidates(backend):
        attempt = _remembered_probe(variant, library)
        attempts.append(attempt)
        if attempt.works:
            return BackendReport(
                variant, library, variant == "scalar_rgb", _reason(attempt, attempts), tuple(attempts)
            )
    tried = "; ".join(f"{a.variant} ({a.library or 'default library'}): {a.message}" for a in attempts)
    if backend is None:
        raise BackendError(f"no renderer backend works: {tried}; {_LLVM_CURE}")
    cure = _LLVM_CURE if "llvm" in backend else "cure: leave the backend to be chosen automatically"
    raise BackendError(f"backend {backend!r} does not work here: {tried or 'no such device'}; {cure}")


def activate(backend: str | None = None) -> BackendReport:
    """Choose a backend and make it Mitsuba's variant in this process."""
    report = choose_backend(backend)
    if "drjit" not in sys.modules:
        # Remove also a library that failed its probe while Dr.Jit's own search worked.
        os.environ.pop("DRJIT_LIBLLVM_PATH", None)
        if report.library:
            os.environ["DRJIT_LIBLLVM_PATH"] = report.library
    import mitsuba as mi

    if mi.variant() != report.variant:
        mi.set_variant(report.variant)
        # Dr.Jit counts the cores of the machine; on one thread Mitsuba's EXR reader would wait for ever.
        if report.variant.startswith("llvm") and max(CORES, 2) < (os.cpu_count() or 1):
            import drjit as dr

            dr.set_thread_count(max(CORES, 2))
    return report


def llvm_libraries() -> Iterator[str]:
    """LLVM libraries to probe, best first; the empty string lets Dr.Jit search by itself."""
    inherited = os.environ.get("DRJIT_LIBLLVM_PATH", "")
    if inherited and llvm_major(inherited) >= OLDEST_LLVM:
        yield inherited
    wheels = [path for path in Path(sys.prefix, "lib").glob("libLLVM.so.[0-9]*") if path.is_file()]
    for path in sorted(wheels, key=lambda path: llvm_major(str(path)), reverse=True):
        if llvm_major(str(path)) >= OLDEST_LLVM and str(path) != inherited:
            yield str(path)
    yield ""


def llvm_major(library: str) -> int:
    """Major version in the name of an LLVM library, links followed; 0 if it has none."""
    found = re.search(r"libLLVM(?:\.so)?[-.](\d+)", Path(library).resolve().name)
    return int(found.group(1)) if found else 0


def _candidates(backend: str | None) -> Iterator[tuple[str, str]]:
    for variant in VARIANTS if backend is None else (backend,):
        if variant == "llvm_ad_mono":
            yield from ((variant, library) for library in llvm_libraries())
        elif variant != "cuda_ad_mono" or backend is not None or _has_nvidia():
            yield variant, ""


def _has_nvidia() -> bool:
    """Whether the machine has an NVIDIA GPU, so that probing CUDA makes sense."""
    return Path("/dev/nvidiactl").exists() or Path("/proc/driver/nvidia/version").exists()


def _reason(chosen: Attempt, attempts: list[Attempt]) -> str:
    if chosen.variant == "scalar_rgb":
        failed = "; ".join(f"{a.variant}: {a.message}" for a in attempts if not a.works) or "asked for"
        return f"scalar_rgb: preview quality only, much slower ({failed}); {_LLVM_CURE}"
    where = f" with {chosen.library}" if chosen.library else ""
    return f"{chosen.variant}{where}: probed, it path traces"


def _remembered_probe(variant: str, library: str) -> Attempt:
    """Probe, or take the result of an earlier process with the same library file and versions."""
    stat = os.stat(library) if library and Path(library).exists() else None
    identity = [variant, library, stat and [stat.st_size, stat.st_mtime_ns], versions(), sys.executable]
    try:
        path = default_folder() / "probes" / f"{hash_of(identity)}.json"
    except ConfigError:
        # Without a cache, probe every time.
        return probe(variant, library)
    try:
        record: Any = read_json(path)
        return Attempt(variant, library, bool(record["works"]), str(record["message"]))
    except (StorageError, KeyError, TypeError):
        attempt = probe(variant, library)
    # Only success is cached: a failure may be cured from outside (a library installed, a driver loaded).
    if attempt.works:
        # An unwritable cache only costs the next process a probe.
        with contextlib.suppress(StorageError, OSError):
            write_json(path, {"works": True, "message": attempt.message})
    return attempt


def probe(variant: str, library: str) -> Attempt:
    """Path trace a few pixels in a subprocess, which may crash without harm."""
    environment = dict(os.environ)
    environment.pop("DRJIT_LIBLLVM_PATH", None)
    if library:
        environment["DRJIT_LIBLLVM_PATH"] = library
    try:
        done = subprocess.run(
            [sys.executable, "-c", _PROBE, variant],
            env=environment,
            capture_output=True,
            text=True,
            timeout=120,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        return Attempt(variant, library, False, str(error))
    if done.returncode != 0:
        lines = [line.strip() for line in done.stderr.splitlines() if line.strip()]
        said = next((line for line in reversed(lines) if "LLVM" in line or "rror" in line), "no message")
        how = f"killed by signal {-done.returncode}" if done.returncode < 0 else "failed"
        return Attempt(variant, library, False, f"{how}: {said[:300]}")
    # Mitsuba shares standard output: a progress bar may stand before our line.
    record = json.loads(done.stdout[done.stdout.rindex(_MARK) + len(_MARK) :])
    if not record["total"] > 0:
        return Attempt(variant, library, False, f"rendered nonsense: a sum of {record['total']}")
    if record["llvm"] and record["llvm"][0] < OLDEST_LLVM:
        return Attempt(variant, library, False, f"LLVM {record['llvm'][0]} is older than {OLDEST_LLVM}")
    return Attempt(variant, library, True, f"LLVM {record['llvm'][0]}" if record["llvm"] else "works")
