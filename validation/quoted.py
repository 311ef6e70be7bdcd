"""Figures that prose quotes, from the files that a measurement wrote.

A quoted figure stands between two comments that don't show: ``<!--= claims.demo.best:+.2f -->+0.12<!--/-->``
is the entry ``demo``, ``best`` of ``reports/figures/claims.json`` in the format ``+.2f``. To put figures in:
``python validation/quoted.py --write``; the tests check that none differs.
"""

from __future__ import annotations

import json
import re
import sys
from functools import cache
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parent.parent
PROSE = (
    "README.md",
    "reports/measured.md",
    *sorted(path.relative_to(ROOT).as_posix() for path in (ROOT / "docs").rglob("*.md")),
)
_QUOTED = re.compile(r"(<!--= (?P<key>[\w.-]+)(?::(?P<form>[^ ]+))? -->)(?P<text>.*?)(<!--/-->)")


def main() -> int:
    """Check all prose, or write it; say what differs."""
    wrong = 0
    for name in PROSE:
        before = (ROOT / name).read_text(encoding="utf-8")
        after = filled(before)
        if after == before:
            continue
        wrong += 1
        if "--write" in sys.argv:
            (ROOT / name).write_text(after, encoding="utf-8")
        print(f"{name}: {'written' if '--write' in sys.argv else 'quotes figures that have changed'}")
    return 1 if wrong and "--write" not in sys.argv else 0


def filled(prose: str) -> str:
    """Return prose with each quoted figure as its file has it."""
    return _QUOTED.sub(lambda m: f"{m[1]}{quote(m['key'], m['form'] or '')}{m[5]}", prose)


def quote(key: str, form: str) -> str:
    """Return one figure as text: ``FILE.ENTRY.ENTRY`` in a format of Python's."""
    name, *path = key.split(".")
    found: Any = _figures(name)
    for entry in path:
        if not isinstance(found, dict) or entry not in found:
            raise KeyError(f"{key}: reports/figures/{name}.json has no {entry!r}")
        found = found[entry]
    return format(found, form)


@cache
def _figures(name: str) -> Any:
    return json.loads((ROOT / "reports" / "figures" / f"{name}.json").read_text(encoding="utf-8"))


if __name__ == "__main__":
    raise SystemExit(main())
