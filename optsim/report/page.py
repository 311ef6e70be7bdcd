"""Pages in the report's look, of text, tables, plots and pictures: one HTML file without network."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from markupsafe import Markup, escape

from optsim.core.files import write_text
from optsim.report.html import page_environment


@dataclass(frozen=True)
class Section:
    """A heading, sentences, and what is shown below them."""

    title: str
    text: Sequence[str] = ()
    parts: Sequence[Markup] = ()


def write_page(path: Path, *, kind: str, title: str, lead: str, sections: Sequence[Section]) -> None:
    """Write a page; ``kind`` stands above the title, and ``lead`` says what was found."""
    template = page_environment().get_template("page.html.j2")
    write_text(path, template.render(kind=kind, title=title, lead=lead, sections=sections))


def table(heads: Sequence[str], rows: Sequence[Sequence[object]], caption: str = "") -> Markup:
    """Draw a table; columns whose cells are numbers, or begin like one, are aligned right."""
    number = [all(_is_number(row[at]) for row in rows) for at in range(len(heads))]
    marks = [Markup(' class="n"') if each else Markup("") for each in number]
    head = Markup("").join(Markup("<th{}>{}</th>").format(m, h) for m, h in zip(marks, heads, strict=True))
    body = Markup("").join(
        Markup("<tr>{}</tr>").format(
            Markup("").join(Markup("<td{}>{}</td>").format(m, c) for m, c in zip(marks, row, strict=True))
        )
        for row in rows
    )
    said = Markup("<caption>{}</caption>").format(caption) if caption else Markup("")
    return Markup(
        '<div class="scroll"><table>{}<thead><tr>{}</tr></thead><tbody>{}</tbody></table></div>'
    ).format(said, head, body)


def plots(drawn: Sequence[tuple[str, Markup]]) -> Markup:
    """Put plots side by side, each below its name."""
    return Markup('<div class="plots">{}</div>').format(
        Markup("").join(Markup("<div><h3>{}</h3>{}</div>").format(name, plot) for name, plot in drawn)
    )


def strip(pictures: Sequence[tuple[str, str]]) -> Markup:
    """Put pictures side by side: file and caption of each."""
    return Markup('<div class="strip wide">{}</div>').format(
        Markup("").join(
            Markup(
                '<figure><a href="{0}"><img src="{0}" alt="{1}"></a>'
                "<figcaption><b>{1}</b></figcaption></figure>"
            ).format(file, caption)
            for file, caption in pictures
        )
    )


def folded(title: str, inside: Markup) -> Markup:
    """Hide something long behind its title."""
    return Markup("<details><summary>{}</summary>{}</details>").format(title, inside)


def listed(items: Sequence[str]) -> Markup:
    """Write a list of sentences."""
    return Markup("<ul>{}</ul>").format(Markup("").join(Markup("<li>{}</li>").format(i) for i in items))


def _is_number(cell: object) -> bool:
    text = str(escape(str(cell))).strip()
    return text in ("", "–") or text.lstrip("+−-±≥> ")[:1].isdigit()
