"""README and the pages: links resolve, sentences are short, and words of this project's own do not stand for a term."""

import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from support import ROOT

LONGEST = 35  # words of a sentence
GLOSSARY = "docs/method/glossary.md"
# Words that meant something here only. The glossary says which term of the field stands for each.
HOUSE_WORDS = re.compile(r"\b((?<!steering )gains?|gained|floors?|restless|acts? in moments|(is|are) lost)\b",
                         re.IGNORECASE)

ALL = [ROOT / "README.md", ROOT / "CHANGELOG.md", ROOT / "SECURITY.md", *sorted((ROOT / "docs").rglob("*.md"))]
MADE = {"reference.md"}  # help texts and comments of the code
PROSE = [ROOT / "README.md", *(page for folder in ("docs", "docs/manual", "docs/method")
                               for page in sorted((ROOT / folder).glob("*.md")) if page.name not in MADE)]


def name(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def without_code(text: str) -> str:
    """The text without blocks of code, comments and targets of links; a span of code is one word."""
    text = re.sub(r"^ *```.*?^ *```", "", text, flags=re.DOTALL | re.MULTILINE)
    text = re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL)
    text = re.sub(r"!\[[^\]]*\]\([^)]*\)", "", text)
    text = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", text)
    return re.sub(r"`[^`]+`", "CODE", text)


def paragraphs(text: str) -> Iterator[str]:
    """Running text: one string for each paragraph and each item of a list. Headings, tables and code are left out."""
    lines: list[str] = []
    for line in [*without_code(text).splitlines(), ""]:
        words = line.strip()
        begins_item = re.match(r"([-*]|\d+\.)\s+", words)
        skipped = not words or words.startswith(("#", "|", "<")) or (line.startswith("    ") and not lines)
        if (skipped or begins_item) and lines:
            yield " ".join(lines)
            lines = []
        if not skipped:
            lines.append(words[begins_item.end():] if begins_item else words)


def sentences(text: str) -> Iterator[str]:
    for paragraph in paragraphs(text):
        plain = re.sub(r"[*_]{1,2}(?=\S)|(?<=\S)[*_]{1,2}", "", paragraph)
        yield from re.split(r"(?<=[.!?])[)\"”]*\s+(?=[\"“(]?[A-Z0-9])", plain)


def words(sentence: str) -> int:
    return len(re.findall(r"\S*\w\S*", sentence))


def test_the_parser_sees_what_a_reader_sees() -> None:
    page = ("# Heading\n\nOne two\nthree. Four `a b c` [five six](x.md#y).\n\n- item one\n  goes on\n- item two\n\n"
            "| a | b |\n|---|---|\n\n```console\n$ code\n```\n")
    assert [words(s) for s in sentences(page)] == [3, 4, 4, 2]


@pytest.mark.parametrize("page", ALL, ids=name)
def test_every_link_leads_somewhere(page: Path) -> None:
    lost = []
    for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text()):
        file, _, heading = target.partition("#")
        if ":" in file:
            continue
        there = (page.parent / file).resolve() if file else page
        if not there.exists() or (heading and heading not in anchors(there)):
            lost.append(target)
    assert lost == []


def anchors(page: Path) -> set[str]:
    """Of the headings of a page, as GitHub makes them."""
    headings = re.findall(r"^#+ (.+)$", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PROSE, ids=name)
def test_sentences_are_short(page: Path) -> None:
    assert [s for s in sentences(page.read_text()) if words(s) > LONGEST] == []


@pytest.mark.parametrize("page", [page for page in PROSE if name(page) != GLOSSARY], ids=name)
def test_terms_are_those_of_the_field(page: Path) -> None:
    found = [line for line in without_code(page.read_text()).splitlines() if HOUSE_WORDS.search(line)]
    assert found == []


def test_every_page_stands_in_the_index() -> None:
    index = (ROOT / "docs" / "README.md").read_text()
    pages = [page.relative_to(ROOT / "docs").as_posix() for page in (ROOT / "docs").rglob("*.md")]
    assert [page for page in pages if page != "README.md" and "examples" not in page and f"({page})" not in index] == []
