"""Pages as single HTML files: no script, no link, all text escaped."""

import html
from collections.abc import Collection, Iterable, Sequence
from pathlib import Path

POLICY = (
    '<meta http-equiv="Content-Security-Policy" '
    "content=\"default-src 'none'; img-src data:; style-src 'unsafe-inline'\">"
)
"""The page may load nothing from elsewhere, whatever a name in it says."""

STYLE = Path(__file__).with_name("page.css").read_text(encoding="utf-8")


class Markup(str):
    """Text that is HTML already."""


def format_document(title: str, body: Sequence[str]) -> str:
    """Return a page of a title and parts in HTML."""
    head = f'<meta charset="utf-8"><meta name="viewport" content="width=device-width"><title>{escape(title)}</title>'
    content = "\n".join([f"<h1>{escape(title)}</h1>", *body])
    return (
        f'<!doctype html>\n<html lang="en">\n<head>{POLICY}{head}<style>\n{STYLE}</style></head>\n'
        f"<body><main>\n{content}\n</main></body>\n</html>\n"
    )


def format_html_table(
    heads: Sequence[str], rows: Iterable[Sequence[str]], numbers: Collection[int] = (), code: Collection[int] = ()
) -> str:
    """Return a table with columns of `numbers` and of `code`."""

    def cell(tag: str, column: int, value: str) -> str:
        inner = f"<code>{escape(value)}</code>" if column in code and tag == "td" else escape(value)
        align = ' class="n"' if column in numbers else ""
        return f"<{tag}{align}>{inner}</{tag}>"

    lines = ["".join(cell("th", i, head) for i, head in enumerate(heads))]
    lines += ["".join(cell("td", i, value) for i, value in enumerate(row)) for row in rows]
    return '<div class="scroll"><table>' + "\n".join(f"<tr>{line}</tr>" for line in lines) + "</table></div>"


def escape(value: object) -> str:
    """Return text that HTML takes literally; `Markup` stays."""
    return value if isinstance(value, Markup) else html.escape(str(value), quote=True)
