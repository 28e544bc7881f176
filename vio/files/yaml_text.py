"""YAML of untrusted files: plain data of bounded depth and size, each key once."""

from __future__ import annotations

from typing import Any, NamedTuple

import yaml

MAX_BYTES = 2**22  # of a configuration or calibration


class _SizeLimits(NamedTuple):
    """How large a file may be."""

    # a long list of views of a calibration; aliases of aliases make a kilobyte a billion
    max_nodes: int = 20_000
    max_depth: int = 32  # the deepest known calibration has five levels


_LIMITS = _SizeLimits()


class _PlainLoader(yaml.SafeLoader):
    """Refuses what makes a small text large or deep, and duplicate keys, of which YAML itself
    would use the last.
    """

    def __init__(self, stream: str) -> None:
        super().__init__(stream)
        self._depth = 0
        self._nodes = 0  # with each alias counted as what it stands for
        self._nodes_of: dict[str, int] = {}  # of the nodes with an anchor

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        """Compose one node, within the depth and the number of nodes."""
        event = self.peek_event()  # type: ignore[no-untyped-call] # of the stubs
        before = self._nodes
        alias = isinstance(event, yaml.AliasEvent)
        self._nodes += self._nodes_of.get(event.anchor, 0) if alias else 1
        if alias and event.anchor in self.anchors and event.anchor not in self._nodes_of:
            raise self._refused(f"the value of &{event.anchor} contains itself", event)
        if self._nodes > _LIMITS.max_nodes:
            raise self._refused(f"more than {_LIMITS.max_nodes} values", event)
        if self._depth >= _LIMITS.max_depth:
            raise self._refused(f"nested deeper than {_LIMITS.max_depth} levels", event)
        self._depth += 1
        try:
            node = super().compose_node(parent, index)
        finally:
            self._depth -= 1
        if not alias and event.anchor is not None:
            self._nodes_of[event.anchor] = self._nodes - before
        return node

    @staticmethod
    def _refused(why: str, event: Any) -> yaml.composer.ComposerError:
        return yaml.composer.ComposerError(None, None, why, event.start_mark)

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """Reject a duplicate key."""
        if isinstance(node, yaml.MappingNode):
            seen: set[str] = set()
            for key in (key for key, _ in node.value if isinstance(key, yaml.ScalarNode)):
                if key.value in seen:
                    raise yaml.constructor.ConstructorError(
                        None, None, f"'{key.value}' is given twice", key.start_mark
                    )
                seen.add(key.value)
        return super().construct_mapping(node, deep)


def _whole_number(loader: yaml.SafeLoader, node: yaml.ScalarNode) -> int | str:
    """Return a whole number as YAML 1.2 has it, and people read it: to YAML 1.1 010 is 8, and 1:30
    is 90.
    """
    digits = node.value.lstrip("+-").replace("_", "")
    if ":" in digits:
        return node.value
    size = int(digits, 0) if digits[:2] in ("0x", "0b") else int(digits)
    return -size if node.value.startswith("-") else size


def _number(loader: yaml.SafeLoader, node: yaml.ScalarNode) -> float | str:
    """Return a number; text that YAML 1.1 takes for one to the base of 60 as it is."""
    return node.value if ":" in node.value else loader.construct_yaml_float(node)


_PlainLoader.add_constructor("tag:yaml.org,2002:int", _whole_number)
_PlainLoader.add_constructor("tag:yaml.org,2002:float", _number)


def read_yaml(text: str) -> Any:
    """Return the data of a YAML text.

    Raises:
        ValueError: it is no YAML, or more than plain data; the message is one line and names line
            and column.
    """
    try:
        return yaml.load(text, Loader=_PlainLoader)
    except yaml.YAMLError as error:
        raise ValueError(" ".join(str(error).split())) from error
    except (ValueError, TypeError, KeyError, AttributeError, IndexError, OverflowError) as error:
        # PyYAML lets these through for tagged or malformed scalars: a 13th month, !!bool maybe,
        # 5000 digits
        raise ValueError(
            f"a value does not fit its type: {' '.join(str(error).split())}"
        ) from error
