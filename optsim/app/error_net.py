"""The last net of the command line: what goes wrong ends in one line and an exit code, not a traceback."""

from __future__ import annotations

import errno
import io
import logging
import os
import sys
import traceback
from collections.abc import Callable

import typer

from optsim.core.errors import OptsimError
from optsim.core.foreign import one_line

BAD_INPUT = 2
# What typer returns for Ctrl-C (128 + SIGINT), and for a reader that went away.
INTERRUPTED, _BROKEN_PIPE = 130, 1
# How libraries that raise no MemoryError say that there is none.
_NO_MEMORY = (
    "cannot allocate",
    "failed to map segment",
    "can't start new thread",
    "bad_alloc",
    "out of memory",
)


def guarded(command: Callable[[], object]) -> int:
    """Run a command line to its end; say in one line what stopped it."""
    for stream in (sys.stdout, sys.stderr):
        # Names of files needn't be UTF-8; to show one must not fail.
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    try:
        status = command()
        if isinstance(sys.stdout, io.TextIOBase):  # there may be none
            sys.stdout.flush()
    except BrokenPipeError:
        # The reader has what it wanted: "optsim list | head -1".
        _leave_stdout()
        return _BROKEN_PIPE
    except Exception as error:
        show: object = getattr(error, "show", None)
        if callable(show):
            # A usage error, of a class that typer keeps in its private copy of click.
            show()
            return int(getattr(error, "exit_code", BAD_INPUT))
        _say(error)
        return BAD_INPUT
    if status == INTERRUPTED:
        _line("interrupted. What is finished is kept; the same command goes on from there.")
    return status if isinstance(status, int) else 0


def _say(error: Exception) -> None:
    expected = isinstance(error, OptsimError)
    text = _text(error)
    if not expected and (os.environ.get("OPTSIM_DEBUG") or logging.getLogger().level <= logging.INFO):
        traceback.print_exception(error)
    if isinstance(error, OSError):
        # It may be standard output that can't be written, and would be tried again at the end.
        _leave_stdout()
    _line(text)


def _text(error: Exception) -> str:
    if isinstance(error, OptsimError):
        return str(error)
    said = (isinstance(error, OSError) and error.strerror) or one_line(error)
    if (
        isinstance(error, MemoryError)
        or (isinstance(error, OSError) and error.errno == errno.ENOMEM)
        or any(sign in said.lower() for sign in _NO_MEMORY)
    ):
        return (
            f"out of memory ({said}); cure: a smaller panel, fewer frames or smaller files, more memory, or "
            "a higher limit (ulimit -v)"
        )
    if isinstance(error, OSError):
        if error.filename is not None:
            # Of a file or folder that somebody named: not to be read, too long a name, a disk that fails.
            name = os.fsdecode(error.filename) if isinstance(error.filename, bytes) else error.filename
            return f"{name}: {said}; choose another place, or mend it"
        if error.errno in (errno.ENOSPC, errno.EFBIG, errno.EDQUOT, errno.EIO):
            return f"cannot write the output: {said}; cure: free space there, or choose another place"
    return (
        f"unexpected error: {type(error).__name__}: {said}; please report it, with what "
        "'optsim -v' shows before the same command"
    )


def _line(text: str) -> None:
    try:
        typer.echo(f"optsim: {text}", err=True)
    except OSError:
        # Nobody can be told.
        return


def _leave_stdout() -> None:
    """Write what may be left for standard output nowhere: to try once more would fail again at exit."""
    try:
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, sys.stdout.fileno())
        os.close(nowhere)
    except (OSError, ValueError, AttributeError):
        return
