"""A map that a service takes over, with all that belongs to it."""

from dataclasses import dataclass, field

from triquad_format.wire.messages import CheckpointInfo

from triquad_server.mapping.mapper import Mapper
from triquad_server.process.threads import Teams
from triquad_server.store.store import Store


@dataclass(frozen=True)
class ServedMap:
    """A map that is handed over to a service; nothing else may use it from then on."""

    name: str
    mapper: Mapper
    device: str  # device of the mapper
    store: Store | None = None  # store of its checkpoints
    restored: CheckpointInfo | None = None  # checkpoint that it was restored from
    teams: Teams = field(default_factory=Teams)  # teams that make mesh tiles
