"""The command `st bench`: lists and runs the benchmarks in bench/."""

import ast
import importlib
import importlib.util
import json
import platform
import sys
from pathlib import Path
from types import ModuleType

import typer
from rich.console import Console
from rich.table import Table
from st_recordings.paths import project_root, source_version


def bench(
    context: typer.Context,
    name: str | None = typer.Argument(None, help="Name of a benchmark; without a name, all are listed."),
    json_file: Path | None = typer.Option(
        None, "--json", help="JSON file for the result and a description of the computer; not for benchmarks with "
        "options of their own."),
) -> None:
    """List the benchmarks, or run one and print its results.

    Those with options of their own describe them with: st bench NAME -- --help
    """
    folder = project_root() / "bench"
    files = {path.stem: path for path in sorted(folder.glob("*.py")) if not path.stem.startswith("_")}
    # A package has its own options and prints its own result.
    packages = {path.parent.name: path for path in sorted(folder.glob("*/__init__.py"))}
    console = Console()
    if name is None:
        table = Table("name", "what it measures", box=None)
        for stem, path in sorted({**files, **packages}.items()):
            table.add_row(stem, _read_first_line(path))
        console.print(table)
        return
    if name in packages:
        if json_file:
            typer.echo(f"st bench {name}: --json is not available; this benchmark writes its own results", err=True)
            raise typer.Exit(2)
        sys.path.insert(0, str(project_root()))
        raise typer.Exit(importlib.import_module(f"bench.{name}").main(context.args))
    if name not in files:
        names = ", ".join(sorted({**files, **packages}))
        typer.echo(f"st bench: unknown benchmark {name!r}; use {names}", err=True)
        raise typer.Exit(2)
    if context.args:
        typer.echo(f"st bench {name}: unexpected argument {context.args[0]}", err=True)
        raise typer.Exit(2)
    result = _load_module(files[name]).run()
    _print_result(console, name, result)
    if json_file:
        machine = {"python": platform.python_version(), "machine": platform.machine(), "cpu": _read_processor_name(),
                   "version": source_version()}
        json_file.write_text(json.dumps({"bench": name, "machine": machine, "result": result}, indent=2) + "\n")


def _read_first_line(path: Path) -> str:
    return (ast.get_docstring(ast.parse(path.read_text())) or "").strip().splitlines()[0]


def _load_module(path: Path) -> ModuleType:
    sys.path.insert(0, str(path.parent))
    specification = importlib.util.spec_from_file_location(f"bench_{path.stem}", path)
    assert specification and specification.loader  # always true for a Python file
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module


def _print_result(console: Console, name: str, result: dict) -> None:
    table = Table("measure", "value", title=name, box=None, title_justify="left")
    scalars = {key: value for key, value in result.items() if not _is_table(value)}
    for key, value in _flatten(scalars):
        table.add_row(key, _format_cell(value))
    console.print(table)
    for key, rows in result.items():
        if key not in scalars:
            columns = list(next(iter(rows.values())))
            row_table = Table(key, box=None)
            for column in columns:
                row_table.add_column(column, justify="right")
            for row, values in rows.items():
                row_table.add_row(row, *(_format_cell(values[column]) for column in columns))
            console.print()
            console.print(row_table)


def _is_table(value: object) -> bool:
    """Whether a value is a dict of rows with the same columns and no nested dicts."""
    rows = list(value.values()) if isinstance(value, dict) else []
    if len(rows) < 2 or not all(isinstance(row, dict) and row.keys() == rows[0].keys() for row in rows):
        return False
    return bool(rows[0]) and not any(isinstance(cell, dict) for row in rows for cell in row.values())


def _format_cell(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _flatten(result: dict, prefix: str = "") -> list[tuple[str, object]]:
    rows: list[tuple[str, object]] = []
    for key, value in result.items():
        rows += _flatten(value, f"{prefix}{key}.") if isinstance(value, dict) else [(prefix + key, value)]
    return rows


def _read_processor_name() -> str:
    for line in Path("/proc/cpuinfo").read_text().splitlines():
        if line.startswith("model name"):
            return line.split(":", 1)[1].strip()
    return platform.processor()
