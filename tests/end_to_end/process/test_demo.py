import dataclasses
import json
import signal
from pathlib import Path

import numpy as np
import pytest
from triquad_format.mapfile.reader import read_map
from triquad_format.wire.status_messages import FieldFit
from triquad_tools.commands import demo
from triquad_tools.demo import steps
from triquad_tools.demo.probe import ProbeReport
from triquad_tools.demo.steps import DemoResults, Intake, broken_promises, table_rows
from triquad_tools.mapfiles.meshfile import read_mesh

GOOD = DemoResults(
    seed=1,
    intake=Intake(60, 60, 0, 0, 6.0, 30.0, 100, 15_000_000),
    queries=ProbeReport(500, 0, None, 60, 0, 1000, 2.0, 4.0, 5.0),
    fit=FieldFit(30_000, 0.004, 0.014, np.zeros((0, 3)), np.zeros(0, np.float32)),
    map_bytes=2_000_000,
    parameters=1_000_000,
    faces=250_000,
)


def test_a_few_scans_leave_all_results(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(steps, "_SETTLE_LIMIT_S", 3.0)
    out = tmp_path / "out"
    before = signal.getsignal(signal.SIGTERM)
    code = demo.main(["--out", str(out), "--scans", "2"])
    assert signal.getsignal(signal.SIGTERM) is before
    output = capsys.readouterr()
    for name in ("scans taken in", "training", "query of 1,000 points", "map file", "mesh"):
        assert name in output.out
    assert "the first run of all compiles" in output.err
    assert "waiting 3 s at most for training" in output.err
    assert "s left" not in output.err.partition("waiting 3 s")[2].partition("done in")[0]
    # Two scans and a second do not make a good map; everything else is promised of them too.
    broken = [line for line in output.err.splitlines() if "; promised is at" in line]
    assert all("error at held-out rays" in line for line in broken), broken
    assert code == (1 if broken else 0)
    results = json.loads((out / "results.json").read_text())
    assert (results["intake"]["taken"], results["intake"]["lost"]) == (2, 0)
    assert results["queries"]["queries"] > 0
    assert results["queries"]["errors"] == results["queries"]["epochs_backwards"] == 0
    assert results["map_bytes"] == (out / "map.triquad").stat().st_size
    assert all(region.training is None for region in read_map(out / "map.triquad").regions)
    faces = [len(read_mesh(out / name).faces) for name in ("street.ply", "street.glb")]
    assert faces[0] == faces[1] > 1000
    assert (out / "street.png").read_bytes().startswith(b"\x89PNG")
    assert list((out / "store" / "demo").glob("*.checkpoint"))


def test_results_as_promised_break_nothing() -> None:
    assert broken_promises(GOOD) == []
    values = {row.name: row.value for row in table_rows(GOOD)}
    assert values["scans taken in"] == "10.0 /s"
    assert values["training"] == "0.50 M samples/s"
    assert values["error at held-out rays"] == "4.00 mm"
    assert values["map file"] == "2.00 MB"
    for percent, words in ((100, "all there is to learn"), (37, "37 % of what there is to learn")):
        intake = dataclasses.replace(GOOD.intake, learnt_percent=percent)
        (row,) = (
            one
            for one in table_rows(dataclasses.replace(GOOD, intake=intake))
            if one.name == "training"
        )
        assert words in row.note


@pytest.mark.parametrize(
    ("part", "changes", "words"),
    [
        ("fit", {"median_m": 0.021}, "error at held-out rays (m) is 0.021; promised is at most 0"),
        ("intake", {"lost": 2}, "scans lost or refused is 2; promised is at most 0"),
        ("queries", {"epochs_backwards": 1}, "answers from an older epoch is 1"),
    ],
)
def test_a_broken_promise_is_named_with_its_value(
    part: str, changes: dict[str, object], words: str
) -> None:
    changed = dataclasses.replace(getattr(GOOD, part), **changes)
    broken = broken_promises(dataclasses.replace(GOOD, **{part: changed}))
    assert len(broken) == 1
    assert words in broken[0]
