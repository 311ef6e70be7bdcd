"""Classes that other installed packages offer under entry points, beside those of this package.

The groups are ``optsim.decoders``, ``optsim.schemes``, ``optsim.metrics``, ``optsim.parts`` and
``optsim.objects``. The name of an entry point is the class's ``kind``. Nothing is loaded before a kind is
asked for that isn't ours.
"""

from __future__ import annotations

import inspect
from collections.abc import Mapping, Sequence
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any, TypeVar, cast

from pydantic import SerializeAsAny, ValidationError, ValidatorFunctionWrapHandler, WrapValidator

from optsim.core.config import Part, build
from optsim.core.errors import ConfigError
from optsim.core.files import content_hash

_NAMES = "decoders", "schemes", "metrics", "parts", "objects"
GROUPS = DECODERS, SCHEMES, METRICS, PARTS, OBJECTS = tuple(f"optsim.{name}" for name in _NAMES)
AS_IT_IS: Any = SerializeAsAny()  # pyright: ignore[reportCallIssue, reportUnknownVariableType]
"""Lets a field write a subclass with all its keys."""
_T = TypeVar("_T", bound=Part)


@cache
def offered(group: str) -> Mapping[str, type[Part]]:
    """Classes of a group of entry points, by their kind.

    Raises
    ------
    ConfigError
        For one that can't be loaded, is no ``Part`` with its name as ``kind``, or has a kind that is taken.
    """
    found: dict[str, type[Part]] = {}
    for point in sorted(entry_points(group=group), key=lambda each: each.name):
        try:
            loaded: object = point.load()
        except Exception as error:
            raise _refused(point, f"got {type(error).__name__}: {' '.join(str(error).split())}") from None
        if not (isinstance(loaded, type) and issubclass(loaded, Part)) or kind_of(loaded) != point.name:
            raise _refused(point, f"got {loaded!r}, expected a subclass of Part with kind = {point.name!r}")
        taken = {kind_of(each) for each in _family(loaded) if each.__module__.startswith("optsim.")}
        if point.name in found or point.name in taken:
            raise _refused(point, "got a kind that is taken, expected a name of its own")
        found[point.name] = loaded
    return found


def offered_of(group: str, base: type[_T]) -> tuple[type[_T], ...]:
    """Classes of a group that are of a base."""
    return tuple(each for each in offered(group).values() if issubclass(each, base))


def or_offered(group: str, base: type[Part]) -> WrapValidator:
    """Let a field take classes of a group beside its own: by their ``kind`` in a table, or an instance."""

    def check(value: object, handler: ValidatorFunctionWrapHandler) -> object:
        try:
            return handler(value)
        except ValidationError:
            kinds = {kind_of(each): each for each in offered_of(group, base)}
            if isinstance(value, tuple(kinds.values())):
                return value
            table: Mapping[str, object] = {}
            if isinstance(value, Mapping):
                table = cast("Mapping[str, object]", value)
            kind = table.get("kind")
            if isinstance(kind, str) and kind in kinds:
                return build(kinds[kind], table, where=f"{group}: {kind}")
            raise

    return WrapValidator(check)


def extension_versions(groups: Sequence[str] = GROUPS) -> dict[str, str]:
    """Version of each package that offers a class of some groups, and a hash of the class's file."""
    return {
        f"{group}: {kind}": f"{_version(each)}, {_hash(each)}"
        for group in groups
        for kind, each in offered(group).items()
    }


def kind_of(part: type[Any]) -> str:
    """Return the name of a class in TOML; empty without one."""
    fields = getattr(part, "model_fields", {})
    return str(fields["kind"].default) if "kind" in fields else ""


def _family(part: type[Part]) -> list[type[Part]]:
    """All classes that share a base with a part, below ``Part`` itself."""
    found = [each for each in part.__mro__[1:] if issubclass(each, Part) and each is not Part]
    for base in found:
        found += [each for each in base.__subclasses__() if each not in found]
    return found


def _refused(point: EntryPoint, why: str) -> ConfigError:
    owner = point.dist.name if point.dist else "its package"
    return ConfigError(f"entry point {point.group}: {point.name}: {why}; fix: mend or uninstall {owner}")


@cache
def _version(part: type[Part]) -> str:
    from importlib.metadata import packages_distributions, version

    top = part.__module__.partition(".")[0]
    return ", ".join(f"{name} {version(name)}" for name in packages_distributions().get(top, ())) or top


def _hash(part: type[Part]) -> str:
    try:
        return content_hash(Path(inspect.getfile(part)))[:12]
    except (OSError, TypeError):
        return "no file"
