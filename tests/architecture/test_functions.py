"""Long functions give a reason for their length in a comment."""

import ast
import tokenize
from pathlib import Path

from support import ROOT

SOURCES = ROOT / "ros2_ws" / "src"
MAX_LINES = 40  # lines of code in the body, without signature, docstring, comments and empty lines
REASON = "# long: "
NON_CODE = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER}


def long_functions(path: Path) -> list[str]:
    """name:line (lines of the body) of each function longer than MAX_LINES without a reason on that line or above."""
    text = path.read_text()
    with path.open("rb") as file:
        code = {line for token in tokenize.tokenize(file.readline) if token.type not in NON_CODE
                for line in range(token.start[0], token.end[0] + 1)}
    found = []
    for function in ast.walk(ast.parse(text, str(path))):
        if not isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        body = function.body[ast.get_docstring(function) is not None:]
        length = len(code.intersection(range(body[0].lineno, body[-1].end_lineno + 1))) if body else 0
        before = text.splitlines()[max(function.lineno - 2, 0):function.lineno]
        if length > MAX_LINES and not any(REASON in line for line in before):
            found.append(f"{function.name}:{function.lineno} ({length})")
    return found


def test_long_functions_give_a_reason():
    files = [path for setup in SOURCES.glob("*/setup.py")
             for path in sorted((setup.parent / setup.parent.name).rglob("*.py"))]
    assert len(files) > 150
    found = [f"{path.relative_to(SOURCES)}: {function}" for path in files for function in long_functions(path)]
    assert found == []
