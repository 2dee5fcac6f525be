"""The ten parts of the campaign."""

from bench.campaign.parts import (
    clock,
    crowd,
    cuts,
    disk,
    driving,
    files,
    kills,
    memory,
    messages,
    stops,
)
from bench.campaign.turn import Part

PARTS = (
    Part(
        "messages",
        "messages",
        goal=200_000,
        per_turn=10_000,
        run=messages.run,
        promise="every mutated request is answered or refused, every mutated scan counted; at most "
        "200 MB more memory; honest clients are served",
    ),
    Part(
        "files",
        "files",
        goal=50_000,
        per_turn=2_500,
        run=files.run,
        promise="a mutated file is read as it was, as another valid map, or refused by name, in "
        "little memory and less than 20 s",
    ),
    Part(
        "kills",
        "kills",
        goal=200,
        per_turn=10,
        run=kills.run,
        promise="what a checkpoint acknowledged is there after SIGKILL",
    ),
    Part(
        "disk",
        "writes on a full disk",
        goal=2_000,
        per_turn=100,
        run=disk.run,
        promise="a checkpoint is whole or refused, older ones stay valid, mapping goes on",
    ),
    Part(
        "clock",
        "jumps of the clock",
        goal=400,
        per_turn=20,
        run=clock.run,
        promise="scans, queries and checkpoints go on, and the newest checkpoint is restored",
        missing=clock.missing,
    ),
    Part(
        "cuts",
        "cut connections",
        goal=1_000,
        per_turn=50,
        run=cuts.run,
        promise="clients see errors of triquad and are served again; what a flush acknowledged is "
        "in the map",
    ),
    Part(
        "stops",
        "SIGSTOPs",
        goal=200,
        per_turn=10,
        run=stops.run,
        promise="a server that was stopped goes on; a client that is stopped holds up nobody else",
    ),
    Part(
        "memory",
        "shortages of memory",
        goal=200,
        per_turn=10,
        run=memory.run,
        promise="what does not fit is refused; where the server ends, all that was acknowledged is "
        "restored; no valid file counts as damaged",
    ),
    Part(
        "crowd",
        "seconds of a crowd",
        goal=3_600,
        per_turn=600,
        run=crowd.run,
        promise="clients that ask and send too much, read nothing or invent names take at most 200 "
        "MB of memory; an honest client is served after them",
    ),
    Part(
        "driving",
        "seconds of simulated driving",
        goal=7_200,
        per_turn=600,
        run=driving.run,
        promise="memory stays flat, no scan is lost",
    ),
)
BY_NAME = {part.name: part for part in PARTS}
