"""Hashes of code: a measurement or cache entry is valid until the hash of the code behind it changes."""

from __future__ import annotations

import ast
import hashlib
from collections.abc import Sequence
from functools import cache
from pathlib import Path

_PACKAGE = Path(__file__).parents[1]
_WITH_DOCSTRINGS = ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef


def hash_files(globs: Sequence[str]) -> str:
    """Hash names and contents of the files that repository-relative globs match."""
    digest = hashlib.sha256()
    for glob in sorted(globs):
        paths = sorted(p for p in _PACKAGE.parent.glob(glob) if p.is_file())
        if not paths:
            digest.update(b"missing")
        for path in paths:
            digest.update(path.relative_to(_PACKAGE.parent).as_posix().encode())
            digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def hash_code(globs: Sequence[str]) -> str:
    """Hash the statements of modules, regardless of their position.

    Moving a statement, or changing a docstring, comment or import path, leaves the hash the same. Files other
    than Python count by their bytes.
    """
    paths = {path for glob in globs for path in _PACKAGE.parent.glob(glob) if path.is_file()}
    if not paths:
        return "missing"
    statements = sorted(frozenset[bytes]().union(*map(_statements_of, paths)))
    return hashlib.sha256(b"\0".join(statements)).hexdigest()[:16]


@cache
def _statements_of(path: Path) -> frozenset[bytes]:
    """Top-level statements of a module without prose, and the names that it imports from anywhere."""
    if path.suffix != ".py":
        return frozenset({path.read_bytes()})
    text = path.read_text(encoding="utf-8")
    module, lines, imported = ast.parse(text), text.splitlines(), set[str]()
    for node in ast.walk(module):
        if isinstance(node, ast.Import | ast.ImportFrom):
            imported |= {f"import {ast.unparse(name)}" for name in node.names}
            _blank(lines, node)
        elif isinstance(node, _WITH_DOCSTRINGS) and ast.get_docstring(node, clean=False) is not None:
            _blank(lines, node.body[0])
    statements = imported
    for node in module.body:
        first = min([node.lineno, *(each.lineno for each in getattr(node, "decorator_list", []))])
        kept = lines[first - 1 : node.end_lineno]
        statements.add("\n".join(line.rstrip() for line in kept if line.strip() and line.lstrip()[0] != "#"))
    return frozenset(statement.encode() for statement in statements - {""})


def _blank(lines: list[str], node: ast.stmt) -> None:
    end = node.end_lineno or node.lineno
    lines[node.lineno - 1 : end] = [""] * (end - node.lineno + 1)
