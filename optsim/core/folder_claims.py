"""Claims: one process at a time writes into a folder or file, and claims it before its work.

A claim is a system lock on a hidden file. It ends with its process, so a killed run blocks no other. On a
file system without locks the process named in the file decides.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import itertools
import os
import socket
from collections.abc import Generator
from datetime import UTC, datetime
from pathlib import Path

from optsim.core.errors import StorageError
from optsim.core.files import CLAIM, check_empty

RUNS = Path("reports") / "runs"
_NO_LOCKS = (errno.ENOSYS, errno.ENOTSUP, errno.ENOLCK)


@contextlib.contextmanager
def claimed(folder: Path) -> Generator[None, None, None]:
    """Make a folder and hold it for this process; at the end it is removed if empty.

    Parameters
    ----------
    folder : Path
        New or existing; its content is not checked.

    Raises
    ------
    StorageError
        When another process holds it, or nothing can be written there.
    """
    with _made(folder), _held(folder / CLAIM, folder):
        yield


@contextlib.contextmanager
def claimed_empty(folder: Path) -> Generator[None, None, None]:
    """Make a folder, or take an empty one, and hold it; errors as of :func:`claimed`, and one for content."""
    with claimed(folder):
        check_empty(folder)
        yield


@contextlib.contextmanager
def claimed_file(path: Path) -> Generator[None, None, None]:
    """Hold a file that will be written, and make its folder; errors as of :func:`claimed`."""
    with _made(path.parent), _held(path.with_name(f"{CLAIM}-{path.name}"), path):
        yield


def free_folder(name: str) -> Path:
    """Choose an unused folder name among the runs, from a label and the time (UTC)."""
    first = RUNS / f"{name}-{datetime.now(UTC).strftime('%Y%m%dT%H%M%SZ')}"
    others = (first.with_name(f"{first.name}-{number}") for number in itertools.count(2))
    return next(folder for folder in itertools.chain([first], others) if not os.path.lexists(folder))


@contextlib.contextmanager
def output_folder(out: Path | None, name: str) -> Generator[Path, None, None]:
    """Yield the requested folder, or make a new one among the runs that no other process gets.

    Parameters
    ----------
    out : Path or None
        The requested folder; it is not touched here.
    name : str
        Label of a new one (:func:`free_folder`); at the end it is removed if empty.
    """
    if out is not None:
        yield out
        return
    with _made(RUNS):
        while True:
            folder = free_folder(name)
            try:
                folder.mkdir()
                break
            except FileExistsError:
                # Another process was quicker: the next name.
                continue
            except OSError as error:
                raise _cannot_write(folder, error) from None
        try:
            yield folder
        finally:
            with contextlib.suppress(OSError):
                folder.rmdir()


@contextlib.contextmanager
def _made(folder: Path) -> Generator[None, None, None]:
    """Make a folder; at the end remove it, and the parents made for it, if they are empty."""
    missing = [each for each in (folder, *folder.parents) if not each.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except FileExistsError:
        raise StorageError(f"{folder} is a file, expected a folder; choose another place") from None
    except OSError as error:
        raise _cannot_write(folder, error) from None
    try:
        yield
    finally:
        with contextlib.suppress(OSError):
            for each in missing:
                each.rmdir()


@contextlib.contextmanager
def _held(path: Path, what: Path) -> Generator[None, None, None]:
    while True:
        try:
            lock = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        except OSError as error:
            raise _cannot_write(what, error) from None
        try:
            owner = os.read(lock, 1000).decode(errors="replace")
            if not _locked(lock, owner):
                raise StorageError(
                    f"{what} is being written by {owner or 'another process'}; cure: wait for it, or choose "
                    "another place with --out"
                )
            # The owner before may have removed the file between our opening and locking it.
            if path.exists() and os.path.samestat(os.fstat(lock), path.stat()):
                os.ftruncate(lock, 0)
                os.pwrite(lock, f"process {os.getpid()} on {socket.gethostname()}".encode(), 0)
                try:
                    yield
                finally:
                    path.unlink(missing_ok=True)
                return
        finally:
            os.close(lock)


def _locked(lock: int, owner: str) -> bool:
    """Lock an open file, or say that another process has."""
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError as error:
        if error.errno not in _NO_LOCKS:
            raise
        return not _alive(owner)
    return True


def _alive(owner: str) -> bool:
    """Whether the process named in a claim may still run; on another host this is unknown."""
    number, _, host = owner.removeprefix("process ").partition(" on ")
    return bool(owner) and (host != socket.gethostname() or Path("/proc", number).exists())


def _cannot_write(what: Path, error: OSError) -> StorageError:
    return StorageError(f"cannot write {what}: {error.strerror or error}; choose another place with --out")
