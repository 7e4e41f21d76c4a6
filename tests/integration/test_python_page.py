"""The examples of docs/manual/python.md run in sequence in one namespace."""

import re

import pytest
from support import ROOT

PAGE = ROOT / "docs" / "manual" / "python.md"


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_examples_of_the_page_run() -> None:
    blocks = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
    assert len(blocks) == 9
    names: dict[str, object] = {}
    for block in blocks:
        exec(compile(block, str(PAGE), "exec"), names)
    assert len(names["logs"]) == 3
    assert names["path"].states.shape == (101, 6)
    assert abs(names["planned"].states[-1, 5] - 0.1) < 0.03  # rad/s: 10 m/s on a curvature of 0.01 1/m
    assert 0.0 < names["rmse"] < 3.0
    assert names["corrected"].errors[names["model"].name, "hindsight"].statistics("lateral")[2] < names["rmse"]
    assert names["discovery"].outcome
