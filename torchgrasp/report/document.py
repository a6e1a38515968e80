"""Pages as single HTML files: no script, no link, every text escaped."""

import html
from collections.abc import Collection, Iterable, Sequence

POLICY = (
    '<meta http-equiv="Content-Security-Policy" '
    "content=\"default-src 'none'; img-src data:; style-src 'unsafe-inline'\">"
)
"""The page may load nothing from elsewhere, whatever a name in it says."""

STYLE = """
body { margin: 0; background: #f3f2ee; color: #22262b; font: 16px/1.5 system-ui, "Segoe UI", "DejaVu Sans", sans-serif }
main { max-width: 1080px; margin: 0 auto; padding: 40px 28px 64px }
h1 { font-size: 30px; line-height: 1.2; margin: 0 0 6px; letter-spacing: -.01em }
h2 { font-size: 19px; margin: 40px 0 12px }
.source { color: #6a717b; margin: 0 0 20px; overflow-wrap: anywhere }
.verdict { font-size: 18px; padding: 14px 18px; margin: 0; background: #fff; border-left: 5px solid #23967f }
.verdict.bad { border-color: #c2452d }
.scroll { overflow-x: auto }
table { border-collapse: collapse; background: #fff; width: 100% }
th, td { padding: 7px 12px; text-align: left; border-bottom: 1px solid #e7e5de; vertical-align: top }
th { font-size: 13px; font-weight: 600; color: #6a717b; white-space: nowrap }
.n { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap }
.grid { display: grid; gap: 16px; grid-template-columns: repeat(auto-fit, minmax(320px, 1fr)) }
.pairs { grid-template-columns: repeat(auto-fit, minmax(440px, 1fr)) }
figure { margin: 0; background: #fcfcfa; border: 1px solid #e7e5de; border-radius: 6px; overflow: hidden }
figure img { display: block; width: 100% }
figcaption { padding: 10px 14px; font-size: 14px; color: #4b525b; border-top: 1px solid #e7e5de }
.dot { display: inline-block; width: 10px; height: 10px; border-radius: 50%; margin: 0 5px 0 10px }
.bar { display: block; width: 180px; height: 16px; margin: 4px 0 }
.swatch { display: inline-block; height: 10px; background: #c2452d; border-radius: 2px }
code { font: 13px/1.5 ui-monospace, "DejaVu Sans Mono", monospace; overflow-wrap: anywhere }
"""


class Markup(str):
    """Text that is HTML already."""


def format_document(title: str, body: Sequence[str]) -> str:
    """Return a page under its title as text; every part of the body is HTML."""
    head = f'<meta charset="utf-8"><meta name="viewport" content="width=device-width"><title>{escape(title)}</title>'
    content = "\n".join([f"<h1>{escape(title)}</h1>", *body])
    return (
        f'<!doctype html>\n<html lang="en">\n<head>{POLICY}{head}<style>{STYLE}</style></head>\n'
        f"<body><main>\n{content}\n</main></body>\n</html>\n"
    )


def format_html_table(
    heads: Sequence[str], rows: Iterable[Sequence[str]], numbers: Collection[int] = (), code: Collection[int] = ()
) -> str:
    """Return a table: columns in `numbers` flush right, in `code` in fixed width."""

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
