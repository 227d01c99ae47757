"""The log of reports: each row names tests that exist."""

import re
from pathlib import Path

HERE = Path(__file__).parent
ROWS = [line for line in (HERE / "README.md").read_text().splitlines() if line.startswith("|") and "---" not in line]
NAMED = re.compile(r"`(test_\w+\.py)::(test_\w+)`")


def test_each_row_of_the_log_names_a_test_that_exists():
    rows = [row for row in ROWS if not row.startswith("| report |")]
    assert rows
    for row in rows:
        assert len(re.split(r"(?<!\\)\|", row)) == 6, row
        named = NAMED.findall(row)
        assert named, row
        for file, test in named:
            found = [path for path in HERE.parent.rglob(file) if f"def {test}(" in path.read_text()]
            assert found, f"{file}::{test}"


def test_each_test_of_a_report_stands_in_the_log():
    named = {test for row in ROWS for _, test in NAMED.findall(row)}
    for path in HERE.glob("test_*.py"):
        if path.name != "test_log.py":
            assert not set(re.findall(r"^def (test_\w+)\(", path.read_text(), re.M)) - named, path
