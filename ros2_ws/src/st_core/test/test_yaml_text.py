"""YAML of configuration files: accepted values, and one-line errors for everything else."""

import pytest
from st_core.errors import ConfigurationError
from st_core.yaml_text import load

ALIAS_BOMB = "[&a [x, x], " + ", ".join(f"&{chr(98 + k)} [*{chr(97 + k)}, *{chr(97 + k)}]" for k in range(20)) + "]"


def test_plain_values():
    text = "a: 1\nb: [1.5, -.inf, text, 'quoted', true, null]\nc: {d: 2001-02-03, e: {}}\n# a remark\n"
    document = load(text)
    assert document["a"] == 1
    assert document["b"] == [1.5, float("-inf"), "text", "quoted", True, None]
    assert str(document["c"]["d"]) == "2001-02-03" and document["c"]["e"] == {}
    assert load("") is None


@pytest.mark.parametrize(("text", "message"), [
    ("a: [", "not valid YAML, line 1: "),
    ("a: 1\na: 2", "a: given twice (line 2); remove one"),
    ("1: 2", "1: a key must be a string (line 1)"),
    ("a: {value: 1,5}", "5: a key must be a string (line 1); write decimal points, not commas"),
    ("[a, b]: 2", "['a', 'b']: a key must be a string (line 1)"),
    ("<<: {a: 1}", "merging (<<) is not allowed (line 1)"),
    ('"a\\nb": 1', "'a\\nb': a key must be printable (line 1)"),
    ('"\\e[2J": 1', "a key must be printable"),
    ("a: &x 1\nb: *x", "anchors (&) and aliases (*) are not allowed (line 1)"),
    ("a: *x", "anchors (&) and aliases (*) are not allowed (line 1)"),
    ("a: " + ALIAS_BOMB, "anchors (&) and aliases (*) are not allowed (line 1)"),
    ("a: !!python/object/apply:os.system [id]", "tags (!) are not allowed (line 1)"),
    ("a: !!int abc", "tags (!) are not allowed (line 1)"),
    ("a: 2001-99-99", "'2001-99-99': month must be in 1..12 (line 1)"),
    ("a: " + "9" * 30, "number too large (line 1)"),
    ("a: " + "9" * 5000, "(line 1)"),
    ("a: 1\n---\nb: 1", "not valid YAML, line 2: "),
    ("a: " + "[" * 41 + "]" * 41, "more than 40 levels of nesting (line 1)"),
    ("[" * 100_000, "levels of nesting"),
    ("a: '" + "x" * (1 << 20) + "'", "characters are too many"),
    ("a: \0", "not valid YAML: unacceptable character #x0000"),
    ("%YAML 9.9\n---\na: 1", "not valid YAML, line 1: "),
])
def test_other_yaml_is_rejected_in_one_line(text, message):
    with pytest.raises(ConfigurationError) as caught:
        load(text)
    assert message in str(caught.value)
    assert str(caught.value).isprintable() and len(str(caught.value)) < 300


def test_forty_levels_of_nesting_are_accepted():
    assert load("[" * 40 + "]" * 40)
