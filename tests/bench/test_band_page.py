"""The table of the benchmark of bands: a part measured anew renews its own rows and leaves the others."""

import sys

import pytest
from support import ROOT

BEFORE = ("# Page\n\n<!-- table of held-out runs: written by `./st bench` -->\n| held out |\n|---|\n"
          "<!-- end of table of held-out runs -->\n\nAfter it.\n")


@pytest.fixture
def write(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "bench"))
    from _band_page import write
    yield write
    for name in ("_band_page", "_markers"):
        sys.modules.pop(name, None)


def test_rows_of_the_same_title_are_replaced_and_others_stay(write, tmp_path):
    page = tmp_path / "page.md"
    page.write_text(BEFORE, encoding="utf-8")
    write({"a": {"covers": "90 %", "score": "1 | 2"}, "b": {"covers": "80 %", "score": "3 | 4"}}, page)
    write({"b": {"covers": "85 %", "score": "5 | 6"}, "c": {"covers": "70 %", "score": "-"}}, page)
    lines = page.read_text(encoding="utf-8").splitlines()
    assert lines[3:8] == ["| held out | covers | score |", "|---|---|---|", "| a | 90 % | 1 \\| 2 |",
                          "| b | 85 % | 5 \\| 6 |", "| c | 70 % | - |"]
    assert lines[0] == "# Page" and lines[-1] == "After it."
