"""Make the environments in which reference packages run; they never enter optsim's own.

A reference package is a separate program here: started as a process, files in, files or JSON out. None of its
code is imported by or copied into optsim, so neither its pins nor its licence bind optsim. Its pins, with
hashes, are ``validation/<effect>/requirements.txt``; a package that has no wheel is built with the pinned
tools of ``build.txt`` beside it. Run as a program this makes all of them.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import sys
from pathlib import Path

from optsim.core.errors import StorageError

# Pythons that the pinned packages have wheels for; the nearest to optsim's own is taken.
_PYTHONS: dict[str, tuple[tuple[int, int], ...]] = {
    # Package emva1288: LGPL-3.0 by its metadata (its file headers say GPL). It needs a numpy before 2.
    "emva1288": ((3, 11), (3, 12)),
    # Package prysm: MIT.
    "field_psf": ((3, 11), (3, 12), (3, 13), (3, 14)),
    # Package sewar: MIT; package permetrics: GPL-3.0.
    "scores": ((3, 11), (3, 12), (3, 13), (3, 14)),
}


def reference_python(effect: str) -> Path:
    """Interpreter of an effect's environment, which is made when it is missing or its pins have changed.

    Parameters
    ----------
    effect : str
        Folder of the validation.

    Raises
    ------
    StorageError
        When it cannot be made: no Python that fits, or the pinned packages cannot be installed.
    """
    folder = Path(__file__).parent / effect
    venv = folder / ".venv"  # ignored by git
    python, stamp = venv / "bin" / "python", venv / ".ready"
    pins = [p for p in (folder / "build.txt", folder / "requirements.txt") if p.is_file()]
    wanted = hashlib.sha256(b"".join(p.read_bytes() for p in pins)).hexdigest()
    if python.exists() and stamp.is_file() and stamp.read_text() == wanted:
        return python
    pythons = _PYTHONS[effect]
    names = [f"{major}.{minor}" for major, minor in pythons]
    base, uv = _base_python(pythons), shutil.which("uv")
    if uv:
        _call(effect, [uv, "venv", "--quiet", "--clear", "--python", base or names[-1], str(venv)])
        install = [uv, "pip", "install", "--quiet", "--python", str(python)]
    elif base:
        _call(effect, [base, "-m", "venv", "--clear", str(venv)])
        install = [str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    else:
        raise StorageError(
            f"validation {effect} needs one of Python {', '.join(names)} beside optsim's own, found none. "
            f"Cure (Debian, Ubuntu): apt-get install python{names[0]} python{names[0]}-venv, or install uv."
        )
    for file in pins:
        _call(effect, [*install, "--no-deps", "--no-build-isolation", "--require-hashes", "-r", str(file)])
    stamp.write_text(wanted)
    return python


def _base_python(pythons: tuple[tuple[int, int], ...]) -> str | None:
    """First interpreter that can run the pinned packages."""
    if sys.version_info[:2] in pythons:
        return sys.executable
    for major, minor in pythons:
        found = shutil.which(f"python{major}.{minor}")
        # A launcher may have the name without the interpreter.
        if found and subprocess.run([found, "-c", ""], capture_output=True, check=False).returncode == 0:
            return found
    return None


def _call(effect: str, command: list[str]) -> None:
    # Nothing of optsim's environment may reach the other one.
    clean = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV")}
    done = subprocess.run(command, capture_output=True, text=True, env=clean, check=False)
    if done.returncode:
        raise StorageError(
            f"validation {effect} cannot make its environment: '{' '.join(command[:4])} ...' failed: "
            f"{done.stderr.strip()[-400:]} Cure: run 'optsim validate {effect}' once with a network (or a "
            "mirror of the packages); most other validations need none: 'optsim validate NAME ...'."
        )


if __name__ == "__main__":
    for name in _PYTHONS:
        print(reference_python(name))
