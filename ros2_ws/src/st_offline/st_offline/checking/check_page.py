"""Writes the page of `st check`: findings, corrections, and figures of comparisons."""

import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from st_core.checks import Comparison, Severity
from st_core.palette import MEASURED_COLOUR, MODEL_COLOUR

from ..evaluation import drawing
from ..evaluation.work import to_file_name
from ..pages import load_template
from . import check_report
from .check_report import CheckedRun, compute_residual_rms

MAX_FIGURES = 6  # on the page
HEIGHT = 3.1  # inch
LABEL_CHARACTERS = 12  # per line of the label of an axis, so that the labels of both axes stay apart
MAX_LINE_GAP = 1.5  # s; a line is interrupted at longer gaps
MIN_SHADE_WIDTH = 0.004  # fraction of the time axis; narrower shading would be invisible
SHADES = {Severity.ERROR: drawing.BAD_COLOUR, Severity.WARNING: drawing.WARN_COLOUR, Severity.NOTE: MEASURED_COLOUR}
DERIVED_COLOUR = MODEL_COLOUR["kinematic"]


@drawing.apply_style()
def draw_comparison(comparison: Comparison, run: CheckedRun, prefix: str) -> drawing.PageFigure:
    """Draw one comparison, with the time intervals of its findings shaded. prefix: start of the title."""
    findings = sorted((finding for finding in run.result.findings if finding.name in comparison.findings),
                      key=check_report.rank_severity)
    figure, (upper, lower) = plt.subplots(2, 1, figsize=(drawing.WIDTH, HEIGHT), sharex=True, height_ratios=(3, 2))
    for axes, values, colour, width, label in (
            (upper, comparison.measured, MEASURED_COLOUR, 2.6, comparison.measured_label),
            (upper, comparison.derived, DERIVED_COLOUR, 0.9, comparison.derived_label),
            (lower, comparison.measured - comparison.derived, drawing.TEXT_COLOUR, 0.9, None)):
        line = drawing.reduce_points(*drawing.cut_at_gaps(comparison.time, values, MAX_LINE_GAP))
        axes.plot(*line, color=colour, lw=width, label=label)
    shortest = MIN_SHADE_WIDTH * float(np.ptp(upper.get_xlim()))
    for finding in findings:
        for start, end in finding.times:
            for axes in (upper, lower):
                axes.axvspan(start, max(end, start + shortest), color=SHADES[finding.severity], alpha=0.3, lw=0)
    lower.axhline(0.0, color=drawing.TEXT_COLOUR, lw=0.5)
    lower.set_xlabel("time after the first INS measurement, s")
    unit = check_report.get_unit_symbol(comparison.unit) or "1"
    upper.set_ylabel(f"{textwrap.fill(comparison.title.partition(':')[0], LABEL_CHARACTERS)}\n{unit}")
    lower.set_ylabel(f"difference\n{unit}")
    figure.align_ylabels()
    figure.legend(loc="outside lower left", ncols=2)
    output = drawing.FigureOutput(None, (), f"{to_file_name(run.name)}-")
    shaded = ", shaded where a finding applies" if any(finding.times for finding in findings) else ""
    caption = f"Grey: {comparison.measured_label}; blue: {comparison.derived_label}; below, grey minus blue{shaded}."
    size = f"{compute_residual_rms(comparison):.2g} {check_report.get_unit_symbol(comparison.unit)}".strip()
    finding_text = findings[0].text if findings else f"no finding; they differ by {size} (root mean square)"
    title = f"{prefix}{comparison.title[0].upper()}{comparison.title[1:]}: {finding_text}"
    return drawing.save_figure(figure, output, f"comparison-{comparison.name}", title, caption)


def make_title(runs: Sequence[CheckedRun]) -> str:
    """Title of the page: the verdict on all runs."""
    if len(runs) == 1:
        return f"{runs[0].name}: {check_report.format_headline(runs[0].result)}"
    affected = {severity: [run.name for run in runs if run.result.with_severity(severity)]
                for severity in check_report.SEVERITY_ORDER[:2]}
    if not any(affected.values()):
        return f"{len(runs)} runs: no error and no warning"
    counts = [f"{severity.value}s in {len(names)} of {len(runs)} runs ({', '.join(names)})"
              for severity, names in affected.items() if names]
    sentence = "; ".join(counts)
    return sentence[0].upper() + sentence[1:]


def make_summary(runs: Sequence[CheckedRun]) -> list[str]:
    """At most three sentences: meaning of the findings, recommendation, clocks."""
    findings = [finding for run in runs for finding in run.result.findings]
    worst = min(findings, key=check_report.rank_severity, default=None)
    clocks = check_report.describe_clocks({run.name: run.alignment for run in runs})
    if worst is None or worst.severity is Severity.NOTE:
        return ["No finding requires a correction of these runs.", *([f"{clocks}."] if clocks else [])]
    sizes = [finding.effect for finding in findings
             if finding.severity is not Severity.NOTE and finding.effect is not None]
    size = f", by up to {max(sizes):.2g} m after 5 s" if sizes and worst.severity is Severity.WARNING else ""
    rejection = ": other commands reject such a run unless --force is given" if worst.severity is Severity.ERROR else ""
    meaning = check_report.describe_meaning(findings)
    sign_advice = next(filter(None, (check_report.advise_steering_sign(
        run.result.findings, run.arguments, run.alignment["method"] != "none") for run in runs)), "")
    correction = (f"To correct the recording, run `st check {runs[0].arguments if len(runs) == 1 else 'RUN'} "
                  "--propose-correction run.yaml` with the other options of this check, and use the run.yaml that it "
                  "writes instead of the recording.")
    is_correctable = any(finding.advice is not None and finding.advice.kind == "run.yaml" for finding in findings
                         if finding.severity is not Severity.NOTE)
    sentences = (f"{meaning[0].upper()}{meaning[1:]}{size}{rejection}.",
                 f"{sign_advice[0].upper()}{sign_advice[1:]}." if sign_advice else correction if is_correctable else "",
                 f"{clocks}." if clocks else "")
    return [sentence for sentence in sentences if sentence]


def write_page(file: Path, runs: Sequence[CheckedRun], unreadable: Mapping[str, str], content: dict[str, Any]) -> None:
    """Write the page, with the figures of at most MAX_FIGURES comparisons, those with the most severe findings first.
    content: the content of check.json."""
    def rank(pair: tuple[Comparison, CheckedRun]) -> tuple[int, float]:
        comparison, run = pair
        findings = [finding for finding in run.result.findings if finding.name in comparison.findings]
        worst = min(map(check_report.rank_severity, findings), default=len(check_report.SEVERITY_ORDER))
        return worst, -max((finding.effect or 0.0 for finding in findings), default=0.0)

    pairs = sorted(((comparison, run) for run in runs for comparison in run.result.comparisons), key=rank)
    figures = [draw_comparison(comparison, run, f"{run.name}: " if len(runs) > 1 else "")
               for comparison, run in pairs[:MAX_FIGURES]]
    text = load_template("checking/check.html.jinja").render(
        title=make_title(runs), summary=make_summary(runs), runs=runs, content=content, figures=figures,
        problems=unreadable, groups=check_report.group_findings({run.name: run.result.findings for run in runs}))
    file.write_text(text, encoding="utf-8")
