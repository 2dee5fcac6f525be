"""``triquad-eval paper``: the experiments of the 3QFP paper."""

import argparse
from dataclasses import replace
from pathlib import Path

from triquad_server.settings.loading import load_settings

from triquad_tools.console.command import OK, ToolError, print_line
from triquad_tools.console.progress import progress
from triquad_tools.evaluation.metrics import ScoreSettings
from triquad_tools.evaluation.references import read_reference
from triquad_tools.paper.plots import (
    Pictured,
    picture_holes,
    plot_memory,
    plot_sparse,
)
from triquad_tools.paper.published_figures import SETS
from triquad_tools.paper.report import Report
from triquad_tools.paper.runs import (
    Method,
    Task,
    all_runs,
    memory_by_scans,
    scans_needed,
)
from triquad_tools.recordings.folders.cloud_folder import read_cloud_folder
from triquad_tools.recordings.recording import ReadingOptions
from triquad_tools.sensors.sweep import PosedScan


def work(options: argparse.Namespace) -> int:
    """Make all runs, and write the report."""
    published = SETS[options.style]
    every = tuple(sorted(set(options.every or published.every)))
    if options.output.exists():
        raise ToolError(f"{options.output} exists: give the name of a new folder")
    settings = load_settings(options.settings, options.set)
    scoring = ScoreSettings(
        published.threshold_m,
        published.accuracy_cut_m,
        voxel_m=options.spacing,
        samples_max=options.mesh_samples,
    )
    scans = _scans(options.folder, scans_needed(every))
    truth = read_reference(options.reference, options.spacing)
    task = Task(scans, truth, settings, scoring, options.samples)
    options.output.mkdir()
    report = Report(
        options.name or options.folder.resolve().name,
        options.style,
        published,
        scoring,
        len(scans),
        every,
        memory=tuple(memory_by_scans(task)),
    )
    methods: list[Method] = ["triquad", "VDBFusion"]
    if options.as_published:
        methods.insert(1, "as published")
    pictured = []
    for run, mesh in all_runs(task, every, methods):
        if run.encoding == "both" and run.every == max(every):
            pictured.append(Pictured(run, mesh))
        report = replace(report, runs=(*report.runs, run))
        _write(report, options.output)  # what is done is not lost
    plot_sparse(report.whole(), published, options.output / "sparse.png")
    plot_memory(report.memory, options.output / "memory.png")
    picture_holes(pictured, truth, scoring.threshold_m, options.output / "holes.png")
    print_line(report.page())
    print_line(f"{options.output}: report.md, report.json and three pictures")
    return OK


def _write(report: Report, folder: Path) -> None:
    (folder / "report.json").write_text(report.json())
    (folder / "report.md").write_text(report.page())


def _scans(folder: Path, needed: int) -> list[PosedScan]:
    """Return all scans of a folder."""
    recording = read_cloud_folder(folder, ReadingOptions())
    if len(recording) < needed:
        raise ToolError(
            f"{folder} has {len(recording)} scans, and {needed} are needed: give smaller numbers "
            "to --every"
        )
    scans = []
    with progress("reading", len(recording)) as report:
        for scan in recording.read(range(len(recording))):
            scans.append(scan)
            report(len(scans), f"{len(scans)} of {len(recording)} scans")
    return scans
