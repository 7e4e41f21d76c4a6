"""Pages made from the code are up to date, and say what the code says."""

import re

import pytest
import yaml

pytest.importorskip("rclpy", reason="needs ROS 2")
pytest.importorskip("st_msgs", reason="needs the built workspace")

from st_predictor import params
from support import ROOT

from tools import gallery, reference
from tools.__main__ import commands

pytestmark = pytest.mark.ros
DOCS = ROOT / "docs"


def test_the_reference_is_what_the_code_says() -> None:
    assert (DOCS / "reference.md").read_text() == reference.reference_page(commands()), "run ./st docs"


def test_the_reference_holds_every_parameter_and_every_field() -> None:
    page = reference.reference_page(commands())
    for parameter in params.PREDICTOR + params.RECORDER:
        assert f"| `{parameter.name}` |" in page
    for file in (ROOT / "ros2_ws/src/st_msgs/msg").glob("*.msg"):
        section = page.split(f"### st_msgs/msg/{file.stem}\n")[1].split("\n#")[0]
        fields = [line for line in file.read_text().splitlines() if line.strip() and not line.startswith("#")]
        assert section.count("\n| `") == len(fields), file.name
    assert "| `longitudinal` | float64[] | m, NaN where not scored |" in page


def test_every_node_of_the_parameter_file_is_in_the_reference() -> None:
    assert reference.NODES.keys() == yaml.safe_load((ROOT / "config" / "nodes.yaml").read_text()).keys()


def test_a_cell_keeps_its_bars_and_a_line_that_is_no_field_is_refused(tmp_path) -> None:
    assert reference.table(("a",), [("x|y",)]) == "| a |\n| --- |\n| x\\|y |\n"
    (tmp_path / "Odd.msg").write_text("float64 = x\n")
    with pytest.raises(ValueError, match=r"Odd\.msg: float64 = x"):
        list(reference.describe_messages(tmp_path))


def test_every_picture_and_page_that_is_linked_is_there() -> None:
    for page in (ROOT / "README.md", *DOCS.rglob("*.md")):
        for target in re.findall(r"\]\(([^)#:]+)\)", page.read_text()):
            assert (page.parent / target).exists(), f"{page.name}: {target}"


def test_the_gallery_shows_each_command_with_its_picture() -> None:
    text = (DOCS / "gallery.md").read_text()
    assert text == gallery.gallery_page(), "run ./st docs"
    for command in (c for e in gallery.EXHIBITS for c in (*e.before, e.command)):
        assert f"$ {command.replace('{}', 'runs/gallery')}" in text


def test_commands_that_are_shown_have_the_options_they_are_shown_with() -> None:
    """Every `./st VERB --option` in README and docs/ exists."""
    verbs = commands().commands
    seen = 0
    for page in (ROOT / "README.md", *DOCS.rglob("*.md")):
        for verb, rest in re.findall(r"\./st (\w+)([^`|\n]*)", page.read_text()):
            if page.name == "reference.md" or verb in ("shell", "test", "bench"):  # these hand options on
                continue
            assert verb in verbs, f"{page.name}: ./st {verb}"
            known = {name for p in verbs[verb].params for name in (*p.opts, *p.secondary_opts)}
            for option in re.findall(r"(?<![\w-])--[a-z][\w-]*", rest.partition("#")[0]):
                seen += 1
                assert option in known, f"{page.name}: ./st {verb} {option}"
    assert seen > 20
