"""What ``triquad-pack --recover`` prints."""

from triquad_format.mapfile.parts.part import EVIDENCE, REGION, TRAINING, VERTICES
from triquad_format.recovery.loss import Loss
from triquad_format.recovery.recovered_map import RecoveredMap

_PLANES = ("XY", "XZ", "YZ")


def print_recovery(recovery: RecoveredMap) -> None:
    """Print a line for each loss, and how much was saved."""
    for loss in recovery.losses:
        print(f"lost: {_what(loss)}{_where(loss)}")
    if recovery.parts_listed is None:
        saved = f"saved {recovery.parts_intact} parts"
        print(f"{saved}; the list of parts is lost: there may have been more")
    elif recovery.complete:
        print(f"saved all {recovery.parts_listed} parts: nothing is lost")
    else:
        print(f"saved {recovery.parts_intact} of {recovery.parts_listed} parts")
    if not recovery.record.has_evidence:
        print("no evidence is left: the map gives distances, but says UNKNOWN everywhere")


def _what(loss: Loss) -> str:
    region = "region {} {} {}".format(*loss.key.region)
    return {
        REGION: f"{region}, all of it",
        VERTICES: f"vertices of plane {_PLANES[loss.key.plane]} of {region}: now UNKNOWN",
        EVIDENCE: f"evidence of {region}: now UNKNOWN",
        TRAINING: f"training state of {region}: it answers, but learns anew",
    }[loss.key.topic]


def _where(loss: Loss) -> str:
    if loss.key.topic == TRAINING:
        return ""
    bounds = zip("xyz", loss.minimum.tolist(), loss.maximum.tolist(), strict=True)
    return ", " + ", ".join(f"{axis} {low:.1f} to {high:.1f} m" for axis, low, high in bounds)
