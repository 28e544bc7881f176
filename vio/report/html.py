"""The frame of a self-contained HTML page: style, tables and images."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Collection, Mapping, Sequence
from html import escape

from vio._version import __version__
from vio.files.printable import printable

STYLE = """
:root { color-scheme: light; }
body { font: 15px/1.5 system-ui, sans-serif; color: #1d2733; background: #f4f6f8; margin: 0; }
main { max-width: 1180px; margin: 0 auto; padding: 24px; }
h1 { font-size: 24px; margin: 0 0 4px; } h2 { font-size: 18px; margin: 0 0 4px; }
section { background: #fff; border: 1px solid #dfe4ea; border-radius: 6px; padding: 16px 20px; margin: 16px 0; }
p { margin: 4px 0; } .remark { color: #5b6876; font-size: 13px; }
table { border-collapse: collapse; } th, td { text-align: left; padding: 3px 18px 3px 0; font-weight: normal; }
thead th { border-bottom: 1px solid #c4ccd5; font-weight: 600; } tbody th { color: #5b6876; }
td { font-variant-numeric: tabular-nums; } li { margin: 3px 0; overflow-wrap: anywhere; }
.swatch { display: inline-block; width: 11px; height: 11px; border-radius: 2px; margin-right: 6px; }
.scroll { overflow-x: auto; } .figure img { min-width: 900px; }
img { max-width: 100%; } code { overflow-wrap: anywhere; }
@media (max-width: 600px) { main { padding: 8px; } .modebar { display: none !important; } }
"""


def document(title: str, parts: Sequence[str], head: str = "") -> str:
    """Return a page with a title (plain text), sections and further HTML for its head."""
    return (
        f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><title>{text(title)}</title>'
        '<meta name="viewport" content="width=device-width, '
        f'initial-scale=1"><style>{STYLE}</style>'
        f"{head}</head>\n<body><main><h1>{text(title)}</h1>"
        f'<p class="remark">stereo-vio {text(__version__)}</p>\n'
        + "\n".join(parts)
        + "\n</main></body></html>\n"
    )


def table(
    title: str,
    columns: Sequence[str],
    rows: Mapping[str, Sequence[str]],
    bold: Collection[tuple[str, int]] = (),
    remark: str = "",
) -> str:
    """Return a section with a table of named columns and rows; `bold`: cells by row and column."""
    head = "".join(f"<th>{text(name)}</th>" for name in columns)
    body = ""
    for name, cells in rows.items():
        body += f"<tr><th>{text(name)}</th>"
        for k, cell in enumerate(cells):
            inner = text(cell)
            body += f"<td><b>{inner}</b></td>" if (name, k) in bold else f"<td>{inner}</td>"
        body += "</tr>"
    said = f'<p class="remark">{text(remark)}</p>' if remark else ""
    grid = f"<table><thead><tr><th></th>{head}</tr></thead><tbody>{body}</tbody></table>"
    return f'<section><h2>{title}</h2>{said}<div class="scroll">{grid}</div></section>'


def image(data: bytes, kind: str, words: str) -> str:
    """Return an image that the page holds itself; `kind` is `png` or `jpeg`."""
    encoded = b64encode(data).decode("ascii")
    return f'<img alt="{text(words)}" src="data:image/{kind};base64,{encoded}">'


def text(value: str) -> str:
    """Return text for HTML; control characters and surrogates of file names are escaped."""
    return escape(printable(value))
