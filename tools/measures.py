"""Measures of the code's form: density, constants, arguments, complexity, directions of imports.

    python -m tools.measures [--root CHECKOUT] [--list]

`--list` adds where the functions and imports are that the counts are about. Counted are `vio/` and
`frontend/`:

- *module constants that are numbers*: names assigned at the top of a module (fields of records
  are not) whose value is made of numbers alone: `0.5`, `-3`, `2 * 10**6`, `(3, 5)`; those *that
  decide* are not declared with a kind of `vio/numerics/kinds.py`;
- *syntax nodes a code line*: all nodes that `ast.walk` visits, over the lines that hold code, which
  docstrings and comments are not;
- *arguments*: all that a function declares, without `self`, `cls`, `*args` and `**kwargs`;
- *complexity*: one and the decisions of a function: `if`, `elif`, loops, `except`, `assert`,
  `and` and `or`, conditional expressions, the loops and conditions of comprehensions, cases of a
  `match`. This counts more than ruff's C901, which leaves out the last five. Functions inside a function count
  for themselves;
- *edges*: which module imports which, also inside functions; `tools/parts.py` has the parts.
"""

from __future__ import annotations

import argparse
import ast
import io
import sys
import tokenize
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

from tools.parts import part_of, read_edges, source_files, wrong_way

ROOT = Path(__file__).resolve().parent.parent
KINDS = ("Tolerance", "Capacity")  # of constants that decide nothing
MAX_ARGUMENTS = 7
MAX_COMPLEXITY = 10
MAX_COMPLEXITY_ANYWHERE = 20
_Function: TypeAlias = ast.FunctionDef | ast.AsyncFunctionDef
_DECISIONS = (
    ast.If,
    ast.For,
    ast.AsyncFor,
    ast.While,
    ast.ExceptHandler,
    ast.Assert,
    ast.IfExp,
    ast.match_case,
)
_NO_CODE = {
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENCODING,
    tokenize.ENDMARKER,
}


@dataclass(frozen=True, slots=True)
class FunctionForm:
    """One function, and what is counted of it."""

    place: str  # file:line name
    arguments: int
    complexity: int


@dataclass(frozen=True, slots=True)
class Measures:
    """The measures of one checkout."""

    code_lines: int
    nodes: int
    constants: tuple[str, ...]  # "module NAME"
    deciding: tuple[str, ...]  # those of no kind
    functions: tuple[FunctionForm, ...]
    tracking_imports: tuple[str, ...]
    edges: tuple[tuple[str, str], ...]
    wrong: tuple[tuple[str, str], ...]

    def functions_with_many_arguments(self) -> list[FunctionForm]:
        """Functions with more than `MAX_ARGUMENTS` arguments."""
        return [form for form in self.functions if form.arguments > MAX_ARGUMENTS]

    def functions_above(self, complexity: int) -> list[FunctionForm]:
        """Functions that are more complex than this."""
        return [form for form in self.functions if form.complexity > complexity]


def measure(root: Path) -> Measures:
    """Return the measures of a checkout."""
    code_lines = 0
    nodes = 0
    constants: list[str] = []
    deciding: list[str] = []
    functions: list[FunctionForm] = []
    for module, path in source_files(root).items():
        text = path.read_text(encoding="utf-8")
        tree = ast.parse(text)
        code_lines += len(_code_lines(text) - _lines_of(_docstrings(tree)))
        nodes += sum(1 for _ in ast.walk(tree))
        decisions = ast.Module([n for n in tree.body if kind_of(n) is None], type_ignores=[])
        constants += [f"{module} {name}" for name in number_constants(tree)]
        deciding += [f"{module} {name}" for name in number_constants(decisions)]
        functions += [
            FunctionForm(
                f"{path.relative_to(root)}:{node.lineno} {node.name}",
                count_arguments(node),
                complexity(node),
            )
            for node in ast.walk(tree)
            if isinstance(node, _Function)
        ]
    edges = read_edges(root)
    return Measures(
        code_lines=code_lines,
        nodes=nodes,
        constants=tuple(constants),
        deciding=tuple(deciding),
        functions=tuple(functions),
        tracking_imports=tuple(b for a, b in edges if a == "vio.frontend.tracking"),
        edges=tuple(edges),
        wrong=tuple(wrong_way(edges)),
    )


def number_constants(tree: ast.Module) -> Iterator[str]:
    """Yield the names at the top of a module whose values are numbers."""
    for node in tree.body:
        if isinstance(node, ast.Assign) and _is_number(node.value):
            yield from (t.id for t in node.targets if isinstance(t, ast.Name))
        elif (
            isinstance(node, ast.AnnAssign)
            and isinstance(node.target, ast.Name)
            and node.value is not None
            and _is_number(node.value)
        ):
            yield node.target.id


def kind_of(node: ast.stmt) -> str | None:
    """Return the kind that a constant is declared with, see `vio/numerics/kinds.py`; None: it
    decides.
    """
    if not (isinstance(node, ast.AnnAssign) and isinstance(node.annotation, ast.Subscript)):
        return None
    kind = node.annotation.value
    if isinstance(node.annotation.slice, ast.Subscript):  # ClassVar[Capacity[int]]
        kind = node.annotation.slice.value
    return kind.id if isinstance(kind, ast.Name) and kind.id in KINDS else None


def count_arguments(node: _Function) -> int:
    """Return how many arguments a function declares, without `self` and `cls`."""
    arguments = node.args
    positional = [*arguments.posonlyargs, *arguments.args]
    own = bool(positional) and positional[0].arg in ("self", "cls")
    return len(positional) + len(arguments.kwonlyargs) - own


def complexity(node: _Function) -> int:
    """Return one and the number of decisions of a function, without functions inside it."""
    return 1 + sum(_decisions(child) for child in _own_nodes(node))


def _decisions(node: ast.AST) -> int:
    if isinstance(node, ast.BoolOp):
        return len(node.values) - 1
    if isinstance(node, ast.comprehension):
        return 1 + len(node.ifs)
    return int(isinstance(node, _DECISIONS))


def _own_nodes(node: ast.AST) -> Iterator[ast.AST]:
    for child in ast.iter_child_nodes(node):
        if not isinstance(child, _Function):
            yield child
            yield from _own_nodes(child)


def _is_number(node: ast.expr) -> bool:
    if isinstance(node, ast.Constant):
        return isinstance(node.value, (int, float)) and not isinstance(node.value, bool)
    if isinstance(node, ast.UnaryOp):
        return _is_number(node.operand)
    if isinstance(node, ast.BinOp):
        return _is_number(node.left) and _is_number(node.right)
    if isinstance(node, ast.Tuple):
        return bool(node.elts) and all(_is_number(element) for element in node.elts)
    return False


def _docstrings(tree: ast.Module) -> list[ast.Expr]:
    owners = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    return [
        node.body[0]
        for node in ast.walk(tree)
        if isinstance(node, owners)
        and node.body
        and isinstance(node.body[0], ast.Expr)
        and isinstance(node.body[0].value, ast.Constant)
        and isinstance(node.body[0].value.value, str)
    ]


def _lines_of(nodes: list[ast.Expr]) -> set[int]:
    return {
        line for node in nodes for line in range(node.lineno, (node.end_lineno or node.lineno) + 1)
    }


def _code_lines(text: str) -> set[int]:
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    return {
        line
        for token in tokens
        if token.type not in _NO_CODE
        for line in range(token.start[0], token.end[0] + 1)
    }


def table(measures: Measures) -> str:
    """Return the measures as a table in Markdown."""
    many = len(measures.functions)
    above = len(measures.functions_above(MAX_COMPLEXITY))
    far_above = len(measures.functions_above(MAX_COMPLEXITY_ANYWHERE))
    arguments = [form.arguments for form in measures.functions_with_many_arguments()]
    between = [(a, b) for a, b in measures.edges if part_of(a) != part_of(b)]
    rows = {
        "code lines": f"{measures.code_lines:,}",
        "module constants that are numbers": f"{len(measures.constants):,}",
        "of them, constants that decide": f"{len(measures.deciding):,}",
        "syntax nodes a code line": f"{measures.nodes / max(measures.code_lines, 1):.2f}",
        "functions": f"{many:,}",
        f"functions with more than {MAX_ARGUMENTS} arguments": f"{len(arguments)} "
        f"(the most: {max(arguments, default=0)})",
        f"functions of complexity above {MAX_COMPLEXITY}": f"{above} ({above / max(many, 1):.1%})",
        f"functions of complexity above {MAX_COMPLEXITY_ANYWHERE}": f"{far_above}",
        "modules that `frontend/tracking.py` imports": f"{len(measures.tracking_imports)}",
        "imports between modules": f"{len(measures.edges):,}",
        "imports between parts": f"{len(between):,}",
        "imports of a part above": f"{len(measures.wrong)}",
    }
    return "\n".join(["| measure | |", "|---|---:|", *(f"| {k} | {v} |" for k, v in rows.items())])


def places(measures: Measures) -> str:
    """Return where the functions and imports are that the table counts."""
    forms = sorted(measures.functions_above(MAX_COMPLEXITY), key=lambda form: -form.complexity)
    lines = [f"{form.complexity:3d} complexity  {form.place}" for form in forms]
    forms = sorted(measures.functions_with_many_arguments(), key=lambda form: -form.arguments)
    lines += [f"{form.arguments:3d} arguments   {form.place}" for form in forms]
    lines += [
        f"{a} ({part_of(a)}) imports {b} ({part_of(b)}), which is above" for a, b in measures.wrong
    ]
    return "\n".join(lines)


def main() -> int:
    """Print the measures."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--root", type=Path, default=ROOT, help="the checkout (this one)")
    parser.add_argument("--list", action="store_true", help="say also where")
    args = parser.parse_args()
    measures = measure(args.root)
    print(table(measures))
    if args.list:
        print("\n" + places(measures))
    return 0


if __name__ == "__main__":
    sys.exit(main())
