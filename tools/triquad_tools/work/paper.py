"""``triquad-eval paper``: the experiments of the 3QFP paper."""

import argparse
from dataclasses import replace
from pathlib import Path

from triquad_server.settings.loading import load_settings

from triquad_tools.console.command import OK, ToolError, print_line
from triquad_tools.console.progress import progress
from triquad_tools.evaluation.metrics import ScoreSettings
from triquad_tools.evaluation.references import read_reference
from triquad_tools.paper.other_mappers import installed_mappers
from triquad_tools.paper.plots import (
    Pictured,
    picture_holes,
    plot_memory,
    plot_sparse,
)
from triquad_tools.paper.published_figures import SETS
from triquad_tools.paper.report import Report
from triquad_tools.paper.runs import (
    LEARNED,
    Task,
    all_runs,
    memory_by_scans,
    scans_needed,
)
from triquad_tools.recordings.folders.cloud_folder import read_cloud_folder
from triquad_tools.recordings.folders.scan_folder import ScanFolder
from triquad_tools.recordings.recording import ReadingOptions


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
    recording = _opened(options.folder, scans_needed(every))
    truth = read_reference(options.reference, options.spacing)
    everything = range(len(recording))
    memory = memory_by_scans(recording.read(everything), len(recording), settings)
    with progress("reading", len(recording)) as told:
        scans = []
        for scan in recording.read(everything):
            scans.append(scan)
            told(len(scans), f"{len(scans)} of {len(recording)} scans")
    options.output.mkdir()
    task = Task(scans, truth, settings, scoring, options.samples)
    report = Report(
        options.name or options.folder.resolve().name,
        options.style,
        published,
        scoring,
        len(scans),
        every,
        memory=tuple(memory),
    )
    learned = LEARNED if options.as_published else LEARNED[:1]
    methods = [*learned, *installed_mappers()]
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


def _opened(folder: Path, needed: int) -> ScanFolder:
    """Open a folder of scans, which has to have as many as are ``needed``."""
    recording = read_cloud_folder(folder, ReadingOptions())
    if len(recording) < needed:
        raise ToolError(
            f"{folder} has {len(recording)} scans, and {needed} are needed: give smaller numbers "
            "to --every"
        )
    return recording
