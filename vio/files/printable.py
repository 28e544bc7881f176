"""Text for terminals and files from names that the system allows but text does not: bytes that are
not UTF-8, controls.

Python holds a byte of a file name that is not UTF-8 as a lone surrogate, which neither UTF-8 nor
JSON can express.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any


def printable(text: object) -> str:
    r"""Return the text in one line: a foreign byte as `\xff`, a control character as `\n`,
    `\x1b`, …
    """
    given = str(text)
    if given.isprintable():
        return given
    return "".join(c if c.isprintable() else _escaped(c) for c in given)


def _escaped(character: str) -> str:
    code = ord(character)
    if 0xDC80 <= code <= 0xDCFF:  # PEP 383: a byte that could not be decoded
        return f"\\x{code - 0xDC00:02x}"
    return character.encode("unicode_escape").decode("ascii")


def json_text(facts: Any, indent: int | None = None) -> str:
    """Return JSON whose texts are printable, so that every reader of JSON takes it."""
    return json.dumps(_plain(facts), indent=indent)


def _plain(value: Any) -> Any:
    if isinstance(value, str):
        return printable(value)
    if isinstance(value, Mapping):
        return {
            key if key is None or isinstance(key, (int, float)) else printable(key): _plain(item)
            for key, item in value.items()
        }
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    return value
