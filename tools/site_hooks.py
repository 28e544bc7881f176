"""What the documentation site adds to mkdocs: mathematics as MathML, which needs neither a
script nor a network, and the page of bad inputs, which is made of the tests.
"""

from __future__ import annotations

import functools
import re
import sys
from html import unescape
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files

_ROOT = str(Path(__file__).resolve().parents[1])


def on_files(files: Files, *, config: MkDocsConfig) -> Files:
    """Return the site's files with the page of bad inputs, which is made of the tests."""
    from mkdocs.structure.files import File

    if _ROOT not in sys.path:
        sys.path.insert(0, _ROOT)
    from tools.bad_inputs import PAGE

    files.append(File.generated(config, PAGE, content=_bad_inputs()))
    return files


@functools.cache
def _bad_inputs() -> str:
    from tools.bad_inputs import page

    return page()


def on_page_content(html: str, **_: Any) -> str:
    r"""Return a page with the LaTeX that arithmatex marked as MathML; `\tag{M1}` becomes the
    number at the right.
    """
    return re.sub(r'<(span|div) class="arithmatex">(.*?)</\1>', _converted, html, flags=re.DOTALL)


def _converted(found: re.Match[str]) -> str:
    from latex2mathml.converter import convert

    display = found.group(1) == "div"
    latex = re.sub(r"^\\[(\[]|\\[)\]]$", "", unescape(found.group(2)).strip()).strip()
    number = re.search(r"\\tag\{(\w+)\}", latex)
    latex = re.sub(r"\\tag\{\w+\}", "", latex).strip()
    if not display:
        return str(convert(latex, display="inline"))
    math = "".join(convert(part, display="block") for part in _apart(latex))
    tag = "" if number is None else f'<span id="{number[1].lower()}">({number[1]})</span>'
    return f'<div class="equation"><div class="formulas">{math}</div>{tag}</div>'


def _apart(latex: str) -> list[str]:
    r"""Return the formulas that `\quad` and `\qquad` put side by side, so that each may have a line
    of its own where the page is narrow; those inside of brackets and environments stay.
    """
    parts = [""]
    depth = 0
    for token in re.split(r"(\\q?quad\b|\\begin\b|\\end\b|\\left\b|\\right\b|\\[{}]|[{}])", latex):
        if token in (r"\quad", r"\qquad") and depth == 0:
            parts.append("")
            continue
        depth += token in ("{", r"\begin", r"\left")
        depth -= token in ("}", r"\end", r"\right")
        parts[-1] += token
    return [part.strip() for part in parts if part.strip()]
