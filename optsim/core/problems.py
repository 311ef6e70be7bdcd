"""Messages for a table that is not valid: the key, the value got, the value expected, and the cure."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple, cast, get_args, get_origin

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

from optsim.core.errors import nearest_name
from optsim.core.units import parse_quantity, units_of

# If a name is valid in more places than this, they are not listed.
_PLACES = 3
# Pydantic's name for a field's type -> the word for a user who writes TOML.
_WORDS = {
    "bool": "true or false",
    "dict": "a table",
    "float": "a number",
    "int": "a whole number",
    "string": "a text",
    "tuple": "a list",
}


def problems(part: type[BaseModel], table: Mapping[str, object], error: ValidationError) -> list[str]:
    """List the problems of a table, one line each."""
    items = cast("list[dict[str, Any]]", error.errors())
    # Pydantic also calls a list of wrong items too short: that is not a second problem.
    inside = {tuple(item["loc"][:depth]) for item in items for depth in range(len(item["loc"]))}
    lines: list[str] = []
    reported: dict[tuple[int | str, ...], int] = {}
    for item in items:
        if item["type"] == "too_short" and item["loc"] in inside:
            continue
        place = _place(part, table, item["loc"])
        line = _line(part, item, place)
        _, also, expected = line.partition(", expected ")
        if also and place.steps in reported:
            # A key that takes a number or a word reports two errors: they are merged into one problem.
            lines[reported[place.steps]] += f", or {expected}"
        else:
            reported[place.steps] = len(lines)
            lines.append(line)
    return lines


class _Place(NamedTuple):
    """Place of a problem: its key, the parts it may belong to, and the field they declare."""

    key: str  # With names instead of indices where items have names.
    path: str  # Without list indices.
    steps: tuple[int | str, ...]
    owners: list[type[BaseModel]]
    field: FieldInfo | None


def _line(part: type[BaseModel], item: dict[str, Any], place: _Place) -> str:
    kind, context = cast("str", item["type"]), cast("dict[str, Any]", item.get("ctx", {}))
    message = cast("str", item["msg"]).removeprefix("Value error, ")
    got = cast("object", item["input"])
    if kind == "extra_forbidden":
        return f"{place.key}: unknown key; {_right_key(part, place)}"
    if kind == "missing":
        return f"{place.key}: missing, and it has no default"
    if kind == "value_error" and isinstance(got, dict):
        # The message already names the inner key and value; printing the whole table would hide them.
        return f"{place.key}: {message}" if place.key else message
    if kind.startswith("union_tag"):
        tag, written = (
            context.get("tag"),
            list(cast("dict[str, object]", got)) if isinstance(got, dict) else [],
        )
        near = nearest_name(written, "kind")
        meant = f" (did you mean it by {near!r}?)" if near and "kind" not in written else ""
        return f"{place.key}.kind: {_found(tag)}{meant}, {_one_of(_kinds(place), tag)}"
    return f"{place.key}: {_found(got)}, {_expected(kind, message, context, place, got)}"


def _expected(kind: str, message: str, context: dict[str, Any], place: _Place, got: object) -> str:
    if kind in ("too_short", "too_long"):
        least, most = context.get("min_length"), context.get("max_length")
        return f"expected a list of {f'{least} or more' if kind == 'too_short' else f'{most} at most'}"
    what, *how = kind.split("_")
    if what in ("greater", "less"):
        return f"expected {_range(place.field, context)}{_unit(place.key)}"
    if kind == "float_parsing":
        try:
            parse_quantity(place.key.rsplit(".", 1)[-1], str(got))
        except ValueError as why:
            return str(why)
    if kind == "literal_error":
        words = cast("str", context["expected"]).replace("'", "").replace(" or ", ", ")
        return _one_of(words.split(", "), got)
    if kind == "string_pattern_mismatch" and place.field and place.field.description:
        return f"expected {place.field.description}"
    if what == "model" and len(place.owners) > 1:
        return f"expected a table whose kind is one of: {', '.join(_kinds(place))}"
    if what == "model":
        return f"expected a table with some of: {', '.join(place.owners[0].model_fields)}"
    if what in _WORDS and how[0] in ("type", "parsing", "from"):
        return f"expected {_WORDS[what]}"
    return message.replace("Input should be", "expected")


def _kinds(place: _Place) -> list[str]:
    return [str(part.model_fields["kind"].default) for part in place.owners]


def _one_of(names: Sequence[str], got: object) -> str:
    near = nearest_name(names, str(got))
    return f"expected one of: {', '.join(names)}" + (f"; did you mean {near!r}?" if near else "")


def _found(value: object) -> str:
    text = "nothing" if value is None else repr(value)
    return f"got {text if len(text) < 80 else text[:77] + '...'}"


def _unit(key: str) -> str:
    """State the unit of a plain number at a key, and that a text may give another unit."""
    units = list(units_of(key))
    return f" (in {units[0]}; a text such as '1 {units[1]}' works too)" if len(units) > 1 else ""


def _range(field: FieldInfo | None, context: dict[str, Any]) -> str:
    """Describe the range that a field's own limits allow, or else those of its items."""
    limits: dict[str, Any] = {}
    for limit in field.metadata if field else ():
        limits |= {end: getattr(limit, end) for end in ("ge", "gt", "le", "lt") if hasattr(limit, end)}
    limits |= context
    words = {"ge": "at least", "gt": "more than", "le": "at most", "lt": "less than"}
    return " and ".join(f"{words[end]} {value:.12g}" for end, value in limits.items() if end in words)


def _right_key(part: type[BaseModel], place: _Place) -> str:
    """Suggest the nearest key, or a right name's whole key in another table; else list the valid keys."""
    name, own = place.key.rsplit(".", 1)[-1], [key for p in place.owners for key in p.model_fields]
    # A key of another kind of part is not valid here.
    table = place.path[: place.path.rfind(".") + 1]
    paths = {key: found for key, found in _field_paths(part).items() if table + key not in found}
    # Keys of this table come before keys elsewhere, unless one elsewhere has exactly this name.
    begun = min((key for key in own if key.startswith(name)), key=len, default=None)
    # Elsewhere only a name that is almost identical.
    near = begun or nearest_name(own, name, alike=0.7) or nearest_name(sorted(paths), name, alike=0.85)
    # A name from elsewhere is given as its whole key.
    meant = [] if near is None else [near] if near in own else paths[near]
    same = [] if begun or len(paths.get(name, [])) > _PLACES else paths.get(name, [])
    meant = list(dict.fromkeys([*same, *meant]))
    if not 0 < len(meant) <= _PLACES:
        return f"keys here are: {', '.join(dict.fromkeys(own))}"
    return f"did you mean {' or '.join(repr(m) for m in meant)}?"


def _place(part: type[BaseModel], table: object, location: Sequence[int | str]) -> _Place:
    """Follow an error's location, which names chosen kinds too, through the table and its parts."""
    inside, owners, field = [part], [part], None
    keys: list[str] = []
    path: list[str] = []
    steps: list[int | str] = []
    value = table
    for step in location:
        # The chosen kind; the table need not contain it where a default kind exists.
        chosen = [p for p in inside if "kind" in p.model_fields and p.model_fields["kind"].default == step]
        if chosen and _inside(value, step) is None:
            inside = chosen
            continue
        # Pydantic's location may contain the name of a type, which is no key.
        known = any(step in p.model_fields for p in inside) or _inside(value, step) is not None
        if field and not known and isinstance(step, str) and not inside:
            continue
        steps.append(step)
        value = _inside(value, step)
        # A wrong name is reported by its index.
        name = None if isinstance(step, str) or location[-1] == "name" else _inside(value, "name")
        keys.append(str(name or step))
        path += [step] if isinstance(step, str) else []
        if field and get_origin(field.annotation) is dict:
            field = None  # the name of a part, not a key of one
        elif isinstance(step, str):
            owners = inside
            fields = [p.model_fields[step] for p in owners if step in p.model_fields]
            field = fields[0] if fields else None
            inside = [p for info in fields for p in _parts(info.annotation)]
        inside = _of_its_kind(inside, value)
    # A problem of a table belongs to the table, a problem of a number to its owner.
    return _Place(".".join(keys), ".".join(path), tuple(steps), inside or owners, field)


def _inside(value: Any, step: int | str) -> Any:
    try:
        return value[step]
    except (LookupError, TypeError):
        # Index of a missing item.
        return None


def _of_its_kind(parts: list[type[BaseModel]], value: object) -> list[type[BaseModel]]:
    """Select the parts that a table's ``kind`` chooses; all if it chooses none."""
    kind = _inside(value, "kind")
    return [p for p in parts if "kind" in p.model_fields and p.model_fields["kind"].default == kind] or parts


def _parts(annotation: Any) -> Iterator[type[BaseModel]]:
    """Yield the parts in an annotation, through unions, tuples and the like, but not inside other parts."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for inside in get_args(annotation):
        yield from _parts(inside)


def _field_paths(part: type[BaseModel]) -> dict[str, list[str]]:
    """Whole keys by field name, for a part and the parts inside it; used in hints."""
    paths: dict[str, list[str]] = {}
    todo, seen = [("", part)], set[tuple[str, type[BaseModel]]]()
    while todo:
        prefix, item = todo.pop()
        if (prefix, item) in seen:
            continue
        seen.add((prefix, item))
        for name, info in item.model_fields.items():
            if prefix + name not in paths.setdefault(name, []):
                paths[name].append(prefix + name)
            todo += [(f"{prefix}{name}.", inner) for inner in _parts(info.annotation)]
    return paths
