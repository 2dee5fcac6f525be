"""The eleven parts of the campaign; ``docs/reliability.md`` has the promise that each is about."""

from bench.campaign.parts import (
    busy,
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
    Part("messages", "messages", messages.run, goal=200_000, per_turn=10_000),
    Part("files", "files", files.run, goal=50_000, per_turn=2_500),
    Part("kills", "kills", kills.run, goal=200, per_turn=10),
    Part("busy", "kills on a busy machine", busy.run, goal=50, per_turn=5),
    Part("disk", "writes on a full disk", disk.run, goal=2_000, per_turn=100),
    Part("clock", "jumps of the clock", clock.run, 400, per_turn=20, missing=clock.missing),
    Part("cuts", "cut connections", cuts.run, goal=1_000, per_turn=50),
    Part("stops", "SIGSTOPs", stops.run, goal=200, per_turn=10),
    Part("memory", "shortages of memory", memory.run, goal=200, per_turn=10),
    Part("crowd", "seconds of a crowd", crowd.run, goal=3_600, per_turn=600),
    Part("driving", "seconds of simulated driving", driving.run, goal=7_200, per_turn=600),
)
BY_NAME = {part.name: part for part in PARTS}
