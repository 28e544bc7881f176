"""YAML of untrusted files: plain data of a bounded depth, without aliases, each key once."""

from __future__ import annotations

from typing import Any

import yaml

MOST_BYTES = 2**22  # of a configuration or calibration
_MOST_DEPTH = 32  # the deepest known calibration has five levels


class _PlainLoader(yaml.SafeLoader):
    """Refuses what makes a small text large (aliases) or deep, and duplicate keys, of which YAML would use the last."""

    _depth = 0

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        """Compose one node, within the depth and without aliases."""
        event = self.peek_event()  # type: ignore[no-untyped-call] # of the stubs
        if isinstance(event, yaml.AliasEvent):
            why = f"aliases such as *{event.anchor} are not read; write the value"
            raise yaml.composer.ComposerError(None, None, why, event.start_mark)  # type: ignore[arg-type]
        if self._depth >= _MOST_DEPTH:
            raise yaml.composer.ComposerError(None, None, f"nested deeper than {_MOST_DEPTH} levels", event.start_mark)
        self._depth += 1
        try:
            return super().compose_node(parent, index)
        finally:
            self._depth -= 1

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """Reject a duplicate key."""
        if isinstance(node, yaml.MappingNode):
            seen: set[str] = set()
            for key in (key for key, _ in node.value if isinstance(key, yaml.ScalarNode)):
                if key.value in seen:
                    raise yaml.constructor.ConstructorError(None, None, f"'{key.value}' is given twice", key.start_mark)
                seen.add(key.value)
        return super().construct_mapping(node, deep)


def read_yaml(text: str) -> Any:
    """Return the data of a YAML text.

    Raises:
        ValueError: it is no YAML, or more than plain data; the message is one line and names line and column.
    """
    try:
        return yaml.load(text, Loader=_PlainLoader)
    except yaml.YAMLError as error:
        raise ValueError(" ".join(str(error).split())) from error
    except (ValueError, TypeError, KeyError, AttributeError, IndexError, OverflowError) as error:
        # PyYAML lets these through for tagged or malformed scalars: a 13th month, !!bool maybe, 5000 digits
        raise ValueError(f"a value does not fit its type: {' '.join(str(error).split())}") from error
