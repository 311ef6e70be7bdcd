"""Hashes of code: a measurement or cache entry is valid until the hash of the code behind it changes.

Prose is no code: comments and docstrings leave every hash alone.
"""

from __future__ import annotations

import ast
import dis
import hashlib
import io
import tokenize
from collections.abc import Collection, Iterable, Iterator, Sequence
from functools import cache
from pathlib import Path
from types import CodeType
from typing import cast

_PACKAGE = Path(__file__).parents[1]
_NOTHING = dis.opmap["NOP"]
_WITH_DOCSTRINGS = ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef


def hash_files(globs: Sequence[str]) -> str:
    """Hash names and contents of files that repository-relative globs match; of modules the compiled code."""
    digest = hashlib.sha256()
    for glob in sorted(globs):
        paths = sorted(p for p in _PACKAGE.parent.glob(glob) if p.is_file())
        if not paths:
            digest.update(b"missing")
        for path in paths:
            digest.update(path.relative_to(_PACKAGE.parent).as_posix().encode())
            content = path.read_bytes()
            digest.update(_compiled(content) if path.suffix == ".py" else content)
    return digest.hexdigest()[:16]


@cache
def _compiled(source: bytes) -> bytes:
    """Byte code of a module: it has neither prose nor places of lines, and is made faster than a tree."""
    return repr(_plain(compile(source, "", "exec", dont_inherit=True, optimize=2))).encode()


def _plain(value: object) -> object:
    """Take the place of lines out of byte code, and the chance out of the order of sets."""
    if isinstance(value, CodeType):
        sizes = value.co_argcount, value.co_posonlyargcount, value.co_kwonlyargcount, value.co_flags
        names = value.co_name, value.co_names, value.co_varnames, value.co_freevars, value.co_cellvars
        steps = value.co_code
        # A string after an attribute leaves a step that does nothing.
        if _NOTHING in steps[::2]:
            steps = b"".join(steps[at : at + 2] for at in range(0, len(steps), 2) if steps[at] != _NOTHING)
        return sizes, names, steps, value.co_exceptiontable, [_plain(each) for each in value.co_consts]
    if isinstance(value, tuple):
        return tuple(map(_plain, cast("tuple[object, ...]", value)))
    if isinstance(value, frozenset):
        return sorted(map(repr, cast("frozenset[object]", value)))
    return value


def hash_code(globs: Sequence[str], imports: Collection[str] | None = None) -> str:
    """Hash the statements of modules, regardless of their position and of the version of Python.

    Moving a statement, or changing a docstring, comment or import path, leaves the hash the same. Files other
    than Python count by their bytes.

    Parameters
    ----------
    globs : sequence of str
        Relative to the repository.
    imports : collection of str, optional
        Dotted names. With them, a module that a wildcard matches counts only where imports reach it: those of
        these names, or of a module that a glob names without a wildcard.
    """
    paths = {path for glob in globs for path in _PACKAGE.parent.glob(glob) if path.is_file()}
    if imports is not None:
        named = {_PACKAGE.parent / glob for glob in globs if "*" not in glob}
        paths &= named | _reached(imports, named)
    if not paths:
        return "missing"
    found = [_statements_of(path.read_bytes(), path.suffix) for path in sorted(paths)]
    names = frozenset[bytes]().union(*(imported for imported, _ in found))
    statements = sorted([*names, *(each for _, own in found for each in own)])
    return hashlib.sha256(b"\0".join(statements)).hexdigest()[:16]


@cache
def _statements_of(content: bytes, suffix: str) -> tuple[frozenset[bytes], tuple[bytes, ...]]:
    """Names that a module imports from anywhere, and its top-level statements without prose."""
    if suffix != ".py":
        return frozenset(), (content,)
    text = content.decode()
    module, lines, imported = ast.parse(text), text.splitlines(), set[str]()
    for node in (module, *_inside(module)):
        if isinstance(node, ast.Import | ast.ImportFrom):
            imported |= {f"import {ast.unparse(name)}" for name in node.names}
            _blank(lines, node)
        elif isinstance(node, _WITH_DOCSTRINGS):
            # A string after an attribute is prose about it.
            for each in node.body:
                if isinstance(each, ast.Expr) and isinstance(each.value, ast.Constant):
                    _blank(lines, each)
    statements: list[str] = []
    for node in module.body:
        first = min([node.lineno, *(each.lineno for each in getattr(node, "decorator_list", []))])
        kept = lines[first - 1 : node.end_lineno]
        statements.append(_without_remarks("\n".join(line for line in kept if line.strip())))
    return (
        frozenset(name.encode() for name in imported),
        tuple(statement.encode() for statement in statements if statement),
    )


def _without_remarks(statement: str) -> str:
    """Take comments out of a statement, and the lines that hold nothing else."""
    if "#" not in statement:
        return statement.rstrip()
    lines = statement.splitlines()
    for token in tokenize.generate_tokens(io.StringIO(statement + "\n").readline):
        if token.type == tokenize.COMMENT:
            lines[token.start[0] - 1] = lines[token.start[0] - 1][: token.start[1]]
    return "\n".join(line.rstrip() for line in lines if line.strip())


def _inside(node: ast.AST) -> Iterator[ast.AST]:
    """Statements within a module or statement, at any depth; not their expressions, which are many."""
    for part in ("body", "orelse", "finalbody", "handlers", "cases"):
        for each in getattr(node, part, ()):
            yield each
            yield from _inside(each)


def _blank(lines: list[str], node: ast.stmt) -> None:
    end = node.end_lineno or node.lineno
    lines[node.lineno - 1 : end] = [""] * (end - node.lineno + 1)


def imports_of(paths: Iterable[Path]) -> list[str]:
    """List the dotted names that some files import from this package."""
    return sorted({name for path in paths for name in _imports(path.read_bytes(), "")})


def _reached(names: Iterable[str], modules: Iterable[Path]) -> set[Path]:
    """Modules that names lead to by imports, and by those of further modules."""
    found, left = set[Path](), [path for path in modules if path.suffix == ".py" and path.is_file()]
    left += _homes(names)
    while left:
        path = left.pop()
        if path not in found:
            found.add(path)
            left += _next(path, _PACKAGE.parent)
    return found


@cache
def _next(path: Path, root: Path) -> tuple[Path, ...]:
    """Modules that the imports of one lead to."""
    package = ".".join(path.relative_to(root).parent.parts)
    return tuple({each for face in _faces(path) for each in _homes(_imports(face.read_bytes(), package))})


def _faces(path: Path) -> list[Path]:
    """Return a module, and beside it the stub that a lazy one imports by."""
    return [each for each in (path, path.with_suffix(".pyi")) if each.is_file()]


def _homes(names: Iterable[str]) -> Iterator[Path]:
    """Modules that hold names; for a name in a room's face, the module where the face has it from."""
    for name in names:
        home, rest = name, ""
        while home and _module(_PACKAGE.parent, home) is None:
            home, _, rest = home.rpartition(".")
        path = _module(_PACKAGE.parent, home) if home else None
        if path is None:
            continue
        faces = _faces(path) if rest and path.name == "__init__.py" else []
        offered = [each for face in faces for each in _imports(face.read_bytes(), home)]
        given = [each for each in offered if each.rpartition(".")[2] == rest]
        yield from _homes(given) if given else [path]


@cache
def _imports(source: bytes, package: str) -> frozenset[str]:
    """Dotted names that a module imports from this package; relative ones are taken from ``package``."""
    names = set[str]()
    for node in _inside(ast.parse(source)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            above = package.split(".")[: 1 - node.level or None] if node.level else []
            origin = ".".join([*above, *([node.module] if node.module else [])])
            names |= {f"{origin}.{alias.name}" for alias in node.names}
    return frozenset(name for name in names if name.partition(".")[0] == _PACKAGE.name)


@cache
def _module(root: Path, name: str) -> Path | None:
    """File of a module or package; None where a name is neither."""
    base = root.joinpath(*name.split("."))
    return next((p for p in (base.with_suffix(".py"), base / "__init__.py") if p.is_file()), None)
