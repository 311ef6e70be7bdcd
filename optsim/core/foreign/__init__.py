"""Readers of files from other programs: their errors become one message with the file's name.

No exception of a foreign reader reaches a user. Nothing is allocated because a header alone demands it.
"""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

from optsim.core.errors import OptsimError, StorageError
from optsim.core.memory import available_bytes

# Largest expansion in zlib's format: no valid file exceeds this times its compressed bytes.
DEFLATE_LIMIT = 1032


@contextmanager
def reading(
    path: Path, what: str, cure: str = "copy it again, whole, or write it anew"
) -> Generator[None, None, None]:
    """Turn any exception of a foreign reader into one line that names the file.

    Keep the block as short as the reader's own calls: an error of ours would be called one of the file.

    Parameters
    ----------
    path : Path
        The file that is read.
    what : str
        Expected format: "PNG", "a MATLAB file".
    cure : str
        Remedy, printed after the reader's reason.

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
    """Put an exception's text into one line; its type name where it has no text."""
    text = " ".join(str(error).split())
    if len(text) > 200:
        text = text[:200] + "..."
    # The text of a KeyError or IndexError means little without the type name.
    return text if text and not isinstance(error, LookupError) else f"{type(error).__name__} {text}".strip()


@contextmanager
def any_size() -> Generator[None, None, None]:
    """Let Pillow open a picture of any number of pixels: its limit knows nothing of memory."""
    from PIL import Image

    before, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, None
    try:
        yield
    finally:
        Image.MAX_IMAGE_PIXELS = before


def check_memory(
    path: Path,
    n_bytes: float,
    what: str,
    *,
    said: str = "it declares",
    cure: str = "a smaller file, or correct its header",
) -> None:
    """Refuse a size declared in a header that memory can't hold, before anything is allocated.

    Raises
    ------
    StorageError
        With both sizes.
    """
    there = available_bytes()
    if n_bytes > there:
        raise StorageError(
            f"{path} cannot be read as {what}: {said} {_gib(n_bytes)}, expected at most the "
            f"{_gib(there)} of memory that are free; cure: {cure}"
        )


def _gib(n_bytes: float) -> str:
    return f"{n_bytes / 2**30:.3g} GiB"
