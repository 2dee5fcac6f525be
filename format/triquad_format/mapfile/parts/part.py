"""The parts of a map file: what each is called, and what each is of."""

from dataclasses import dataclass

from triquad_format.records.region import RegionIndex

PREFIX = "/triquad/"
MAP = "/triquad/map"
REGION = "/triquad/region"
VERTICES = "/triquad/vertices"
EVIDENCE = "/triquad/evidence"
TRAINING = "/triquad/training"
MOMENTS = "/triquad/moments"
SAMPLES = "/triquad/samples"
MANIFEST = "/triquad/manifest"
PREVIEW = "/preview/mesh"

FIELD_TOPICS = (REGION, VERTICES, EVIDENCE)
TRAINING_TOPICS = (TRAINING, MOMENTS, SAMPLES)
REGION_TOPICS = (*FIELD_TOPICS, *TRAINING_TOPICS)
TOPICS = (MAP, *REGION_TOPICS, MANIFEST)

NO_REGION: RegionIndex = (0, 0, 0)


@dataclass(frozen=True, order=True)
class PartKey:
    """What a part is of; no two parts of a map have the same key."""

    topic: str
    region: RegionIndex = NO_REGION  # also of what belongs to the whole map
    plane: int = 0  # of vertices and moments
    cell: int = 0  # Morton code of a square or cube; number of a portion of samples


@dataclass(frozen=True)
class Part:
    """One part, packed."""

    key: PartKey
    payload: bytes
    seams: tuple[int, ...] = ()  # offsets in the payload where bytes of another kind begin
