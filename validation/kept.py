"""What a long measurement found is kept until its experiment, the code or a library changes."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from optsim.core.errors import OptsimError
from optsim.core.files import read_json, write_json
from optsim.experiment.experiment import Experiment
from optsim.experiment.job import versions
from optsim.experiment.resume import run_key


def kept(path: Path, experiment: Experiment, measure: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """Recall what was found, or measure and keep it.

    Parameters
    ----------
    path : Path
        JSON file to keep it in.
    experiment : Experiment
        With the code and the libraries, what decides the numbers.
    measure : callable
        Finds anything JSON can say.
    """
    key = run_key(experiment, versions())
    before: dict[str, Any] = {}
    with suppress(OptsimError):
        before = read_json(path)
    if before.get("key") == key:
        return before["found"]
    found = measure()
    write_json(path, {"key": key, "found": found})
    return found
