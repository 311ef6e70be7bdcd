"""Cache on disk, addressed by content: rendered light is made once and found again by a hash of its inputs.

An entry is a folder of .npy files with a list of their sizes and checksums. It is written under a temporary
name and renamed. An entry that disagrees with its list counts as absent and is made again, so an interrupted
render resumes. Reading is memory-mapped. A cache above its cap loses the entries unused for the longest time.
Entries that a live process uses stay, whatever the cap.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import json
import math
import os
import shutil
import tempfile
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import takewhile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from optsim.core.errors import ConfigError, StorageError
from optsim.core.files import sum_of

DEFAULT_CAP_GB = 20.0
_LIST = "files.json"
Arrays = dict[str, NDArray[Any]]


def hash_of(*parts: object) -> str:
    """Hash anything JSON can express: 40 hex digits, equal for equal parts in every process."""
    text = json.dumps(parts, sort_keys=True, allow_nan=False, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()[:40]


def default_folder() -> Path:
    """``$OPTSIM_CACHE``, else ``optsim`` in the XDG cache folder.

    Raises
    ------
    ConfigError
        When there is no home folder: of the user that it names, or of this one.
    """
    chosen = os.environ.get("OPTSIM_CACHE")
    try:
        if chosen:
            return Path(chosen).expanduser()
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "optsim"
    except RuntimeError as error:
        got = f"got {chosen!r}" if chosen else "not set, and this user has no home folder for a cache"
        raise ConfigError(
            f"OPTSIM_CACHE: {got} ({error}); expected a folder; cure: set OPTSIM_CACHE to one of yours"
        ) from None


def _default_cap_bytes() -> int:
    text = os.environ.get("OPTSIM_CACHE_MAX_GB", str(DEFAULT_CAP_GB))
    try:
        cap_gb = float(text)
    except ValueError:
        cap_gb = -1.0
    if not 0 < cap_gb < 1e9:
        raise ConfigError(
            f"OPTSIM_CACHE_MAX_GB: got {text!r}, expected a number of gigabytes, for example 20"
        )
    return int(cap_gb * 1e9)


@dataclass(frozen=True, eq=False)
class Cache:
    """A cache folder with a size cap.

    Parameters
    ----------
    folder : Path
        Where to keep the entries; made on the first write.
    cap_bytes : float
        Size above which the least recently used entries are removed, from ``$OPTSIM_CACHE_MAX_GB``
        (default 20 GB; no source, sensible default); infinite: none is ever removed.
    """

    folder: Path = field(default_factory=default_folder)
    cap_bytes: float = field(default_factory=_default_cap_bytes)
    _used: set[str] = field(default_factory=lambda: set[str](), repr=False)
    # Bytes on disk as this process knows them; None before the first count.
    _size: list[int] = field(default_factory=lambda: list[int](), repr=False)

    def get(self, key: str, make: Callable[[], Mapping[str, NDArray[Any]]]) -> Arrays:
        """Read an entry, or make, store and read it.

        Parameters
        ----------
        key : str
            Hash of everything that decides the arrays (:func:`hash_of`).
        make : callable
            Returns the arrays by name; called only when the entry is absent.
        """
        if key not in self:
            self._store(key, make())
        return self.read(key)

    def __contains__(self, key: str) -> bool:
        # The caller will use the entry: no other process may evict it from now on.
        self._use(key)
        return _files_of(self._entry(key)) is not None

    def n_first(self, keys: Iterable[str]) -> int:
        """Count the entries that are there, from the first key on, up to one that isn't."""
        return sum(1 for _ in takewhile(self.__contains__, keys))

    def read(self, key: str) -> Arrays:
        """Memory-map an entry's arrays.

        Raises
        ------
        StorageError
            When the entry is not (or no longer) there and whole.
        """
        entry = self._entry(key)
        self._use(key)
        paths = _files_of(entry)
        try:
            if paths is not None:
                return {path.stem: np.load(path, mmap_mode="r") for path in paths}
            what = f"{entry} is damaged" if entry.is_dir() else f"{key} is missing from {self.folder}"
        except (ValueError, EOFError, OSError) as error:
            what = f"{entry} cannot be read ({error})"
        raise StorageError(
            f"cache entry {what}: it was removed or changed while in use; cure: run again, which makes it "
            "anew (or delete this folder first); if several runs share the cache, don't clear it meanwhile"
        )

    def show(self) -> dict[str, Any]:
        """Report where the cache is, its whole entries, and its size and cap in bytes."""
        return {
            "folder": str(self.folder),
            "entries": len(self._entries()),
            "bytes": self._total(),
            "cap_bytes": self.cap_bytes,
        }

    def clear(self) -> int:
        """Remove every entry and every leftover of an interrupted write; return the bytes freed.

        Raises
        ------
        StorageError
            When some of it can't be removed.
        """
        entries, freed = self._entries(), self._total()
        shutil.rmtree(self.folder / "entries", ignore_errors=True)
        self._used.clear()
        self._size.clear()
        # Only these are counted: another run may add entries meanwhile.
        if left := sum(_size(entry) for entry in entries):
            raise StorageError(
                f"{self.folder}: {left / 1e6:.1f} MB can't be removed; cure: make its entries writable"
            )
        return freed

    def _total(self) -> int:
        return sum(_size(path) for path in self._entries())

    def _entry(self, key: str) -> Path:
        return self.folder / "entries" / key[:2] / key

    def _entries(self) -> list[Path]:
        return [path for path in self.folder.glob("entries/??/*") if not path.name.startswith(".")]

    def _store(self, key: str, arrays: Mapping[str, NDArray[Any]]) -> None:
        entry = self._entry(key)
        try:
            entry.parent.mkdir(parents=True, exist_ok=True)
            temporary = Path(tempfile.mkdtemp(prefix=".part-", dir=entry.parent))
        except OSError as error:
            raise StorageError(f"cannot write the cache {self.folder}: {error.strerror or error}") from error
        try:
            for name, array in arrays.items():
                np.save(temporary / f"{name}.npy", np.asarray(array, order="C"))
            listed = {path.name: sum_of(path) for path in temporary.iterdir()}
            (temporary / _LIST).write_text(json.dumps(listed), encoding="utf-8")
            temporary.chmod(0o755)
            if key not in self:
                shutil.rmtree(entry, ignore_errors=True)
            # Another process may have made the same entry meanwhile: then this copy is not needed.
            with contextlib.suppress(OSError):
                temporary.rename(entry)
            if key not in self:
                raise StorageError(f"cannot put {key} into the cache {self.folder}")
        except OSError as error:
            raise StorageError(
                f"cannot write the cache {self.folder}: {error.strerror or error}; cure: free disk space, or "
                "choose another folder with OPTSIM_CACHE or --out"
            ) from error
        finally:
            shutil.rmtree(temporary, ignore_errors=True)
        self._evict(_size(entry))

    def _use(self, key: str) -> None:
        """Note that this process uses an entry; the note holds until the process ends."""
        if key in self._used or self.cap_bytes == math.inf:
            return
        self._used.add(key)
        # A cache that this user may only read still serves.
        with contextlib.suppress(OSError):
            os.write(_notes(self.folder, os.getpid()), f"{key}\n".encode())
            os.utime(self._entry(key))

    def _evict(self, n_new: int) -> None:
        if self.cap_bytes == math.inf:
            return
        if not self._size:
            self._size.append(self._total())
        else:
            self._size[0] += n_new
        if self._size[0] <= self.cap_bytes:
            return
        total = self._total()
        used = self._used | _used_by_the_living(self.folder)
        for entry in sorted(self._entries(), key=_last_use):
            if total <= self.cap_bytes:
                break
            if entry.name not in used:
                total -= _size(entry)
                shutil.rmtree(entry, ignore_errors=True)
        self._size[0] = total


def _files_of(entry: Path) -> list[Path] | None:
    """Files that an entry lists, if all of them are as they were written."""
    try:
        listed = json.loads((entry / _LIST).read_bytes())
        paths = [entry / name for name in listed]
        whole = all(list(sum_of(path)) == listed[path.name] for path in paths)
    except (OSError, ValueError, TypeError):
        return None
    return paths if whole else None


@lru_cache(maxsize=1000)
def _notes(folder: Path, process: int) -> int:
    """Open the file in which a process lists the entries it uses; it stays locked until the process ends."""
    (folder / "users").mkdir(parents=True, exist_ok=True)
    notes, _ = tempfile.mkstemp(prefix=f"{process}-", dir=folder / "users")
    fcntl.flock(notes, fcntl.LOCK_EX)
    return notes


def _used_by_the_living(folder: Path) -> set[str]:
    """Entries in use by processes that still run, this one included."""
    used: set[str] = set()
    for path in folder.glob("users/*"):
        with contextlib.suppress(OSError), path.open(encoding="utf-8") as notes:
            try:
                fcntl.flock(notes, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                used |= set(notes.read().split())
            else:
                path.unlink()
    return used


def _size(entry: Path) -> int:
    try:
        return sum(path.stat().st_size for path in entry.glob("*.npy"))
    except OSError:
        return 0


def _last_use(entry: Path) -> float:
    try:
        return entry.stat().st_mtime
    except OSError:
        return 0.0
