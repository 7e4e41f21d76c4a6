"""The command `st bench`: lists and runs the benchmarks in bench/."""

import ast
import importlib
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
    console, files = Console(), find_benchmarks()
    if name is None:
        table = Table("name", "what it measures", box=None)
        for stem, path in files.items():
            table.add_row(stem, (ast.get_docstring(ast.parse(path.read_text())) or "").partition("\n")[0])
        console.print(table)
        return
    if name not in files:
        typer.echo(f"st bench: unknown benchmark {name!r}; use {', '.join(files)}", err=True)
        raise typer.Exit(2)
    module = _import_module(files[name])
    if hasattr(module, "main"):
        if json_file:
            typer.echo(f"st bench {name}: --json is not available; this benchmark writes its own results", err=True)
            raise typer.Exit(2)
        raise typer.Exit(module.main(context.args))
    if context.args:
        typer.echo(f"st bench {name}: unexpected argument {context.args[0]}", err=True)
        raise typer.Exit(2)
    result = module.run()
    _print_result(console, name, result)
    if json_file:
        machine = {"python": platform.python_version(), "machine": platform.machine(), "cpu": _read_processor_name(),
                   "version": source_version()}
        json_file.write_text(json.dumps({"bench": name, "machine": machine, "result": result}, indent=2) + "\n")


def find_benchmarks() -> dict[str, Path]:
    """Name -> file of every benchmark: bench/NAME.py, or bench/NAME/command.py."""
    folder = project_root() / "bench"
    files = {path.stem: path for path in folder.glob("[!_]*.py")}
    return dict(sorted((files | {path.parent.name: path for path in folder.glob("*/command.py")}).items()))


def _import_module(path: Path) -> ModuleType:
    """The module of a benchmark, with `run()`, or `main(arguments)` if it has options of its own."""
    sys.path += [str(project_root()), str(project_root() / "tests")]  # some use tests/faults and tests/fuzz
    return importlib.import_module(".".join(path.relative_to(project_root()).with_suffix("").parts))


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
