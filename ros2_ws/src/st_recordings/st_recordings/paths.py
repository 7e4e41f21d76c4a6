"""Where the project's own files are, and what version of it this is."""

import os
import subprocess
from pathlib import Path


def project_root() -> Path:
    """The checkout: set by ./st, else found upwards from the working directory."""
    if "ST_ENVIRONMENT" in os.environ:
        return Path(os.environ["ST_ENVIRONMENT"])
    for folder in (Path.cwd(), *Path.cwd().parents):
        if (folder / "config" / "nodes.yaml").exists():
            return folder
    raise SystemExit("st: project folder not found: start with ./st, or from inside the checkout")


def config(relative: str) -> Path:
    return project_root() / "config" / relative


def source_version() -> str:
    """`git describe` of the checkout, or the release where there is no git."""
    try:
        return subprocess.run(
            ["git", "-C", str(project_root()), "describe", "--always", "--dirty", "--tags"],
            capture_output=True,
            text=True,
            check=True,
            timeout=5,
        ).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return "0.1.0"
