"""The tables of benches in the documents against docs/bench_results.json."""

from __future__ import annotations

import re
from pathlib import Path

from tools.bench_results import DOCUMENTS, REAL, RENDERED, ROOT, TABLES, Benches, read_figures, with_tables


def test_documents_say_what_was_measured() -> None:
    benches = Benches(read_figures())
    for name in DOCUMENTS:
        text = (ROOT / name).read_text(encoding="utf-8")
        assert with_tables(text, benches) == text, f"{name}: write its tables with make results RESULTS=--tables"


def test_every_table_stands_in_a_document_and_a_changed_figure_is_found() -> None:
    texts = {name: (ROOT / name).read_text(encoding="utf-8") for name in DOCUMENTS}
    marked = re.findall(r"<!-- bench: (\w+) -->", "".join(texts.values()))
    assert sorted(marked) == sorted(TABLES)
    assert sum(text.count("<!-- end bench -->") for text in texts.values()) == len(marked)
    benches = Benches(read_figures())
    for name, text in texts.items():
        wrong = re.sub(r"(<!-- bench: \w+ -->\n.*?\n.*?\n\|[^\n]*?)0\.", r"\g<1>9.", text, count=1, flags=re.DOTALL)
        assert wrong != text
        assert with_tables(wrong, benches) != wrong, name


def test_every_row_beside_other_systems_was_measured() -> None:
    benches = Benches(read_figures())
    for line in (*REAL, *RENDERED):
        for system in (line.ours, *line.peers.values()):
            row = benches.row(line.suite, line.sequence, system)
            assert row is not None, (line.label, system)
            assert row.failed == 0


def test_the_command_of_ci_runs_the_small_suite() -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    assert re.search(r"^bench:.*\n\t\$\(BIN\)/vio bench small ", makefile, re.MULTILINE)
    assert "make bench" in Path(ROOT / ".ci" / "run").read_text(encoding="utf-8")
