"""Pages generated from the code are up to date, and the commands shown on pages exist."""

import re

import pytest
import yaml

pytest.importorskip("rclpy", reason="needs ROS 2")
pytest.importorskip("st_msgs", reason="needs the built workspace")

from st_predictor import params
from support import ROOT

from tools import gallery, reference
from tools.__main__ import collect_commands

pytestmark = pytest.mark.ros
DOCS = ROOT / "docs"


def test_reference_page_is_up_to_date() -> None:
    assert (DOCS / "reference.md").read_text() == reference.make_reference_page(collect_commands()), "run ./st docs"


def test_reference_lists_every_parameter_and_message_field() -> None:
    page = reference.make_reference_page(collect_commands())
    for parameter in params.PREDICTOR + params.RECORDER:
        assert f"| `{parameter.name}` |" in page
    for file in (ROOT / "ros2_ws/src/st_msgs/msg").glob("*.msg"):
        section = page.split(f"### st_msgs/msg/{file.stem}\n")[1].split("\n#")[0]
        fields = [line for line in file.read_text().splitlines() if line.strip() and not line.startswith("#")]
        assert section.count("\n| `") == len(fields), file.name
    assert "| `longitudinal` | float64[] | m, NaN where not scored |" in page


def test_reference_covers_every_node_of_the_parameter_file() -> None:
    assert reference.NODES.keys() == yaml.safe_load((ROOT / "config" / "nodes.yaml").read_text()).keys()


def test_bars_in_table_cells_are_escaped_and_an_invalid_message_line_is_rejected(tmp_path) -> None:
    assert reference.format_table(("a",), [("x|y",)]) == "| a |\n| --- |\n| x\\|y |\n"
    (tmp_path / "Odd.msg").write_text("float64 = x\n")
    with pytest.raises(ValueError, match=r"Odd\.msg: float64 = x"):
        list(reference.describe_messages(tmp_path))


def test_gallery_page_is_up_to_date_and_shows_every_command() -> None:
    text = (DOCS / "gallery.md").read_text()
    assert text == gallery.make_gallery_page(), "run ./st docs"
    for command in (c for exhibit in gallery.EXHIBITS for c in (*exhibit.preparation, exhibit.command)):
        assert f"$ {command.replace('{}', 'runs/gallery')}" in text


def test_every_verb_and_option_shown_in_readme_and_docs_exists() -> None:
    verbs = collect_commands().commands
    checked = 0
    for page in (ROOT / "README.md", *DOCS.rglob("*.md")):
        for verb, rest in re.findall(r"\./st (\w+)([^`|\n]*)", page.read_text()):
            if page.name == "reference.md" or verb in ("shell", "test", "bench"):  # these pass options on
                continue
            assert verb in verbs, f"{page.name}: ./st {verb}"
            known = {name for p in verbs[verb].params for name in (*p.opts, *p.secondary_opts)}
            for option in re.findall(r"(?<![\w-])--[a-z][\w-]*", rest.partition("#")[0]):
                checked += 1
                assert option in known, f"{page.name}: ./st {verb} {option}"
    assert checked > 20
