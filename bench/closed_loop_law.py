"""The closed loop of a law beyond the library, live: hidden in the virtual Leaf, recorded, proposed by `st discover
--propose`, and driven as the fourth path on a road nobody had driven; errors before and after.

The drives the law is found in are files as the car records them; before and after are live, through bridges and nodes.
"""

import argparse
import contextlib
import io
import json
import shutil
import tempfile
from pathlib import Path

from closed_loop import draw, live_errors, st
from st_recordings.paths import config, project_root
from st_sim.run import main as virtual_leaf

LAW = {"rear_roll_steer": 0.4}  # rad of the rear wheels for each rad of roll; the library holds that of the front only
DRIVES = ("sweep", "slalom", "lane_change", "brake_in_turn", "there_and_back", "weave")
SECONDS, UNSEEN, UNSEEN_SECONDS = 30.0, "S6", 40.0
PAGE = project_root() / "docs" / "measurements" / "closed_loop_law.md"
IMAGES = project_root() / "docs" / "images"


def run(folder: Path | None = None) -> dict:
    """The law proposed, and lateral RMSE [m] over 5 s by model with the library's answer and with the law. Writes the
    page and its figures; everything stays in `folder` where one is given, and what is there is not done again."""
    if folder is None:
        with tempfile.TemporaryDirectory(prefix="st-closed-loop-") as name:
            return run(Path(name))
    vehicle = config("vehicle/leaf.yaml")
    hidden = [part for name, value in LAW.items() for part in ("--effect", f"{name}={value}")]
    for number, name in enumerate(DRIVES):
        if not (folder / name).exists():
            _record(name, number, hidden, folder / name)
    found = folder / "found"
    if not found.exists():
        st("discover", *(folder / name for name in DRIVES), "--vehicle", vehicle, "--propose", "--figures", "png",
            "--output", found)
    told = json.loads((found / "discovery.json").read_text())
    law = told["law"]["proposal"]
    unseen = ("demo", "--scenario", UNSEEN, "--duration", UNSEEN_SECONDS, "--vehicle", vehicle, *hidden, "--seed", 100)
    if not (folder / "before").exists():
        st(*unseen, "--model", found / "model.yaml", "--output", folder / "before")
    if law and not (folder / "after").exists():
        st(*unseen, "--model", found / "proposed.yaml", "--effects", found / "effects", "--output", folder / "after")
    result = {"stated": [e["name"] for e in told["effects"]], "law": law, "why": told["law"]["why"],
              **{when: live_errors(folder / when) for when in ("before", "after") if (folder / when).exists()}}
    if law:
        shutil.copy(found / "figures" / "law.png", IMAGES / "closed_loop_law_curve.png")
        draw(result["before"], result["after"], IMAGES / "closed_loop_law.png",
             ("with what the library explains", "with the proposed law"))
        PAGE.write_text(_page(result))
    return {**result, "law": law and f"{law['place']} over {law['quantity']}"}


def _record(scenario: str, seed: int, hidden: list[str], folder: Path) -> None:
    with contextlib.redirect_stdout(io.StringIO()):
        status = virtual_leaf(["--scenario", scenario, "--vehicle", str(config("vehicle/leaf.yaml")), "--duration",
                               str(SECONDS), "--seed", str(seed), "--plant", "realistic", *hidden, "--to-files",
                               str(folder), "--can-format", "mf4"])
    if status:
        raise RuntimeError(f"the virtual Leaf did not drive {scenario}")


def _page(result: dict) -> str:
    law, before, after = result["law"], result["before"]["lateral"], result["after"]["lateral"]
    hidden = ", ".join(f"`{name}={value:g}`" for name, value in LAW.items())
    rows = [f"| {name} | {value:.3f} | {after[name]:.3f} |" for name, value in before.items()]
    others = "; ".join(f"{name} (cosine {cosine:.2f})" for name, cosine in law["others"].items()) or "none"
    readings = "; ".join(f"`{r['text']}` ({r['shape']})" for r in law["readings"]) or "no simple shape"
    old, new = law["position_5s"]
    return "\n".join((
        "# The closed loop of a law beyond the library, live", "",
        "Written by `./st bench closed_loop_law`; do not edit. The virtual Leaf (`realistic`) has a law the library",
        f"does not hold: {hidden}. {len(DRIVES)} drives of {SECONDS:g} s ({', '.join(DRIVES)}) are recorded to files.",
        "`st discover --propose` gets them and the vehicle file. Then a road it has not seen",
        f"({UNSEEN}) is driven live twice, through bridges and nodes, with a fourth path: what the library explains",
        "(`model.yaml`), and the proposed law beside it (`proposed.yaml` with its effect file).", "",
        f"The library states {', '.join(f'`{name}`' for name in result['stated']) or 'nothing'}.",
        f"Proposed: {law['place'].replace('_', ' ')} over {law['quantity'].replace('_', ' ')}; {readings}.",
        f"Not told apart from it: {others}.",
        f"Held-out position error after 5 s of the recorded drives: {old:.3f} → {new:.3f} m.", "",
        f"Live, lateral error over 5 s in hindsight, RMSE of {result['before']['starts']} and "
        f"{result['after']['starts']} starts:", "",
        "| model | with the library's answer, m | with the proposal, m |", "|---|---|---|", *rows, "",
        "![Errors with the library's answer and with the proposal, live](../images/closed_loop_law.png)", "",
        "![The proposed law](../images/closed_loop_law_curve.png)", ""))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--folder", type=Path, help="keep all runs there, and do not do again what is there")
    given = parser.parse_args().folder
    if given:
        given.mkdir(parents=True, exist_ok=True)
    print(json.dumps(run(given), indent=1))
