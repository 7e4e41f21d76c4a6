"""Commands of README and gallery run in a clone alone: every file they name is in the repository or made on the way."""

import re

import pytest
from support import ROOT

COMPLETE = ("README.md", "docs/gallery.md")  # the other pages name drives of the reader's own
PAGES = ("README.md", *sorted(page.relative_to(ROOT).as_posix() for page in (ROOT / "docs").rglob("*.md")))
MADE = ("runs/", "install/")  # by ./st and by colcon
INSTALLED = ("/opt/",)
SUFFIX = re.compile(r"\.(csv|ncom|mf4|mcap|yaml|dbc|py|sh|rviz|xml|log)$")


def commands(text: str) -> list[str]:
    """Lines of console blocks without prompt and comment, and `./st …` in the running text."""
    blocks = re.findall(r"```console\n(.*?)```", text, re.DOTALL)
    shown = [line[2:] for block in blocks for line in block.splitlines() if line.startswith(("$ ", "> "))]
    inline = re.findall(r"`(\./st [^`\n]+)`", re.sub(r"```.*?```", "", text, flags=re.DOTALL))
    return [line.partition(" #")[0] for line in shown + inline]


def paths(command: str) -> list[str]:
    """Arguments that look like a file or folder; of `name:=$PWD/path` the path, of a launch file its place."""
    command = re.sub(r"ros2 launch (\w+) ", r"ros2 launch ros2_ws/src/\1/launch/", command)
    words = [re.sub(r"^\w+:=", "", word).replace("$PWD/", "").rstrip(";,") for word in command.split()]
    return [word for word in words if ("/" in word or SUFFIX.search(word)) and not word.startswith("./st")]


def placeholder(path: str) -> bool:
    """RUN, DIR/model.yaml, FILE.ncom, runs/…: to be replaced by the reader."""
    return "…" in path or any(len(part) > 1 and part.isupper() for part in re.split(r"[/.]", path))


@pytest.mark.parametrize("page", COMPLETE)
def test_every_file_a_command_names_is_there(page: str) -> None:
    named = [path for command in commands((ROOT / page).read_text()) for path in paths(command)]
    assert len(named) > 3
    unknown = [path for path in named if not path.startswith((*MADE, *INSTALLED)) and not placeholder(path)
               and not (ROOT / path).exists()]
    assert unknown == []


@pytest.mark.parametrize("page", PAGES)
def test_no_command_reaches_outside_the_repository(page: str) -> None:
    named = [path for command in commands((ROOT / page).read_text()) for path in paths(command)]
    outside = [path for path in named if path.startswith(("..", "/", "~")) and not path.startswith(INSTALLED)]
    assert outside == []
