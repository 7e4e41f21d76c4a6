"""Licences of all installed packages; ST_SBOM=FILE.json also writes a CycloneDX bill of materials."""

import importlib.metadata
import json
import os
from pathlib import Path


def run() -> dict:
    distributions = {d.metadata["Name"]: d for d in importlib.metadata.distributions() if d.metadata["Name"]}
    packages = {name: {"version": d.version, "licence": find_licence(d.metadata)}
                for name, d in sorted(distributions.items())}
    if os.environ.get("ST_SBOM"):
        Path(os.environ["ST_SBOM"]).write_text(json.dumps(make_bill(packages), indent=2) + "\n")
    unknown = sorted(name for name, about in packages.items() if not about["licence"])
    table = {f"{name} {about['version']}": about["licence"] or "not stated" for name, about in packages.items()}
    return {**table, "packages": len(packages), "without a stated licence": ", ".join(unknown) or "none"}


def find_licence(metadata: importlib.metadata.PackageMetadata) -> str:
    """Licence of a package: SPDX expression, or its classifiers, or the first line of its licence field."""
    classifiers = [c.rpartition(" :: ")[2] for c in metadata.get_all("Classifier", []) if c.startswith("License ::")]
    text = (metadata.get("License") or "").strip().splitlines()
    return metadata.get("License-Expression") or ", ".join(classifiers) or (text[0][:60] if text else "")


def make_bill(packages: dict[str, dict[str, str]]) -> dict:
    components = [
        {"type": "library", "name": name, "version": about["version"],
         "purl": f"pkg:pypi/{name.lower()}@{about['version']}",
         "licenses": [{"license": {"name": about["licence"]}}] if about["licence"] else []}
        for name, about in packages.items()
    ]
    return {"bomFormat": "CycloneDX", "specVersion": "1.5", "version": 1, "components": components}
