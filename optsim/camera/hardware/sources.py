"""Sources of the data sheets' numbers, read from the comments beside them."""

from __future__ import annotations

import ast
import inspect
from collections.abc import Callable
from functools import cache


@cache
def sources(make: Callable[[], object]) -> dict[tuple[str, str], str]:
    """Return (class, key) -> source, for the numbers of a data sheet.

    A comment holds for the key below it and the following keys, up to the next comment.
    """
    whole = inspect.getsource(inspect.getmodule(make) or make)
    return _in_text(whole) | _in_text(inspect.getsource(make))


def _in_text(text: str) -> dict[tuple[str, str], str]:
    lines = text.splitlines()
    found: dict[tuple[str, str], str] = {}
    for call in ast.walk(ast.parse(text)):
        if not isinstance(call, ast.Call) or not isinstance(call.func, ast.Name):
            continue
        source = ""
        for keyword in call.keywords:
            source = _comment_above(lines, keyword.value.lineno) or source
            if source and keyword.arg:
                found[call.func.id, keyword.arg] = source
    return found


def _comment_above(lines: list[str], line: int) -> str:
    """Comment that ends above a line; lines count from 1."""
    comment: list[str] = []
    for above in reversed(lines[: line - 1]):
        if not above.lstrip().startswith("# "):
            break
        comment.append(above.lstrip().removeprefix("# "))
    return " ".join(reversed(comment))
