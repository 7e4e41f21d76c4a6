"""Tables that benchmarks write to the pages of measurements."""

import csv

import pytest
from support import ROOT

from bench.bands.page import COVERAGE_90, write_rows
from bench.discovery.tables import ABLATED, format_ablation
from bench.strangers.ablation import page_table
from bench.strangers.command import page_tables, write_cases

PAGES = ROOT / "docs" / "measurements"


def make_line(case, number="", factor=1.0, changed=False, statements=3):
    return {"case": case, "number": number, "factor": factor, "changed": changed, "named": 1, "hidden": 1, "false": 0,
            "statements": statements, "inside": 2, "values": 2, "in band": 20, "points": 22, "regions": 5}


def test_ablation_table_contains_only_limits_that_change_a_case():
    lines = [make_line("a"), make_line("a", "NU", 0.5, True, 2), make_line("a", "NU", 2.0),
             make_line("a", "DRAWS", 0.5), make_line("a", "DRAWS", 2.0)]
    text = page_table(lines)
    assert "| `NU` × 0.5 | 1 of 1 | 0 of 2 |" in text and "| unchanged |" in text and "error regions" not in text
    assert "| `DRAWS`" not in text and text.endswith("Without effect on any count: `NU` × 2, `DRAWS`.")


def test_the_newest_line_of_a_case_counts():
    text = page_table([make_line("a"), make_line("a", "NU", 0.5), make_line("a", "NU", 0.5, True, 2)])
    assert "| `NU` × 0.5 | 1 of 1 | 0 of 2 | 2 of 2 | 20 of 22 | 1 of 1 |" in text and text.endswith("none.")


def test_scores_and_limits_equal_to_unchanged_follow_the_table():
    equal = tuple(f"{k} %" for k in range(len(ABLATED)))
    text = format_ablation({"unchanged": equal, "relevant x 0.5": equal, "relevant x 2": ("9 %", *equal[1:])})
    head, *rows = text.split("\n\n")[0].splitlines()
    assert head == f"| limit | {ABLATED[0]} |" and rows[1:] == ["| unchanged | 0 % |", "| relevant x 2 | 9 % |"]
    assert "As unchanged: relevant x 0.5." in text and f"{ABLATED[1]}, 1 %" in text


@pytest.mark.parametrize("half", ["development", "sealed"])
def test_page_lists_the_wrong_statements_of_the_cases(half, tmp_path):
    file = PAGES / f"strangers_{half}.csv"
    with file.open(encoding="utf-8", newline="") as stream:
        cases = list(csv.DictReader(stream))
    wrong = page_tables({"cases": len(cases)}, cases).split("\n\n")[1]
    assert wrong in (PAGES / "strangers.md").read_text(encoding="utf-8") and len(cases) == 60
    write_cases(cases, tmp_path / "cases.csv")
    assert (tmp_path / "cases.csv").read_bytes() == file.read_bytes()


def test_rows_of_bands_and_their_summary_are_replaced(tmp_path):
    page, file = tmp_path / "bands.md", tmp_path / "bands_held_out.csv"
    for copy in (page, file):
        copy.write_bytes((PAGES / copy.name).read_bytes())
    with file.open(encoding="utf-8", newline="") as stream:
        rows = {row[0]: row[1:] for row in csv.reader(stream)}
    title = "Genesis, linear, by day, hindsight, conformal"
    row = dict(zip(rows["held out"], rows[title], strict=True))
    write_rows({title: row}, page, file)
    assert page.read_bytes() == (PAGES / page.name).read_bytes()
    assert file.read_bytes() == (PAGES / file.name).read_bytes()
    write_rows({title: {**row, COVERAGE_90: "50.0%"}}, page, file)
    assert "| Genesis, by day: hindsight | **50 to 94 %** |" in page.read_text(encoding="utf-8")
    assert file.read_text(encoding="utf-8").count("50.0%") == (PAGES / file.name).read_text().count("50.0%") + 1
