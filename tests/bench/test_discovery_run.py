"""Many cases: shared out, resumed, a case that fails is a result."""

import json
import time
from dataclasses import fields

import pytest
from st_core.discovery.limits import Limits

from bench.discovery import ablation, command, run
from bench.discovery.cases import COUNTS, cases_of


def test_two_processes_share_all_cases_out():
    counts = {"A": 4, "B": 3, "C": 2, "D": 20, "E": 3, "F": 5}
    whole = [run.key_of(c) for c in run.in_fair_order("development", counts)]
    parts = [[run.key_of(c) for c in run.in_fair_order("development", counts, (k, 2))] for k in range(2)]
    assert len(set(whole)) == len(whole) == sum(counts.values()) + 1
    assert sorted(parts[0] + parts[1]) == sorted(whole)
    first = [block for _, block, _ in whole[:20]]
    assert set("ABCEF") <= set(first)


def test_what_is_in_the_file_is_not_computed_again(tmp_path):
    file = tmp_path / "records.jsonl"
    known = {"set": "development", "block": "A", "index": 1, "outcome": "none"}
    file.write_text(json.dumps(known) + "\n")
    said = []
    records = run.run_all(cases_of("development", "A", 2)[1:], file, time.time() - 1, said.append)
    assert records == [known] and not said
    assert run.run_all(cases_of("development", "A", 1), file, time.time() - 1, said.append) == []


def test_of_several_files_the_last_answer_to_a_case_counts(tmp_path):
    old, new = tmp_path / "old.jsonl", tmp_path / "new.jsonl"
    case = {"set": "development", "block": "A", "index": 1, "version": "old"}
    old.write_text("".join(json.dumps(r) + "\n" for r in (case, {**case, "index": 2})))
    new.write_text(json.dumps({**case, "version": "new"}) + "\n")
    halved = tmp_path / "halved.jsonl"
    halved.write_text(json.dumps({**case, "limit": ["sure", 0.5]}) + "\n")
    found = [(r["index"], r["version"], "limit" in r) for r in run.read_all([old, new, halved])]
    assert found == [(1, "new", False), (2, "old", False), (1, "old", True)]


@pytest.mark.slow
def test_an_answer_that_raises_is_a_wrong_answer(tmp_path):
    class Broken(Limits):
        def __getattribute__(self, name):
            if name in {f.name for f in fields(Limits)}:
                raise RuntimeError("limits out of reach")
            return super().__getattribute__(name)
    broken = object.__new__(Broken)
    said = []
    record, = run.run_all(cases_of("development", "A", 1), tmp_path / "x.jsonl", None, said.append, broken)
    assert record["outcome"] == "error" and "out of reach" in record["error"]
    assert record["hidden"] and said == [record]


def test_every_limit_is_halved_and_doubled():
    variants = ablation.variants()
    assert len(variants) == 1 + 2 * len(fields(Limits))
    assert variants[0][2] == Limits()
    for name, factor, limits in variants[1:]:
        others = [f.name for f in fields(Limits) if getattr(limits, f.name) != getattr(Limits(), f.name)]
        assert others == [name]
        assert getattr(limits, name) == pytest.approx(getattr(Limits(), name) * factor, rel=0.01)


def test_options():
    assert command._counts("A=3,F=1") == {"A": 3, "F": 1}
    assert command._part("2/3") == (1, 3)
    assert set(COUNTS) == set("ABCDEF") and COUNTS["B"] == 120
    with pytest.raises(SystemExit):
        command.main(["--counts", "Z=1"])
