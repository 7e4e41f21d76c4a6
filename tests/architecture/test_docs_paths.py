"""Commands of README and gallery run in a fresh clone: every file they name is in the repository or is generated."""

import re

import pytest
from support import ROOT

COMPLETE = ("README.md", "docs/gallery.md")  # the other pages name recordings of the reader
PAGES = ("README.md", *sorted(page.relative_to(ROOT).as_posix() for page in (ROOT / "docs").rglob("*.md")))
GENERATED = ("runs/", "install/")  # by ./st and by colcon
INSTALLED = ("/opt/",)
SUFFIX = re.compile(r"\.(csv|ncom|mf4|mcap|yaml|dbc|py|sh|rviz|xml|log)$")


def extract_commands(text: str) -> list[str]:
    """Lines of console blocks without prompt and comment, and `./st …` in running text."""
    blocks = re.findall(r"```console\n(.*?)```", text, re.DOTALL)
    console = [line[2:] for block in blocks for line in block.splitlines() if line.startswith(("$ ", "> "))]
    inline = re.findall(r"`(\./st [^`\n]+)`", re.sub(r"```.*?```", "", text, flags=re.DOTALL))
    return [line.partition(" #")[0] for line in console + inline]


def extract_paths(command: str) -> list[str]:
    """Arguments that look like a file or folder: the path of `name:=$PWD/path`, the location of a launch file."""
    command = re.sub(r"ros2 launch (\w+) ", r"ros2 launch ros2_ws/src/\1/launch/", command)
    words = [re.sub(r"^\w+:=", "", word).replace("$PWD/", "").rstrip(";,") for word in command.split()]
    return [word for word in words if ("/" in word or SUFFIX.search(word)) and not word.startswith("./st")]


def is_placeholder(path: str) -> bool:
    """RUN, DIR/model.yaml, FILE.ncom and runs/… are to be replaced by the reader."""
    return "…" in path or any(len(part) > 1 and part.isupper() for part in re.split(r"[/.]", path))


@pytest.mark.parametrize("page", COMPLETE)
def test_files_named_in_commands_exist(page: str) -> None:
    named = [path for command in extract_commands((ROOT / page).read_text()) for path in extract_paths(command)]
    assert len(named) > 3
    missing = [path for path in named if not path.startswith((*GENERATED, *INSTALLED)) and not is_placeholder(path)
               and not (ROOT / path).exists()]
    assert missing == []


@pytest.mark.parametrize("page", PAGES)
def test_commands_use_no_path_outside_the_repository(page: str) -> None:
    named = [path for command in extract_commands((ROOT / page).read_text()) for path in extract_paths(command)]
    outside = [path for path in named if path.startswith(("..", "/", "~")) and not path.startswith(INSTALLED)]
    assert outside == []
