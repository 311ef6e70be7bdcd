"""Errors that a user can cause, and when to raise each.

=====================  ==================================================================
raise                  when
=====================  ==================================================================
ConfigError            a key, name, unit or range in an experiment or on the command line
GeometryError          the parts are each valid but don't fit together
ValueCheckError        an array crossing a room breaks its contract (rank, dtype, NaN, sign)
BenchError             bench files are missing, or cannot identify a parameter
BackendError           no usable renderer backend
StorageError           disk space, an unreadable file, an output folder of another run
=====================  ==================================================================

A message names the key and says what is wrong: value got, value expected, and the cure.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Sequence


class OptsimError(Exception):
    """Base of all errors caused by input; the command line turns it into exit code 2."""


class ConfigError(OptsimError):
    """A configuration key, name, unit or range is wrong."""


class GeometryError(OptsimError):
    """Parts that are each valid don't fit together."""


class ValueCheckError(OptsimError, ValueError):
    """An array breaks the contract of the value it should become."""


class BenchError(OptsimError):
    """Bench files are missing or cannot identify a parameter."""


class BackendError(OptsimError):
    """No renderer backend is usable."""


class StorageError(OptsimError):
    """Disk space is short, a file is unreadable, or a folder belongs to another run."""


def unknown_name(what: str, got: str, valid: Iterable[str], meant: str | None = None) -> ConfigError:
    """Make the error for a name outside a list; its cure is the name meant, or else the nearest."""
    names = sorted(valid)
    near = meant or nearest_name(names, got)
    cure = f"did you mean {near!r}?" if near else "choose one of the names listed."
    return ConfigError(f"unknown {what} {got!r}; expected one of: {', '.join(names)}; {cure}")


def nearest_name(names: Sequence[str], got: str, alike: float = 0.4) -> str | None:
    """Find the name that was probably meant; None if none is as similar as ``alike`` (1 for identical)."""
    return next(iter(difflib.get_close_matches(got, names, n=1, cutoff=alike)), None)
