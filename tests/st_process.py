"""Runs `./st` in its own process, as a user does."""

import os
import subprocess

from support import ROOT


def run_st(*arguments: object, status: int = 0, **environment: str) -> str:
    """Output and error messages of `./st ARGUMENTS`, which must end with the given exit status."""
    process = subprocess.run([str(ROOT / "st"), *map(str, arguments)], check=False, capture_output=True, text=True,
                             cwd=ROOT, timeout=250, env={**os.environ, **environment})
    text = process.stdout + process.stderr
    assert process.returncode == status, text
    return text
