"""Runs the command line program in the process of the test."""

from click.testing import Result
from st_cli.cli import app
from typer.testing import CliRunner


def st(*arguments: object, columns: int = 200, **environment: str) -> Result:
    """Result of `st ARGUMENTS`; columns: width of the terminal. Output and stderr are captured."""
    return CliRunner().invoke(app, [*map(str, arguments)], env={"COLUMNS": str(columns), **environment})
