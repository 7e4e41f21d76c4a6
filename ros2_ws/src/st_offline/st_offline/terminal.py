"""Console output of the commands (progress, tables, lines, lists of files), and writing of text files."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table
from st_recordings.paths import OutputError

console = Console()


def make_progress_bars() -> Progress:
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    return Progress(*columns, console=console, transient=True)


def make_table(rows: Sequence[Mapping[str, str]], title: str | None = None) -> Table:
    """Table with the keys of the first row as titles of the columns, empty without rows."""
    table = Table(title=title, title_justify="left", title_style="bold", box=None, padding=(0, 1))
    for name in rows[0] if rows else ():
        # A model name that is split by a line break cannot be copied.
        table.add_column(name, overflow="fold", no_wrap=name == "model")
    for row in rows:
        table.add_row(*row.values())
    return table


def format_count(number: int, noun: str) -> str:
    """A number with its noun, such as "1 run" or "2 runs"."""
    return f"{number} {noun}{'' if number == 1 else 's'}"


def print_line(text: str) -> None:
    """Print one line without wrapping; `text` may contain rich markup, so escape user text."""
    console.print(text, highlight=False, soft_wrap=True)


def report_problem(name: str, problem: str) -> None:
    """Print a line with a name and its problem; a name at the start of the problem is not repeated."""
    print_line(f"[red]{escape(name)}[/red]: {escape(problem.removeprefix(f'{name}: '))}")


def check_is_new(file: Path) -> None:
    """Raise OutputError for a file that exists."""
    if file.exists():
        raise OutputError(f"{file} exists: choose another --output (existing files are not overwritten)")


def write_file(file: Path, text: str) -> None:
    """Write a text in UTF-8; create the folder of the file if necessary. Raises OutputError if that is not possible."""
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text, encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{file}: cannot be written: {error.strerror}") from None


def list_files(files: Mapping[Path, str]) -> None:
    """Print one line per file: its path and a description."""
    for file, description in files.items():
        print_line(f"  {escape(str(file))}  [dim]{description}[/dim]")
