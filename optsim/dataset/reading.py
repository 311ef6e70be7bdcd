"""Reading a data set: ``open_dataset(path).train[0]["radiance"]`` is an array with a unit and axes."""

from __future__ import annotations

import glob
import hashlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, cast, overload

import numpy as np

from optsim.core.errors import StorageError, ValueCheckError, unknown_name
from optsim.core.files import read_exr_header, read_record
from optsim.core.foreign.npz import npy_on_disk
from optsim.dataset.arrays import BY_SCHEME, PASSES, SHARED, Array, Coded, Table, tables
from optsim.dataset.spec import SPLITS, Split

KIND = "optsim data set 1"
_CURE = "cure: copy the data set again, or optsim dataset regenerate"
_KINDS: dict[str, type] = {"path": str, "bytes": int, "sha256": str}
_CARD: dict[str, type] = {"sequences": list, "manifest": dict, "sources": dict, "documents": dict}
_ENTRY: dict[str, type] = {"name": str, "split": str, "seeds": list}
CARD, MANIFEST, ARRAYS = "dataset.json", "manifest.jsonl", "arrays"


@dataclass(frozen=True, eq=False)
class Sample(Mapping[str, Array]):
    """One sequence with one seed: named arrays, read on demand.

    Parameters
    ----------
    folder : Path
        Folder of the sequence.
    seed : int or None
        Seed of the coded frames; None without any.
    about : dict
        The card's entry of the sequence: scene, variation, camera, split.
    listed : set of str
        Its files by the manifest, without its folder; a lost one must not shift the rest. Empty: any.
    """

    folder: Path
    seed: int | None
    about: dict[str, Any]
    listed: frozenset[str] = frozenset()

    def __repr__(self) -> str:
        """Identify the sample."""
        seed = "" if self.seed is None else f", seed {self.seed}"
        return f"<Sample {self.about['name']}{seed}: {', '.join(self)}>"

    @cached_property
    def _names(self) -> tuple[str, ...]:
        held = self._header[0]
        passes = [name for name, each in PASSES.items() if each.channels[0] in held]
        shared = [name for name in SHARED if (self.folder / name).is_dir()]
        coded = [
            f"{kind}/{place.name}"
            for kind, each in BY_SCHEME.items()
            for place in sorted((self._coded / each.files.partition("/")[0]).glob("*"))
            if place.is_dir()
        ]
        held = [f"{kind}/{name}" for kind, table in self._tables.items() for name in table.names()]
        return (*passes, *shared, *coded, *held)

    @cached_property
    def _tables(self) -> dict[str, Table]:
        return tables(self.folder, self._coded)

    def _kind(self, name: str) -> tuple[Coded, list[Path]]:
        """Kind of an array of coded frames, and its files."""
        kind, _, scheme = name.partition("/")
        found = SHARED.get(name) or BY_SCHEME[kind]
        place = self._coded if scheme else self.folder
        return found, self._present(place, found.files.format(glob.escape(scheme)))

    def _present(self, place: Path, pattern: str) -> list[Path]:
        found = sorted(place.glob(pattern))
        return [p for p in found if not self.listed or p.relative_to(self.folder).as_posix() in self.listed]

    @cached_property
    def _slots(self) -> list[Path]:
        others = tuple(f"seed{seed}/" for seed in self.about.get("seeds", []) if seed != self.seed)
        for place in sorted(self.listed):
            if not place.startswith((f"{ARRAYS}/", *others)) and not (self.folder / place).is_file():
                raise StorageError(f"{self.folder / place}: lost, though {MANIFEST} names it; {_CURE}")
        if not (found := self._present(self.folder / "truth", "slot*.exr")):
            raise StorageError(f"{self.folder}: got no slots, expected truth/slot000000.exr; {_CURE}")
        return found

    @cached_property
    def _header(self) -> tuple[list[str], dict[str, Any]]:
        return read_exr_header(self._slots[0])

    @property
    def n_slots(self) -> int:
        """Number of slots of the truth."""
        return len(self._slots)

    @property
    def _coded(self) -> Path:
        return self.folder / f"seed{self.seed}"

    def __iter__(self) -> Iterator[str]:
        """Names of the arrays: passes of the truth, then ``frames/SCHEME`` and so on."""
        return iter(self._names)

    def __len__(self) -> int:
        """Count the arrays."""
        return len(self._names)

    def __getitem__(self, name: str) -> Array:
        """Read an array; memory-mapped where the data set holds it as one file.

        Raises
        ------
        KeyError
            For an unknown name, with the nearest.
        """
        if name not in self._names:
            raise KeyError(str(unknown_name("array", name, list(self._names))))
        kind, _, key = name.partition("/")
        mapped = self.mapped(name)
        if kind in self._tables:
            return npy_on_disk(mapped) if mapped.is_file() else self._tables[kind].read(key)
        each, paths = (PASSES[name], self._slots) if name in PASSES else self._kind(name)
        if mapped.is_file():
            array = npy_on_disk(mapped)
            if len(array) != len(paths):
                raise StorageError(f"{mapped}: got {len(array)} in it, expected {len(paths)}; {_CURE}")
            return array
        arrays = [each.read(path) for path in paths]
        for path, array in zip(paths, arrays, strict=True):
            if array.shape != arrays[0].shape:
                raise StorageError(f"{path}: got shape {array.shape}, expected {arrays[0].shape}; {_CURE}")
        return np.stack(arrays)

    def mapped(self, name: str) -> Path:
        """File of an array in the layout ``npy``, whether it exists or not."""
        shared = name in PASSES or name in SHARED or name.startswith("operator/")
        return self.folder / ARRAYS / (f"{name}.npy" if shared else f"seed{self.seed}/{name}.npy")

    def slot(self, name: str, index: int) -> Array:
        """Read a pass in one slot: (y, x), (y, x, component), or (band, y, x)."""
        return PASSES[name].read(self._slots[index])

    def unit(self, name: str) -> str:
        """Return the unit of an array."""
        return self._meaning(name)[0]

    def axes(self, name: str) -> str:
        """Axes of an array; ``v, u`` are panel pixels, ``y, x`` fine samples of the truth or CCD pixels."""
        return self._meaning(name)[1]

    def _meaning(self, name: str) -> tuple[str, str]:
        kind, _, key = name.partition("/")
        if kind in self._tables:
            return self._tables[kind].meaning(key)
        said = PASSES[name] if name in PASSES else self._kind(name)[0]
        return said.unit, said.axes

    @cached_property
    def camera(self) -> dict[str, Array]:
        """Lens and poses: ``intrinsics_px``, ``radial_k1``, ``camera_to_world`` (slot, 4, 4), ``times_s``."""
        headers = [read_exr_header(path)[1] for path in self._slots]
        return {
            "intrinsics_px": np.array(headers[0]["intrinsics_px"]),
            "radial_k1": np.array(headers[0]["radial_k1"]),
            "camera_to_world": np.array([header["camera_to_world"][1] for header in headers]),
            "times_s": np.array([header["times_s"][1] for header in headers]),
        }

    @cached_property
    def wavelengths_nm(self) -> dict[str, float]:
        """Band -> wavelength of each band in ``colour``; empty without colour."""
        return self._header[1].get("further", {}).get("colour", {}).get("wavelength_nm", {})

    @cached_property
    def objects(self) -> dict[int, str]:
        """Object id -> name."""
        return {int(number): name for number, name in self._header[1]["id_table"].items()}

    def labels(self, index: int) -> dict[int, dict[str, Any]]:
        """Object id -> name, category, boxes and visibility in a slot, see ``conventions`` in its file."""
        found = read_exr_header(self._slots[index])[1].get("objects", {})
        return {int(number): each for number, each in found.items()}


@dataclass(frozen=True, eq=False)
class Samples(Sequence[Sample]):
    """Samples of a split, in the order of the card."""

    samples: tuple[Sample, ...] = field(repr=False)

    @overload
    def __getitem__(self, index: int) -> Sample: ...
    @overload
    def __getitem__(self, index: slice) -> Samples: ...
    def __getitem__(self, index: int | slice) -> Sample | Samples:
        """Return one sample, or some."""
        return Samples(self.samples[index]) if isinstance(index, slice) else self.samples[index]

    def __len__(self) -> int:
        """Count the samples."""
        return len(self.samples)

    def torch(self, *names: str, transform: Callable[[dict[str, Any]], Any] | None = None) -> Any:
        """Return a PyTorch ``Dataset`` of dicts of tensors."""
        try:
            import torch  # pyright: ignore
        except ImportError:
            raise ValueCheckError("torch: got no PyTorch; cure: pip install torch") from None
        samples, pytorch = self.samples, cast("Any", torch)

        class _Torch(pytorch.utils.data.Dataset[Any]):  # pyright: ignore
            def __len__(self) -> int:
                return len(samples)

            def __getitem__(self, index: int) -> Any:
                sample = samples[index]
                arrays = {name: np.array(sample[name]) for name in names or sample}
                # PyTorch supports few unsigned types.
                signed = {
                    name: a.astype(np.int64) if a.dtype.kind == "u" else a for name, a in arrays.items()
                }
                tensors: dict[str, Any] = {name: pytorch.from_numpy(array) for name, array in signed.items()}
                return tensors if transform is None else transform(tensors)

        return _Torch()


@dataclass(frozen=True, eq=False)
class Dataset:
    """A data set on disk.

    Parameters
    ----------
    folder : Path
        Its folder.
    card : dict
        Content of ``dataset.json``.
    """

    folder: Path
    card: dict[str, Any] = field(repr=False)

    @cached_property
    def _listed(self) -> dict[str, frozenset[str]]:
        """Files of each sequence, from its folder on."""
        found: dict[str, set[str]] = {about["name"]: set() for about in self.card["sequences"]}
        for record in manifest(self.folder):
            name = "/".join(record["path"].split("/")[:2])
            if name in found:
                found[name].add(record["path"].removeprefix(f"{name}/"))
        # A line that is lost would shift the rest; Windows' ends of lines wouldn't.
        content = (self.folder / MANIFEST).read_bytes().replace(b"\r\n", b"\n")
        if hashlib.sha256(content).hexdigest() != self.card["manifest"].get("sha256"):
            raise StorageError(f"{self.folder / MANIFEST}: changed since {CARD} was written; {_CURE}")
        return {name: frozenset(places) for name, places in found.items()}

    def samples(self, split: Split) -> Samples:
        """Return the samples of a split: each sequence once a seed."""
        found = [
            Sample(self.folder / about["name"], seed, about, self._listed[about["name"]])
            for about in self.card["sequences"]
            if about["split"] == split
            for seed in about["seeds"] or [None]
        ]
        return Samples(tuple(found))

    @property
    def train(self) -> Samples:
        """Samples for training."""
        return self.samples("train")

    @property
    def val(self) -> Samples:
        """Samples for choosing between models."""
        return self.samples("val")

    @property
    def test(self) -> Samples:
        """Samples for reported results."""
        return self.samples("test")

    def __repr__(self) -> str:
        """Summarise the content."""
        counts = ", ".join(f"{len(self.samples(split))} {split}" for split in SPLITS)
        return f"<Dataset {self.card['name']!r} in {self.folder}: {counts}>"


def open_dataset(path: str | Path) -> Dataset:
    """Open a data set that ``optsim dataset build`` made.

    Parameters
    ----------
    path : str or Path
        Its folder.

    Returns
    -------
    Dataset
        With the splits ``train``, ``val`` and ``test``; only the card is read yet.

    Raises
    ------
    StorageError
        When there is none, it isn't finished, or it is of another version.
    """
    folder = Path(path)
    if not (folder / CARD).is_file():
        raise StorageError(
            f"{folder}: got no {CARD}, expected a finished data set; "
            f"cure: optsim dataset build SPEC --out {folder}"
        )
    card = read_record(folder / CARD)
    if card.get("kind") != KIND:
        raise StorageError(
            f"{folder / CARD}: got {card.get('kind')!r}, expected {KIND!r}; "
            "cure: the version of optsim that made it"
        )
    whole = _holds({"sources": {}, "documents": {}, **card}, _CARD)
    if not whole or not all(_holds(entry, _ENTRY) for entry in card["sequences"]):
        raise StorageError(
            f"{folder / CARD}: got no list of sequences with a manifest, expected one; {_CURE}"
        )
    return Dataset(folder, card)


def _holds(record: Any, kinds: Mapping[str, type]) -> bool:
    return isinstance(record, dict) and all(isinstance(record.get(k), kinds[k]) for k in kinds)  # pyright: ignore


def manifest(folder: Path) -> list[dict[str, Any]]:
    """Read and check the manifest: ``path``, ``bytes``, ``sha256`` of each file inside the set."""
    path = folder / MANIFEST
    cure = "expected an object with path, bytes and sha256 of a file in it a line; cure: copy it again"
    try:
        records: list[Any] = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    except (OSError, ValueError, RecursionError) as error:
        raise StorageError(f"{path}: got {error}, {cure}") from None
    for number, record in enumerate(records, start=1):
        whole = _holds(record, _KINDS) and len(record["path"]) < 1000
        if not whole or (place := Path(record["path"])).is_absolute() or ".." in place.parts:
            raise StorageError(f"{path}, line {number}: got {json.dumps(record)[:80]}, {cure}")
    return records
