"""Files that others wrote: whatever their readers raise becomes one line that names the file."""

import zlib
from pathlib import Path

import pytest

from optsim.core.errors import ConfigError, StorageError
from optsim.core.foreign import check_memory, reading


@pytest.mark.parametrize(
    ("error", "text"),
    [
        (zlib.error("Error -3 while decompressing\n data"), "Error -3 while decompressing data; cure: "),
        (KeyError("Compression"), "KeyError 'Compression'"),
        (RuntimeError(), "RuntimeError"),
        (RecursionError("too deep"), "too deep"),
        (PermissionError(13, "Permission denied"), "Permission denied"),
        (MemoryError(), "more memory than there is"),
        (StopIteration(), "StopIteration"),
        (UnicodeDecodeError("utf-8", b"\xff", 0, 1, "invalid start byte"), "invalid start byte"),
    ],
)
def test_what_a_reader_raises_names_the_file(error: Exception, text: str) -> None:
    with pytest.raises(StorageError) as caught, reading(Path("shots/7.tif"), "TIFF"):
        raise error
    assert str(caught.value).startswith("shots/7.tif cannot be read as TIFF: ")
    assert text in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_missing_file_is_called_missing() -> None:
    with pytest.raises(StorageError, match=r"^no such file: a\.npy$"), reading(Path("a.npy"), "array"):
        Path("a.npy").read_bytes()


def test_our_own_errors_and_a_stop_pass_as_they_are() -> None:
    for error in (ConfigError("key: wrong"), KeyboardInterrupt()):
        with pytest.raises(type(error)) as caught, reading(Path("a.npy"), "array"):
            raise error
        assert caught.value is error


def test_a_size_beyond_memory_is_refused_before_it_is_allocated() -> None:
    check_memory(Path("a.npy"), 2**20, "array")
    with pytest.raises(StorageError, match=r"a\.npy cannot be read as array: it declares 9\.31e\+08 GiB"):
        check_memory(Path("a.npy"), 1e18, "array")
