"""Configuration files stored as text in a recording."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml


def parameters(records: Mapping[str, Mapping[str, str]]) -> dict[str, dict[str, Any]]:
    """Parameters by node, of the metadata records of a recording; empty where it carries none."""
    try:
        document = yaml.safe_load(records.get("configuration", {}).get("parameters.yaml", "")) or {}
        return {node: dict(section["ros__parameters"]) for node, section in document.items()}
    except (yaml.YAMLError, AttributeError, KeyError, TypeError):
        return {}


def text_of(records: Mapping[str, Mapping[str, str]], file: str) -> str | None:
    """The text of a configuration file named in the parameters; None where the recording does not carry it."""
    parts = Path("/", file).parts
    # Two files of one name are kept with a folder before it.
    return next((text for key, text in records.get("configuration", {}).items()
                 if file and parts[-len(Path(key).parts):] == Path(key).parts), None)
