"""The tables of a bench for a paper: our Markdown as LaTeX with booktabs."""

from __future__ import annotations

import re

_SPECIAL = {
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_", "{": r"\{", "}": r"\}",
    "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "±": r"$\pm$", "–": "--", "°": r"$^\circ$", "×": r"$\times$",
}  # fmt: skip


def latex_of(markdown: str) -> str:
    """Return each table of a text of `vio.bench.tables` as LaTeX, with its heading and its paragraphs as comments.

    The preamble of the paper needs the packages booktabs and inputenc with utf8.
    """
    lines = ["% \\usepackage{booktabs}"]
    for line in markdown.splitlines():
        if re.fullmatch(r"\|[-:|]+\|", line):
            head = lines.pop()
            columns = ["r" if rule.endswith(":") else "l" for rule in line.strip("|").split("|")]
            lines += [rf"\begin{{tabular}}{{{''.join(columns)}}}", r"\toprule", head, r"\midrule"]
        elif line.startswith("| "):
            lines.append(" & ".join(_escaped(cell) for cell in cells_of(line)) + r" \\")
        else:
            if lines[-1].endswith(r"\\"):
                lines += [r"\bottomrule", r"\end{tabular}"]
            lines.append(f"% {line}".rstrip() if line else "")
    if lines[-1].endswith(r"\\"):
        lines += [r"\bottomrule", r"\end{tabular}"]
    return "\n".join(lines) + "\n"


def cells_of(line: str) -> list[str]:
    """Return the cells of a line of a Markdown table."""
    return [cell.strip().replace("\\|", "|") for cell in re.split(r"(?<!\\)\|", line)[1:-1]]


def _escaped(cell: str) -> str:
    bold = re.fullmatch(r"\*\*(.+)\*\*", cell)
    text = "".join(_SPECIAL.get(letter, letter) for letter in (bold[1] if bold else cell))
    return rf"\textbf{{{text}}}" if bold else text
