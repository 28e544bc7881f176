"""Make the exercises of the course kit from their solutions: `X_solution.ipynb` becomes `X.ipynb`.

python -m tools.exercises

What stands between `# begin solution` and `# end solution` is left out, and so is what the cells
printed.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).resolve().parent.parent / "vio" / "course"
_SOLUTION = re.compile(r"^( *)# begin solution\n.*?# end solution", re.DOTALL | re.MULTILINE)
_TASK = r'\1raise NotImplementedError("your solution")'


def exercise(solution: str) -> str:
    """Return the notebook of the tasks, of the one with the solutions (both as text)."""
    notebook: dict[str, Any] = json.loads(solution)
    for cell in notebook["cells"]:
        if cell["cell_type"] == "code":
            cell["source"] = _SOLUTION.sub(_TASK, "".join(cell["source"])).splitlines(keepends=True)
            cell["outputs"] = []
            cell["execution_count"] = None
    return json.dumps(notebook, indent=1, ensure_ascii=False) + "\n"


def pairs() -> list[tuple[Path, Path]]:
    """Return the files of solutions, each with that of its exercise."""
    return [
        (path, path.with_name(path.name.replace("_solution", "")))
        for path in FOLDER.glob("*_solution.ipynb")
    ]


def main() -> int:
    """Write all exercises."""
    argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    ).parse_args()
    for solution, tasks in pairs():
        tasks.write_text(exercise(solution.read_text(encoding="utf-8")), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
