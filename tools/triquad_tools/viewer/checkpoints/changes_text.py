"""What changed between two checkpoints, as a list."""

from triquad_tools.mapfiles.object_changes import LEAST_POINTS, Cluster, ObjectChanges

_LISTED = 5  # of each kind


def changes_text(found: ObjectChanges) -> str:
    """How much changed, and the largest things by name, size and place."""
    kinds = (
        ("appeared", [(f"A{n}", one) for n, one in enumerate(found.appeared, start=1)]),
        ("vanished", [(f"V{n}", one) for n, one in enumerate(found.vanished, start=1)]),
        ("moved", [(f"M{n}", one.after) for n, one in enumerate(found.moved, start=1)]),
    )
    lines = []
    for kind, clusters in kinds:
        lines.append(f"{len(clusters)} {kind}")
        lines += [f"  {name}: {_told(cluster)}" for name, cluster in clusters[:_LISTED]]
    lines.append(
        f"newly seen: {len(found.newly_seen)}, no longer known: {len(found.no_longer_known)} "
        "(not drawn: one of the two has never been there)"
    )
    small = found.small.appeared + found.small.vanished
    lines.append(f"{small} things of fewer than {LEAST_POINTS} voxels are left out")
    return "\n".join(lines)


def _told(cluster: Cluster) -> str:
    size = " × ".join(f"{side:.1f}" for side in cluster.size_m)
    place = ", ".join(f"{value:.1f}" for value in cluster.middle_m)
    return f"{cluster.points:,} voxels, {size} m, at {place}"
