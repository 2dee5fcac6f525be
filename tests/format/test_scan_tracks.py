"""Poses of a scan log that are corrected again and again."""

import numpy as np
from support.poses import shifted
from triquad_format.scan_log.ros_messages import Transform
from triquad_format.scan_log.segment import LoggedCorrection
from triquad_format.scan_log.tracks import LogPoses

APART_M = 0.5  # a scan has moved once anything near it has by a centimetre


def test_small_corrections_add_up() -> None:
    poses, stamps_ns = LogPoses(APART_M), [1_000_000_000, 2_000_000_000]
    for stamp_ns in stamps_ns:
        poses.take(Transform(stamp_ns, "roof", np.eye(4)))
    moves = np.array([shifted(x=0.004), np.eye(4)])
    correction = LoggedCorrection("roof", np.array(stamps_ns), moves, stamps_ns[-1])
    assert [list(poses.correct(correction)) for _ in range(2)] == [[], []]
    poses.take(correction)  # together they move it by enough: it was learnt from again then
    assert list(poses.correct(correction)) == []
    np.testing.assert_allclose(poses.poses[0], shifted(x=0.016), atol=1e-12)
    moved = [poses.correct(correction) for _ in range(2)]
    assert [list(one) for one in moved] == [[], [0]]
    np.testing.assert_allclose(moved[1][0], shifted(x=0.012), atol=1e-12)
