"""Pages that MkDocs makes from the code itself: commands, keys, what is shipped and what was validated.

MkDocs calls ``on_files`` and ``on_page_markdown`` (``hooks`` of mkdocs.yml). Two names of the package are
known here: the console script ``optsim``, and ``optsim.scene.Scene``.
"""

from __future__ import annotations

import io
import json
import re
import sys
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import redirect_stdout
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
# Files of the repository that the manual shows where they are: a glob each.
SHOWN = ("CHANGELOG.md", "reports/*.md", "reports/pictures/*.png", "scenes/*/README.md")
LISTS = ("scenes", "presets", "schemes", "decoders", "metrics", "effects")
_MADE = "Made from the code when the manual is built.\n"


def on_files(files: Any, config: Any) -> Any:
    """Add the generated pages, and what lies outside ``docs/``."""
    from mkdocs.structure.files import File

    for uri, make in PAGES.items():
        files.append(File.generated(config, uri, content=make()))
    for pattern in SHOWN:
        for path in sorted(ROOT.glob(pattern)):
            uri = path.relative_to(ROOT).as_posix()
            files.append(File.generated(config, uri, abs_src_path=str(path)))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Make links to and from what lies beside ``docs/`` fit the manual, one folder that holds all."""
    depth = page.file.src_uri.count("/")
    outside = re.compile(r"\]\(" + r"\.\./" * (depth + 1) + r"(reports|scenes|CHANGELOG)")
    within = outside.sub(lambda found: "](" + "../" * depth + found[1], markdown)
    return re.sub(r"\]\(((?:\.\./)+)docs/", r"](\1", within)


def commands() -> str:
    """List every command with its arguments and options."""
    lines = ["# Commands", "", _MADE]
    for names, command in _commands("optsim", _command()):
        arguments = [p for p in command.params if p.param_type_name == "argument"]
        options = [p for p in command.params if p.param_type_name == "option" and not p.hidden]
        placed = ["COMMAND"] if _subcommands(command) else []
        usage = " ".join([names, *(_value(p) for p in arguments), *placed])
        lines += [f"## {names}", "", _text(command.help or ""), "", "```text", usage, "```", ""]
        if command.epilog:
            lines += [_text(command.epilog), ""]
        rows = [(f"`{_value(p)}`", p.help or "") for p in arguments]
        rows += [(_option(p), p.help or "") for p in options]
        if rows:
            lines += _table(("argument or option", "meaning"), rows)
    return "\n".join(lines)


def experiment_keys() -> str:
    """List every key of an experiment."""
    schema = json.loads(_output("config", "schema"))
    about = "An experiment is a TOML file with these keys. The command line sets each by `--set KEY=VALUE`."
    return _keys("Keys of an experiment", schema, about)


def scene_keys() -> str:
    """List every key of a scene."""
    from optsim.scene import Scene

    return _keys("Keys of a scene", Scene.model_json_schema(), "A scene is a `scene.toml` with these keys.")


def shipped() -> str:
    """List names that experiments may use, as ``optsim list`` prints them."""
    lines = ["# What is shipped", "", _MADE]
    for what in LISTS:
        rows = [(f"`{row['name']}`", row["about"]) for row in json.loads(_output("list", what, "--json"))]
        lines += [f"## {what.capitalize()}", "", *_table(("name", "what it is"), rows)]
    return "\n".join(lines)


def validation() -> str:
    """List the records of ``optsim validate``."""
    (path,) = (ROOT / "optsim").rglob("evidence.json")
    records = json.loads(path.read_text(encoding="utf-8"))
    lines = ["# Validation records", "", _MADE]
    lines += [
        "A record passes when its deviation is within the tolerance and that of a broken stage is not. "
        "A run prints an effect as unvalidated when its code changed since.",
        "",
    ]
    rows = [
        (
            f"[{r['effect']}](#{r['effect']})",
            "pass" if r["passed"] else "**fail**",
            *(f"{r[key]:.3g}" for key in ("measured", "tolerance", "perturbed")),
        )
        for r in records
    ]
    lines += _table(("effect", "result", "measured", "tolerance", "stage broken"), rows)
    for r in records:
        lines += [f"## {r['effect']}", ""]
        about = ("claim", "oracle", "source", "reason")
        lines += _table(("", ""), [(key if key != "reason" else "tolerance", r[key]) for key in about])
    return "\n".join(lines)


PAGES: dict[str, Callable[[], str]] = {
    "reference/commands.md": commands,
    "reference/experiment.md": experiment_keys,
    "reference/scene.md": scene_keys,
    "reference/shipped.md": shipped,
    "reference/validation.md": validation,
}


def _command() -> Any:
    """Return the command line as its console script makes it."""
    import typer

    (script,) = entry_points(group="console_scripts", name="optsim")
    return typer.main.get_command(sys.modules[script.load().__module__].app)


def _output(*words: str) -> str:
    stream = io.StringIO()
    with redirect_stdout(stream):
        _command().main(list(words), standalone_mode=False)
    return stream.getvalue()


def _subcommands(command: Any) -> dict[str, Any]:
    return getattr(command, "commands", {})


def _commands(name: str, command: Any) -> Iterator[tuple[str, Any]]:
    yield name, command
    for word, inner in _subcommands(command).items():
        yield from _commands(f"{name} {word}", inner)


def _value(parameter: Any) -> str:
    return parameter.metavar or parameter.name.upper()


def _option(option: Any) -> str:
    names = ", ".join([*option.opts, *option.secondary_opts])
    return f"`{names}`" if option.is_flag or option.count else f"`{names} {_value(option)}`"


def _keys(title: str, schema: dict[str, Any], about: str) -> str:
    tables = {"": schema, **schema.get("$defs", {})}
    places = _places(schema)
    lines = [
        f"# {title}",
        "",
        _MADE,
        about,
        "",
    ]
    for name in sorted(tables, key=lambda each: (places[each][0].count("."), places[each][0])):
        table = tables[name]
        if "properties" not in table:
            continue
        first, *others = places[name]
        kind = table["properties"].get("kind", {}).get("const")
        heading = " ".join([f"`{first}`" if first else "Top level", *([f"kind `{kind}`"] if kind else [])])
        lines += [f"## {heading}", ""]
        if name:
            lines += [f'<a id="{name.lower()}"></a>', ""]
        if others:
            lines += ["Also at " + ", ".join(f"`{place}`" for place in others[:4]) + ".", ""]
        required = table.get("required", [])
        rows = [
            (
                f"`{key}`",
                _kind(value, places),
                "required" if key in required else _default(value),
                _text(value.get("description", "")),
            )
            for key, value in table["properties"].items()
        ]
        lines += _table(("key", "value", "default", "meaning"), rows, escaped=True)
    return "\n".join(lines)


def _places(schema: dict[str, Any]) -> dict[str, list[str]]:
    """Find where each table of a schema may stand, by its name; the shortest place first."""
    places: dict[str, list[str]] = {"": [""]}
    queue = deque([("", "")])
    while queue:
        name, place = queue.popleft()
        table = schema["$defs"][name] if name else schema
        for key, value in table.get("properties", {}).items():
            for inner, step in _references(value):
                found = places.setdefault(inner, [])
                path = f"{place}.{key}{step}".lstrip(".")
                if path not in found and path.count(".") < 6:
                    found.append(path)
                    queue.append((inner, path))
    return places


def _references(value: dict[str, Any], step: str = "") -> Iterator[tuple[str, str]]:
    """Yield names of tables that a value may be, and what to add to its key: a name for one of several."""
    if "$ref" in value:
        yield value["$ref"].rpartition("/")[2], step
    for key in ("anyOf", "oneOf", "allOf"):
        for inner in value.get(key, ()):
            yield from _references(inner, step)
    for key in ("items", "additionalProperties"):
        if isinstance(value.get(key), dict):
            yield from _references(value[key], f"{step}.NAME")
    for inner in value.get("prefixItems", ()):
        yield from _references(inner, f"{step}.NAME")


def _kind(value: dict[str, Any], places: dict[str, list[str]]) -> str:
    """Say what may be written for a key."""
    if "$ref" in value:
        name = value["$ref"].rpartition("/")[2]
        return f"[table](#{name.lower()})" if name in places else "table"
    if "const" in value:
        return f"`{value['const']}`"
    if "enum" in value:
        return ", ".join(f"`{each}`" for each in value["enum"])
    for key in ("anyOf", "oneOf"):
        if key in value:
            kinds = list(dict.fromkeys(_kind(each, places) for each in value[key]))
            tables = [each for each in kinds if "](#" in each]
            if len(tables) > 3:
                kinds = [each for each in kinds if each not in tables] + ["table with a `kind`"]
            return " or ".join(kinds)
    word = {"integer": "whole number", "string": "text", "boolean": "true or false", "null": "none"}
    kind = word.get(str(value.get("type")), str(value.get("type", "any")))
    if kind == "object":
        inner = value.get("additionalProperties")
        return "tables by name" if isinstance(inner, dict) and list(_references(inner)) else "table"
    if "prefixItems" in value:
        return f"list of {len(value['prefixItems'])}"
    if kind == "array" and isinstance(value.get("items"), dict):
        kind = f"list of {_kind(value['items'], places)}" if value["items"] else "list"
    limits = {"exclusiveMinimum": ">", "minimum": "≥", "exclusiveMaximum": "<", "maximum": "≤"}
    said = [f"{sign} {value[key]:g}" for key, sign in limits.items() if key in value]
    return ", ".join([kind, *said]).replace("<", "&lt;").replace(">", "&gt;")


def _default(value: dict[str, Any]) -> str:
    default = value.get("default")
    if default is None or isinstance(default, dict):
        return "" if default is None else "table"
    text = json.dumps(default, ensure_ascii=False)
    return f"`{text}`" if len(text) < 40 else "list"


def _table(head: tuple[str, ...], rows: Iterable[tuple[str, ...]], *, escaped: bool = False) -> list[str]:
    said = [row if escaped else tuple(_text(cell) for cell in row) for row in rows]
    lines = [head, ("---",) * len(head), *said]
    return [f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in line)} |" for line in lines] + [""]


def _text(text: str) -> str:
    """Write plain text as Markdown, but for what stands between backticks."""
    pieces = re.split(r"(`[^`]*`|\]\(#[^)]*\)|\*\*)", " ".join(text.split()))
    return "".join(
        piece if index % 2 else re.sub(r"([*])", r"\\\1", piece.replace("<", "&lt;"))
        for index, piece in enumerate(pieces)
    )
