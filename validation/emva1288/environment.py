"""Make the environment in which the reference implementation of EMVA 1288 runs; it never enters optsim's own.

The package is under the LGPL-3.0 by its metadata (its file headers say GPL). It is a separate program here:
started as a process, images and a descriptor in, JSON out. None of its code is imported by or copied into
optsim.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import sys
from pathlib import Path

from optsim.errors import StorageError

_HERE = Path(__file__).parent
_VENV = _HERE / ".venv"  # ignored by git
_PINS = _HERE / "requirements.txt"
# The pinned numpy has wheels for these; optsim itself also runs on later ones.
_PYTHONS = ((3, 11), (3, 12))


def reference_python() -> Path:
    """Interpreter of the reference environment, which is made when it is missing or its pins have changed.

    Raises
    ------
    StorageError
        When it cannot be made: no Python 3.11 or 3.12, or the pinned packages cannot be installed.
    """
    python = _VENV / "bin" / "python"
    stamp = _VENV / ".ready"
    pins = hashlib.sha256(_PINS.read_bytes()).hexdigest()
    if python.exists() and stamp.is_file() and stamp.read_text() == pins:
        return python
    base, uv = _base_python(), shutil.which("uv")
    if uv:
        _call([uv, "venv", "--quiet", "--clear", "--python", base or "3.12", str(_VENV)])
        install = [uv, "pip", "install", "--quiet", "--python", str(python)]
    elif base:
        _call([base, "-m", "venv", "--clear", str(_VENV)])
        install = [str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    else:
        raise StorageError(
            "validation emva1288 needs Python 3.11 or 3.12 beside optsim's own, found neither. "
            "Cure (Debian, Ubuntu): apt-get install python3.11 python3.11-venv, or install uv."
        )
    _call([*install, "--no-deps", "--require-hashes", "-r", str(_PINS)])
    stamp.write_text(pins)
    return python


def _base_python() -> str | None:
    """First interpreter that can run the pinned numpy."""
    if sys.version_info[:2] in _PYTHONS:
        return sys.executable
    for major, minor in _PYTHONS:
        found = shutil.which(f"python{major}.{minor}")
        # A launcher may have the name without the interpreter.
        if found and subprocess.run([found, "-c", ""], capture_output=True, check=False).returncode == 0:
            return found
    return None


def _call(command: list[str]) -> None:
    # Nothing of optsim's environment may reach the other one.
    clean = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV")}
    done = subprocess.run(command, capture_output=True, text=True, env=clean, check=False)
    if done.returncode:
        raise StorageError(
            f"validation emva1288 cannot make its environment {_VENV}: '{' '.join(command[:4])} ...' failed: "
            f"{done.stderr.strip()[-400:]} Cure: run 'optsim validate emva1288' once with a network (or a "
            "mirror of the packages); the other validations need none: 'optsim validate NAME ...'."
        )


if __name__ == "__main__":
    print(reference_python())
