"""The table of the benchmark of bands: a part measured anew renews its own rows and leaves the others."""

import sys

import pytest
from support import ROOT

BEFORE = ("# Page\n\n<!-- held against the aims: written by `./st bench` -->\n<!-- end of held against the aims -->\n\n"
          "<!-- table of held-out runs: written by `./st bench` -->\n| held out |\n|---|\n"
          "<!-- end of table of held-out runs -->\n\nAfter it.\n")


@pytest.fixture
def write(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "bench"))
    from _band_page import write
    yield write
    for name in ("_band_page", "_markers"):
        sys.modules.pop(name, None)


def row(covers, half="50.0%", worst="81% (a cell, 300)", score="1.00 | 2.00"):
    return {"90 % covers": covers, "50 % covers": half, "worst cell of 200 starts": worst, "interval score": score}


def test_rows_of_the_same_title_are_replaced_and_others_stay(write, tmp_path):
    page = tmp_path / "page.md"
    page.write_text(BEFORE, encoding="utf-8")
    a, b, c = (f"cars, linear, by {one}, forecast, conformal" for one in "abc")
    write({a: row("90.0%"), b: row("80.0%")}, page)
    write({b: row("85.0%"), c: dict.fromkeys(row(""), "-")}, page)
    lines = page.read_text(encoding="utf-8").splitlines()
    at = next(k for k, text in enumerate(lines) if "table of held-out" in text)
    shown = r" | 50.0% | 81% (a cell, 300) | 1.00 \| 2.00 |"
    assert lines[at + 3:at + 6] == [f"| {a} | 90.0%{shown}", f"| {b} | 85.0%{shown}", f"| {c} | - | - | - | - |"]
    assert lines[0] == "# Page" and lines[-1] == "After it."


def test_the_summary_spans_models_and_marks_what_is_short_of_the_aim(write, tmp_path):
    page = tmp_path / "page.md"
    page.write_text(BEFORE, encoding="utf-8")
    write({"cars, linear, by run, forecast, conformal": row("90.0%", score="1.20 | 2.00"),
           "cars, linear, by run, forecast, normal by condition": row("80.0%", score="1.00 | 2.00"),
           "cars, linear, by run, forecast, by condition, scaled to its level": row("90.0%", score="1.20 | 1.90"),
           "cars, nonlinear, by run, forecast, conformal": row("95.0%", worst="70% (a cell, 300)"),
           "cars, nonlinear, by run, forecast, normal by condition": row("82.0%"),
           "cars, nonlinear, by run, forecast, by condition, scaled to its level": row("90.0%")}, page)
    table = page.read_text(encoding="utf-8").split("held against the aims")[1].splitlines()[3:-1]
    assert table == ["| cars, by run: forecast | **90 to 95 %** | 50 % | **70 to 81 %** | 1.00 to 1.05 | "
                     "**1.00 to 1.20** | 80 to 82 % |"]
