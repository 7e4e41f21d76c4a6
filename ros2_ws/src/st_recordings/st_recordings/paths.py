"""Folder of the project's own files (configuration, message definitions), and the version of the software."""

import os
import subprocess
from importlib import metadata
from pathlib import Path

DISTRIBUTION = "single-track-predictor"
INSTALLED = Path(__file__).parent / "share"  # exists in the wheel only


def project_root() -> Path:
    """The checkout that ./st names, else the installed wheel's files, else the checkout around the current folder."""
    if "ST_ENVIRONMENT" in os.environ:
        return Path(os.environ["ST_ENVIRONMENT"])
    for folder in (INSTALLED, Path.cwd(), *Path.cwd().parents):
        if (folder / "config" / "nodes.yaml").exists():
            return folder
    raise SystemExit("st: project folder not found: start with ./st, or from inside the checkout")


def config(relative: str) -> Path:
    return project_root() / "config" / relative


def source_version() -> str:
    """`git describe` of the checkout, or the version of the installed wheel."""
    try:
        return subprocess.run(
            ["git", "-C", str(project_root()), "describe", "--always", "--dirty", "--tags"],
            capture_output=True,
            text=True,
            check=True,
            timeout=5,
        ).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        try:
            return metadata.version(DISTRIBUTION)
        except metadata.PackageNotFoundError:
            return "unknown"
