"""A virtual bench on disk: taken setting by setting, so that a stopped laboratory goes on where it was."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

from numpy.random import PCG64, Generator, SeedSequence

from optsim import __version__
from optsim.calibration.bench import Bench, manifest
from optsim.calibration.bench_images import write_group, write_images
from optsim.calibration.choice import BENCH_FILE
from optsim.camera.camera import CodedCamera
from optsim.camera.laboratory import ALL_FRAMES, Frames, bench_settings, planned_shots
from optsim.core.cache import hash_of
from optsim.core.code_hash import hash_files
from optsim.core.errors import StorageError
from optsim.core.files import holds_nothing, read_record, write_json
from optsim.core.folder_claims import claimed
from optsim.core.progress import Progress, silent

UNFINISHED = "unfinished.json"
"""Manifest so far, with the state of the noise; gone when the bench is done."""
_SINGLE = ("off", "saturated")


def take_bench(
    camera: CodedCamera,
    rng: Generator,
    folder: Path,
    *,
    about: Mapping[str, Any],
    frames: Frames = ALL_FRAMES,
    suffix: str = "png",
    progress: Progress = silent,
) -> bool:
    """Take a bench into a folder; the images are those of :func:`measure_bench`, bit by bit.

    Parameters
    ----------
    camera : CodedCamera
        The camera, with its true parameters.
    rng : Generator
        Generator of all noise, at its start: one of ``numpy.random.default_rng``.
    folder : Path
        New, empty, or of the same bench, which then goes on.
    about : mapping
        Notes of the manifest.
    frames : Frames
        How many images.
    suffix : str
        Format of the images: "png" or "tiff".
    progress : Progress
        Told after each setting.

    Returns
    -------
    bool
        False if the folder held this bench already.

    Raises
    ------
    StorageError
        When the folder holds anything else, or the disk refuses.
    """
    # Other code may take other images.
    code = hash_files(["optsim/**/*.py"])
    counts = vars(frames) | {"delays": [*frames.delays]}
    key = hash_of(camera.model_dump(mode="json"), _state(rng), counts, suffix, code)
    with claimed(folder):
        begun = _begun(folder, key)
        if begun is None:
            return False
        done: int = begun.get("done", 0)
        # Sets that this laboratory does not take are there, and empty.
        tables: dict[str, Any] = begun.get("tables") or {n: [] for n in Bench.SETS if n not in _SINGLE}
        rng = _generator(begun.get("noise", _state(rng)))
        planned = planned_shots(camera, rng, frames, done)
        for index, (name, take) in enumerate(planned[done:], done):
            group = take()
            if name == "darks":
                tables[name] = write_images(folder, "dark", group.dn, suffix)
            elif name in _SINGLE:
                tables[name] = write_group(folder, name, group, suffix)
            else:
                stem = f"{name}-{len(tables[name]):02d}"
                tables[name].append(write_group(folder, stem, group, suffix))
            record = {"key": key, "done": index + 1, "noise": _state(rng), "tables": tables}
            write_json(folder / UNFINISHED, record)
            progress("bench", index + 1, len(planned))
        settings = bench_settings(camera) | {"about": {**about, "optsim": __version__, "key": key}}
        write_json(folder / BENCH_FILE, manifest(settings, tables))
        (folder / UNFINISHED).unlink()
    return True


def _begun(folder: Path, key: str) -> dict[str, Any] | None:
    """Read how far a folder's bench is: an empty record at the start, None if it is done."""
    if (folder / BENCH_FILE).is_file():
        about: object = read_record(folder / BENCH_FILE).get("about")
        if isinstance(about, dict) and cast("dict[str, Any]", about).get("key") == key:
            return None
    elif (folder / UNFINISHED).is_file():
        record = read_record(folder / UNFINISHED)
        if record.get("key") == key:
            return record
    elif holds_nothing(folder):
        return {}
    raise StorageError(
        f"--out {folder}: got a folder with other files or another bench, expected a new or empty one, or "
        "this bench; cure: choose another folder, or give the same experiment, seed and options"
    )


def _state(rng: Generator) -> dict[str, Any]:
    """State of a generator and of the seed that its children come from, as JSON holds it."""
    bits = rng.bit_generator
    return {"bits": bits.state, "seed": cast("SeedSequence", bits.seed_seq).state}


def _generator(state: dict[str, Any]) -> Generator:
    """Return the generator of a state."""
    bits = PCG64(SeedSequence(**state["seed"]))
    bits.state = state["bits"]
    return Generator(bits)
