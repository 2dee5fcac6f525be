"""Two maps as one."""

from collections.abc import Iterator, Mapping
from contextlib import closing
from dataclasses import replace

import numpy as np
from triquad_format.records.arrays import Doubles, Longs
from triquad_format.records.field_settings import RegionIndex
from triquad_format.records.region import (
    MapProgress,
    MapRecord,
    Region,
    TrainingState,
    seen_voxels,
)
from triquad_format.records.replay_rays import ReplayRays
from triquad_map.compiled.voxel_index import keys_of
from triquad_map.evidence.merged_evidence import merged_evidence
from triquad_server.intake.rays import ScanRays
from triquad_server.mapping.live_region import LiveRegion
from triquad_server.mapping.mapper import Mapper
from triquad_server.process.threads import Teams
from triquad_server.settings import Settings
from triquad_server.warm_up import warm_up

from triquad_tools.console.command import ToolError
from triquad_tools.console.progress import progress
from triquad_tools.mapping.learning import learn
from triquad_tools.mapping.moved_map import aligned, moved_map

_NO_LIMIT = 1 << 50  # bytes
_MOST_REGIONS = 1_000_000

Removed = Mapping[RegionIndex, Longs]
"""Voxels [N, 3] of regions that have lost their surface."""


def merged(
    first: MapRecord,
    second: MapRecord,
    settings: Settings | None = None,
    guess: Doubles | None = None,
) -> MapRecord:
    """Return the map of both, with its training state.

    A region that both know is learnt again on the rays of both: the features of two fields cannot
    be joined, as each has a decoder of its own. Surface of the map that was seen earlier is removed
    where rays of the later one show that it is there no more, as in a map that is told of both.

    Args:
        first: a map with its training state.
        second: likewise; its name and its frame are those of the result.
        settings: of beliefs and training; ``None``: the default ones.
        guess: [4, 4] about where the frame of ``first`` is in that of ``second``: it is moved to
            where both fit; ``None``: they have one frame, and one origin.

    Raises:
        ToolError: they do not fit together, or one has no rays.
    """
    _check(first, second)
    if guess is None:
        _check_origins(first, second)
    settings = _of_large_maps(settings or Settings()).with_field(second.settings)
    with closing(Teams()) as teams:
        with progress("preparing") as report:
            warm_up(settings, "cpu", teams, report=lambda stage: report(0.0, stage))
        if guess is not None:
            pose = aligned(second, first, guess)
            first = moved_map(first, pose, second.origin, settings, teams)
        earlier, later = sorted((first, second), key=_newest_s)
        removed = _removed(earlier, later, settings, teams)
        known = {region.index: region for region in earlier.regions}
        joined = (
            _joined(known[one.index], one, removed[one.index], settings)
            for one in later.regions
            if one.index in known
        )
        settled = _settled(replace(later, regions=tuple(joined)), settings, teams, removed)
        parts = (*earlier.regions, *later.regions, *settled.regions)
        regions = {region.index: region for region in parts}
        taken = first.progress.scans_taken + second.progress.scans_taken
        trained = earlier.progress.samples_trained + settled.progress.samples_trained
        return replace(
            second,
            epoch=max(first.epoch, second.epoch),
            regions=tuple(regions[index] for index in sorted(regions)),
            progress=MapProgress(taken, trained, settled.progress.loss),
        )


def _of_large_maps(settings: Settings) -> Settings:
    """Return settings with which no ray and no region is left out for lack of memory."""
    memory = settings.memory.model_copy(update={"max_bytes": _NO_LIMIT})
    limits = {"pool_bytes": _NO_LIMIT, "max_regions": _MOST_REGIONS}
    training = settings.training.model_copy(update=limits)
    return settings.model_copy(update={"memory": memory, "training": training})


def _newest_s(record: MapRecord) -> int:
    return max(int(region.evidence.seen_s.max(initial=0)) for region in record.regions)


def _check(first: MapRecord, second: MapRecord) -> None:
    """Raise :class:`ToolError` for maps that do not fit together, or without rays."""
    for record, which in ((first, "first"), (second, "second")):
        states = [one.training for one in record.regions]
        if not any(state is not None and len(state.rays) for state in states) or None in states:
            raise ToolError(
                f"the {which} map has no rays to learn from: give a server's store, or a file of "
                "client.download_map(training=True) or of triquad-map --training"
            )
    if first.settings != second.settings:
        raise ToolError(
            f"both maps need the same [field] settings: one has {first.settings}, the other "
            f"{second.settings}"
        )


def _check_origins(first: MapRecord, second: MapRecord) -> None:
    """Raise :class:`ToolError` for maps that count from different origins."""
    if first.origin_m != second.origin_m:
        raise ToolError(
            f"the maps count from different origins, {first.origin_m} and {second.origin_m} m, as "
            "where coordinates are large and the first scans were not taken at one place: give "
            "--align 0 0 0 0, which moves one to the other's"
        )


def _removed(earlier: MapRecord, later: MapRecord, settings: Settings, teams: Teams) -> Removed:
    """Return the surface of one map that the rays of a later one show to be there no more."""
    seen_again = {region.index: region for region in later.regions}
    both = tuple(region for region in earlier.regions if region.index in seen_again)
    mapper = Mapper(earlier.name, settings, "cpu", replace(earlier, regions=both), teams)
    mapper.publish()  # which fits surfels: the rays are compared with these
    removed = {}
    with progress("comparing", len(both)) as report:
        for done, live in enumerate(mapper.regions, start=1):
            before = _surface(live)
            for scan in _scans(seen_again[live.index], live):
                live.believe(live.scan_seen(scan, stamp_s=0))
            removed[live.index] = before[~np.isin(keys_of(before), keys_of(_surface(live)))]
            report(done, f"{done} of {len(both)} regions")
    return removed


def _surface(live: LiveRegion) -> Longs:
    evidence = live.evidence.live.record()
    return seen_voxels(evidence, evidence.surface)


def _scans(region: Region, live: LiveRegion) -> Iterator[ScanRays]:
    """Yield the rays that a region has kept, those from one place together."""
    rays = _training(region).rays
    ends, origins = rays.ends_m(live.field.settings) + live.centre, rays.origins + live.centre
    order = np.argsort(rays.origin_of, kind="stable")
    bounds = np.searchsorted(rays.origin_of[order], np.arange(len(origins) + 1))
    for number, origin in enumerate(origins):
        own = order[bounds[number] : bounds[number + 1]]
        yield ScanRays(origin.astype(np.float64), ends[own], points_dropped={})


def _training(region: Region) -> TrainingState:
    assert region.training is not None, "it was checked"
    return region.training


def _joined(earlier: Region, later: Region, removed: Longs, settings: Settings) -> Region:
    """Return a region that two maps know, still to be trained."""
    one, other = _training(earlier), _training(later)
    first, second = one.rays, other.rays
    rays = ReplayRays(
        np.concatenate([first.ends, second.ends]),
        np.concatenate([first.origin_of, second.origin_of + len(first.origins)]).astype(np.int32),
        np.concatenate([first.slopes, second.slopes]),
        origins=np.concatenate([first.origins, second.origins]),
    )
    training = replace(
        one,
        sample_points=np.concatenate([one.sample_points, other.sample_points]),
        sample_labels=np.concatenate([one.sample_labels, other.sample_labels]),
        rays=rays,
        budget_samples=int(settings.training.samples_per_ray * len(rays)),
    )
    evidence = merged_evidence(earlier.evidence, later.evidence, removed)
    return replace(earlier, evidence=evidence, training=training)


def _settled(record: MapRecord, settings: Settings, teams: Teams, removed: Removed) -> MapRecord:
    """Return a map of joined regions once nothing is left to learn."""
    mapper = Mapper(record.name, settings, "cpu", record, teams)
    for live in mapper.regions:
        live.field.grow(_surface(live))
        live.training.rays.forget_ends(removed[live.index])
    mapper.publish()
    learn(mapper)
    return mapper.snapshot_since(None).record()
