"""Write docs/settings.md: the basic settings, and the others in groups.

python tools/settings_page.py > docs/settings.md
"""

from __future__ import annotations

import argparse
import re
import sys

from vio.config import BASIC, Config, SettingInfo, describe

_INTRODUCTION = """# Settings

Settings come from the defaults, a YAML file that holds deviations only (`--config FILE`), and `--set a.b=value`, in
that order. `--config fast` is a preset for small computers ([performance.md](performance.md)). `vio config --all`
prints every one with its range; a run's folder holds those in effect. This page is written by
`python tools/settings_page.py`.
"""
_HEAD = "| setting | default | unit | meaning |\n|---|---:|---|---|\n"
_WORDS = {None: "null", True: "true", False: "false"}


def page() -> str:
    """Return the text of the page."""
    rows = list(describe(Config()))
    others = [row for row in rows if row.key not in BASIC]
    parts = [
        _INTRODUCTION,
        "## Basic settings\n\n" + _table([row for row in rows if row.key in BASIC]),
    ]
    for section in dict.fromkeys(row.key.rpartition(".")[0] for row in others):
        chosen = [row for row in others if row.key.rpartition(".")[0] == section]
        parts.append(f"## Others: `{section}`\n\n" + _table(chosen))
    return "\n".join(parts)


def _table(rows: list[SettingInfo]) -> str:
    cells = ((row.key, _default(row.default), row.unit, _meaning(row)) for row in rows)
    return _HEAD + "".join(
        f"| `{key}` | {default} | {unit} | {doc} |\n" for key, default, unit, doc in cells
    )


def _default(value: object) -> str:
    if value is None or isinstance(value, bool):
        return _WORDS[value]
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _meaning(row: SettingInfo) -> str:
    words = set(re.findall(r"\w+", f"{row.doc} {row.default}"))
    untold = row.choices if row.choices and not set(row.choices) <= words else ()
    choices = f" (one of {', '.join(untold)})" if untold else ""
    return f"{row.doc}{choices}".replace("|", "\\|")


def main() -> int:
    """Print the page."""
    argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    ).parse_args()
    print(page(), end="")
    return 0


if __name__ == "__main__":
    sys.exit(main())
