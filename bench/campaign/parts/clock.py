"""A clock that jumps, forwards and back, by seconds and by decades."""

from pathlib import Path

import triquad_client

from bench.campaign.server_under_test import (
    checkpoint,
    expect,
    expect_known,
    publish_at,
    server_under_test,
)
from bench.campaign.turn import Turn

_LIBRARIES = "/usr/lib/*/faketime/libfaketimeMT.so.1"
_DAY_S = 86_400
_JUMPS_S = (1, 60, 3_600, _DAY_S, 365 * _DAY_S, 30 * 365 * _DAY_S)


def missing() -> str | None:
    """Return why no clock can be made to jump here, if none can."""
    return None if _library() else "libfaketime is not installed (apt-get install faketime)"


def run(turn: Turn) -> None:
    """Let the server's clock jump, and check that it maps, answers and keeps checkpoints."""
    shift = turn.folder / "shift"
    shift.write_text("+0")
    environment = {
        "LD_PRELOAD": str(_library()),
        "FAKETIME_TIMESTAMP_FILE": str(shift),
        "FAKETIME_NO_CACHE": "1",
        "FAKETIME_DONT_FAKE_MONOTONIC": "1",  # no jump changes that one
        "DONT_FAKE_MONOTONIC": "1",
    }
    kept = None
    with (
        server_under_test(turn, environment) as server,
        triquad_client.connect(server.endpoint) as client,
    ):
        while not turn.over:
            jump_s = turn.random.choice(_JUMPS_S) * turn.random.choice((-1, 1))
            # Replaced as a whole, since the server may read it at any time.
            (turn.folder / "next").write_text(f"{jump_s:+d}")
            (turn.folder / "next").rename(shift)
            report = publish_at(client, 0)
            expect(report.lost == report.refused == 0, f"scans were not taken: {report}")
            expect_known(client, 0)
            kept = checkpoint(client)
            status = client.status()
            expect(0 <= status.uptime_s < 3_600, f"an uptime of {status.uptime_s} s")
            turn.did("forwards" if jump_s > 0 else "backwards")
    with (
        server_under_test(turn) as server,
        triquad_client.connect(server.endpoint) as client,
    ):
        epoch = client.status().epoch
        expect(kept is None or epoch >= kept.epoch, f"epoch {epoch} is restored, of {kept}")


def _library() -> Path | None:
    return next(Path("/").glob(_LIBRARIES.lstrip("/")), None)
