"""Files that others wrote: one place where what their readers raise becomes a message with the file's name.

No exception of a foreign reader reaches a user, and nothing is allocated on the word of a header alone.
"""

from __future__ import annotations

import resource
from collections.abc import Generator
from contextlib import contextmanager, suppress
from pathlib import Path

from optsim.core.errors import OptsimError, StorageError

# What zlib's format can do at most: no honest file is larger than this times its compressed bytes.
DEFLATE_LIMIT = 1032


@contextmanager
def reading(
    path: Path, what: str, cure: str = "copy it again, whole, or write it anew"
) -> Generator[None, None, None]:
    """Turn whatever a reader of others' files raises into one line that names the file.

    Keep the block as short as the reader's own calls: an error of ours would be called one of the file.

    Parameters
    ----------
    path : Path
        The file that is read.
    what : str
        What it is read as: "PNG", "a MATLAB file".
    cure : str
        What to do about it, with the reader's reason before it.

    Raises
    ------
    StorageError
        For every exception but this package's own, which pass as they are.
    """
    try:
        yield
    except OptsimError:
        raise
    except (FileNotFoundError, NotADirectoryError):
        raise StorageError(f"no such file: {path}") from None
    except OSError as error:
        why = error.strerror or f"{one_line(error)}; cure: {cure}"
        raise StorageError(f"{path} cannot be read as {what}: {why}") from None
    except MemoryError:
        raise StorageError(
            f"{path} cannot be read as {what}: it needs more memory than there is; cure: a smaller "
            "file, or more memory"
        ) from None
    except Exception as error:
        raise StorageError(f"{path} cannot be read as {what}: {one_line(error)}; cure: {cure}") from None


def one_line(error: BaseException) -> str:
    """Say in one line what an exception says; its name where it says nothing."""
    text = " ".join(str(error).split())
    if len(text) > 200:
        text = text[:200] + "..."
    # A KeyError or an IndexError says next to nothing without its name.
    return text if text and not isinstance(error, LookupError) else f"{type(error).__name__} {text}".strip()


def check_memory(path: Path, n_bytes: float, what: str) -> None:
    """Refuse a size that a header declares and memory can't hold, before anything is allocated.

    Raises
    ------
    StorageError
        With both sizes.
    """
    there = _available_bytes()
    if n_bytes > there:
        raise StorageError(
            f"{path} cannot be read as {what}: it declares {_gib(n_bytes)}, expected at most the "
            f"{_gib(there)} of memory that are free; cure: a smaller file, or correct its header"
        )


def _available_bytes() -> float:
    """Memory that could be allocated: what the machine has free, the container's and the process's limits."""
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    allowed = (
        float("inf") if limit == resource.RLIM_INFINITY else limit - _kib("/proc/self/status", "VmSize:", 0)
    )
    # The container's limit as a whole: its use counts cached files too, which give way.
    found = [allowed, _kib("/proc/meminfo", "MemAvailable:", float("inf"))]
    for path in ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes"):
        # Absent, or "max".
        with suppress(OSError, ValueError):
            found.append(float(Path(path).read_text(encoding="ascii")))
    return max(0.0, min(found))


def _kib(path: str, key: str, otherwise: float) -> float:
    """Bytes of a line such as "VmSize: 123 kB"."""
    with suppress(OSError):
        for line in Path(path).read_text(encoding="ascii", errors="replace").splitlines():
            if line.startswith(key):
                return 1024 * float(line.split()[1])
    return otherwise


def _gib(n_bytes: float) -> str:
    return f"{n_bytes / 2**30:.3g} GiB"
