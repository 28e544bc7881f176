"""What the documentation site adds to mkdocs: mathematics as MathML, which needs neither a
script nor a network.
"""

from __future__ import annotations

import re
from html import unescape
from typing import Any


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
    math = convert(
        re.sub(r"\\tag\{\w+\}", "", latex).strip(), display="block" if display else "inline"
    )
    if not display:
        return str(math)
    tag = "" if number is None else f'<span id="{number[1].lower()}">({number[1]})</span>'
    return f'<div class="equation">{math}{tag}</div>'
