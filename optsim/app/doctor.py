"""What was chosen on this machine and why, what is missing, and the cure for each problem."""

from __future__ import annotations

import os
import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from optsim.core.cache import Cache
from optsim.core.compiled import cache_folder
from optsim.core.errors import OptsimError
from optsim.core.files import read_exr, write_exr
from optsim.core.threads import CORES
from optsim.render.backend import choose_backend, versions
from optsim.scene import list_scenes

# A demo's truth is about 0.1 GB, a paper-sized one about 2 GB (measured).
_WANTED_FREE_GB = 3.0


@dataclass(frozen=True)
class Finding:
    """One thing looked at, whether it is as it should be, and the cure if it is not."""

    what: str
    ok: bool
    found: str
    cure: str = ""


def diagnose() -> tuple[Finding, ...]:
    """Look at backend, versions, threads, disk, cache, scenes and an OpenEXR round trip; never raises."""
    return (*_backend(), _versions(), _threads(), _cache(), _compiled(), _disk(), _scenes(), _exr())


def _backend() -> tuple[Finding, ...]:
    try:
        report = choose_backend()
    except OptsimError as error:
        return (_problem("backend", error),)
    library = "install karellen-llvm-core, or a system LLVM >= 17 and set DRJIT_LIBLLVM_PATH to it"
    chosen = Finding("backend", not report.preview, report.reason, library if report.preview else "")
    failed = tuple(
        # A failed attempt before a good one is news, not a problem.
        Finding(f"backend {attempt.variant}", True, f"not used: {attempt.message}")
        for attempt in report.attempts
        if not attempt.works
    )
    return chosen, *failed


def _problem(what: str, error: OptsimError) -> Finding:
    message, _, cure = str(error).rpartition("cure: ")
    return Finding(what, False, message or cure, cure)


def _versions() -> Finding:
    found = versions()
    missing = [name for name, number in found.items() if number == "missing"]
    text = ", ".join(f"{name} {number}" for name, number in found.items())
    return Finding("versions", not missing, text, f"pip install {' '.join(missing)}" if missing else "")


def _threads() -> Finding:
    return Finding("threads", True, f"{CORES} usable of {os.cpu_count()}")


def _cache() -> Finding:
    try:
        cache = Cache()
    except OptsimError as error:
        return _problem("cache", error)
    record = cache.show()
    text = f"{record['entries']} entries, {record['bytes'] / 1e9:.2f} of {cache.cap_bytes / 1e9:g} GB"
    try:
        cache.folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=cache.folder):
            pass
    except OSError as error:
        cure = "set OPTSIM_CACHE to a folder that you can write"
        return Finding("cache", False, f"{cache.folder}: {error.strerror or error}", cure)
    return Finding("cache", True, f"{cache.folder}: {text}")


def _compiled() -> Finding:
    """Whether what numba compiles is kept; else each run compiles anew, half a minute."""
    cure = "set OPTSIM_CACHE to a folder that you can write"
    try:
        folder = cache_folder()
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OptsimError as error:
        return _problem("compiled code", error)
    except OSError as error:
        return Finding("compiled code", False, f"{error.filename or ''}: {error.strerror or error}", cure)
    return Finding("compiled code", True, f"kept in {folder}")


def _disk() -> Finding:
    try:
        folder = Cache().folder.absolute()
    except OptsimError as error:
        return _problem("disk", error)
    place = next(p for p in (folder, *folder.parents) if p.exists())
    free_gb = shutil.disk_usage(place).free / 1e9
    cure = "free disk space, 'optsim cache clear', or set OPTSIM_CACHE to another disk"
    return Finding("disk", free_gb > _WANTED_FREE_GB, f"{free_gb:.1f} GB free at {place}", cure)


def _scenes() -> Finding:
    found = ", ".join(f"{name} ({', '.join(variations)})" for name, variations in list_scenes().items())
    return Finding("scenes", bool(found), found or "none", "install optsim again: its scenes are missing")


def _exr() -> Finding:
    """Write and read an image that the binding gets wrong when it is not C-contiguous (openexr#1929)."""
    image = np.asfortranarray(np.arange(12, dtype=np.float32).reshape(3, 4) ** 5)
    cure = "pip install --force-reinstall 'OpenEXR>=3.4.14'"
    try:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, "round_trip.exr")
            write_exr(path, {"Y": image}, attributes={"unit": "1"})
            back = read_exr(path)[0]["Y"]
    except (OptsimError, ImportError, OSError) as error:
        return Finding("OpenEXR", False, str(error), cure)
    same = np.array_equal(back, image)
    return Finding("OpenEXR", same, "round trip exact" if same else "round trip changes numbers", cure)
