"""Content-addressed cache on disk: an entry is a folder of .npy files, named by a hash of what made it.

An entry is written under a temporary name and renamed, so it is either whole or absent: an interrupted render
resumes by finding what is there. Reading is memory-mapped. When the cache grows over its cap, the entries
not used for the longest time go first; entries used by this process stay, whatever the cap.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from optsim.errors import ConfigError, StorageError

DEFAULT_CAP_GB = 20.0
Arrays = dict[str, NDArray[Any]]


def hash_of(*parts: object) -> str:
    """Hash of anything JSON can say: 40 hex digits; equal parts give equal hashes in every process."""
    text = json.dumps(parts, sort_keys=True, allow_nan=False, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()[:40]


def default_folder() -> Path:
    """``$OPTSIM_CACHE``, else ``optsim`` in the XDG cache folder."""
    chosen = os.environ.get("OPTSIM_CACHE")
    if chosen:
        return Path(chosen).expanduser()
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "optsim"


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
    cap_bytes : int
        Size above which the least recently used entries are removed, from ``$OPTSIM_CACHE_MAX_GB``
        (default 20 GB; no source, sensible default).
    """

    folder: Path = field(default_factory=default_folder)
    cap_bytes: int = field(default_factory=_default_cap_bytes)
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
        return self._entry(key).is_dir()

    def read(self, key: str) -> Arrays:
        """Memory-map an entry's arrays.

        Raises
        ------
        StorageError
            When the entry is not (or no longer) there, or a file in it is damaged.
        """
        entry = self._entry(key)
        try:
            # The folder's time says when it was last used; another process may be removing it.
            if key not in self._used:
                os.utime(entry)
                self._used.add(key)
            return {path.stem: np.load(path, mmap_mode="r") for path in sorted(entry.glob("*.npy"))}
        except FileNotFoundError:
            raise StorageError(
                f"cache entry {key} is missing from {self.folder}: it was removed while in use; cure: run "
                "again, and raise OPTSIM_CACHE_MAX_GB if several runs share this cache"
            ) from None
        except (ValueError, EOFError, OSError) as error:
            raise StorageError(
                f"cache entry {entry} is damaged ({error}); cure: delete this folder"
            ) from error

    def show(self) -> dict[str, Any]:
        """Where the cache is, its whole entries, and its size and cap in bytes."""
        return {
            "folder": str(self.folder),
            "entries": len(self._entries()),
            "bytes": self._total(),
            "cap_bytes": self.cap_bytes,
        }

    def clear(self) -> int:
        """Remove every entry and every leftover of an interrupted write; return the bytes freed."""
        freed = self._total()
        shutil.rmtree(self.folder / "entries", ignore_errors=True)
        self._used.clear()
        self._size.clear()
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
                np.save(temporary / f"{name}.npy", np.ascontiguousarray(array))
            temporary.chmod(0o755)
            # Another process may have made the same entry meanwhile: then ours is the spare.
            with contextlib.suppress(FileExistsError, OSError):
                temporary.rename(entry)
            if not entry.is_dir():
                raise StorageError(f"cannot put {entry.name} into the cache {self.folder}")
        except OSError as error:
            raise StorageError(
                f"cannot write the cache {self.folder}: {error.strerror or error}; cure: free disk space, or "
                "choose another folder with OPTSIM_CACHE"
            ) from error
        finally:
            shutil.rmtree(temporary, ignore_errors=True)
        self._used.add(key)
        self._evict(_size(entry))

    def _evict(self, n_new: int) -> None:
        if not self._size:
            self._size.append(self._total())
        else:
            self._size[0] += n_new
        if self._size[0] <= self.cap_bytes:
            return
        total = self._total()
        for entry in sorted(self._entries(), key=_last_use):
            if total <= self.cap_bytes:
                break
            if entry.name not in self._used:
                total -= _size(entry)
                shutil.rmtree(entry, ignore_errors=True)
        self._size[0] = total


def _size(entry: Path) -> int:
    try:
        return sum(path.stat().st_size for path in entry.iterdir())
    except FileNotFoundError:
        return 0


def _last_use(entry: Path) -> float:
    try:
        return entry.stat().st_mtime
    except FileNotFoundError:
        return 0.0
