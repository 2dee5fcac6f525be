import logging

import numpy as np
import pytest
from support import servers
from support.clock import Clock
from triquad_format.records.field_settings import FieldSettings
from triquad_format.wire.messages import Scan
from triquad_server.intake.rays import usable_rays
from triquad_server.intake.scan_queue import ScanQueue
from triquad_server.intake.scan_warnings import ScanWarnings
from triquad_server.settings import ScanSettings, Settings, SourceSettings
from triquad_server.settings.loading import load_settings

SETTINGS = Settings()


def cloud(*parts: tuple[int, float]) -> np.ndarray:
    """So many points at each range."""
    points = [servers.sphere(count, radius_m) for count, radius_m in parts]
    return np.concatenate(points)


def watch(settings: Settings = SETTINGS, clock: Clock | None = None) -> ScanWarnings:
    return ScanWarnings(ScanQueue(2), settings, clock or Clock())


def take_in(
    warnings: ScanWarnings, points: np.ndarray, settings: Settings = SETTINGS, scans: int = 20
) -> None:
    source = settings.sources.get("cam", SourceSettings())
    scan = settings.scan_of(source)
    for number in range(scans):
        rays = usable_rays(points, np.eye(4), scan, source=source)
        warnings.add(Scan(points, np.eye(4), number, "cam", 0, number), rays)


def test_points_that_range_min_m_takes_are_told_with_the_setting_to_change() -> None:
    warnings = watch()
    take_in(warnings, cloud((880, 8.0), (120, 1.0)))
    (text,) = warnings.of("cam")
    assert text == (
        "source 'cam': range_min_m = 1.5 drops 12 % of its points: set scan.range_min_m or "
        "sources.cam.range_min_m to less, or the latter to 1.5 if this is meant"
    )


def test_most_points_beyond_the_range_are_told() -> None:
    warnings = watch()
    take_in(warnings, cloud((400, 20.0), (600, 80.0)))
    (text,) = warnings.of("cam")
    assert "range_max_m = 50 drops 60 % of its points" in text
    assert "sources.cam.range_max_m to more" in text


@pytest.mark.parametrize(
    ("range_m", "step_m", "aside_m", "told"),
    [
        (8.0, 0.5, 0.0, ""),
        (8000.0, 0.5, 0.0, "farther than 8000 m: write them in metres"),
        (8.0, 500.0, 0.0, "the sensor moves 1000 m, while half of the points are nearer than 8 m"),
        (8.0, 0.5, 0.4, "its poses jump to and fro by 0.4 m: two programs publish them"),
    ],
)
def test_what_two_publish_and_what_is_in_millimetres_is_told(
    range_m: float, step_m: float, aside_m: float, told: str
) -> None:
    warnings, points = watch(Settings(scan=ScanSettings(range_max_m=100.0))), cloud((500, range_m))
    for number in (0, 2, 3, 5, 6, 8, 9, 11, 12, 14):  # others are lost
        pose = np.eye(4)
        pose[:2, 3] = step_m * number, aside_m * (number % 3 > 0)
        rays = usable_rays(points, pose, SETTINGS.scan)
        warnings.add(Scan(points, pose, 10**8 * number, "cam", 0, number), rays)
    texts = warnings.of("cam")
    assert told in "".join(texts)
    assert len(texts) == bool(told), "nothing else is said of it"


NO_DEPTH = np.zeros((500, 3), np.float32)
RANGES_GIVEN = SourceSettings(range_min_m=1.5, range_max_m=50.0)


@pytest.mark.parametrize(
    ("points", "settings"),
    [
        (cloud((500, 8.0), (80, 1.0), (420, 90.0)), SETTINGS),  # few are near, some background
        (np.concatenate([cloud((500, 8.0)), NO_DEPTH]), SETTINGS),
        (cloud((1000, 2.0)), Settings(field=FieldSettings(leaf_m=0.05))),  # a leaf that suits
        (
            cloud((200, 1.0), (200, 20.0), (600, 80.0)),  # what is given for the source is meant
            Settings(sources={"cam": RANGES_GIVEN}),
        ),
        (
            cloud((200, 1.0), (200, 20.0), (600, 80.0)),
            load_settings(assignments=["scan.range_max_m=50", "sources.cam.range_min_m=1.5"]),
        ),
    ],
)
def test_what_is_as_it_should_be_is_no_reason_to_warn(
    points: np.ndarray, settings: Settings
) -> None:
    warnings = watch(settings)
    take_in(warnings, points, settings)
    assert not warnings.of("cam")


def test_a_near_range_that_is_given_for_all_sources_may_not_suit_each() -> None:
    settings = load_settings(assignments=["scan.range_min_m=2"])
    warnings = watch(settings)
    take_in(warnings, cloud((800, 8.0), (200, 1.0)), settings)
    assert "range_min_m = 2 drops 20 % of its points" in warnings.of("cam")[0]


def test_what_is_near_for_the_leaf_is_told_with_a_leaf_and_a_preset_that_suit() -> None:
    warnings = watch()
    take_in(warnings, cloud((1000, 2.0)))
    (text,) = warnings.of("cam")
    assert "2 m away (median), near for field.leaf_m = 0.2" in text
    assert "--preset indoor, or field.leaf_m = 0.05" in text


def test_lost_scans_are_told_with_how_many_they_are_by_now() -> None:
    scans, clock = ScanQueue(2), Clock()
    warnings = ScanWarnings(scans, SETTINGS, clock)
    for sequence in range(5):
        scans.put(servers.scan(sequence))
    (first,) = warnings.of("lidar")
    assert first.startswith("source 'lidar': 3 of its scans were lost")
    assert "scan.thin_m (it is 0.05)" in first
    for sequence in range(5, 9):
        scans.put(servers.scan(sequence))
    (second,) = warnings.of("lidar")
    assert second.startswith("source 'lidar': 7 of its scans were lost")
    clock.now_s += 59.0
    assert warnings.of("lidar") == (second,)
    clock.now_s += 2.0
    assert not warnings.of("lidar")


def test_scans_that_never_arrived_are_not_blamed_on_a_slow_server() -> None:
    scans = ScanQueue(2)
    warnings = ScanWarnings(scans, SETTINGS, Clock())
    scans.put(servers.scan(10))
    (text,) = warnings.of("lidar")
    assert text.startswith("source 'lidar': 10 of its scans never arrived")
    assert "keep up" not in text


def test_refused_scans_are_told_with_the_reason() -> None:
    scans = ScanQueue(2)
    warnings = ScanWarnings(scans, SETTINGS, Clock())
    scans.put(servers.scan(0))
    scan = scans.take()
    assert scan is not None
    scans.reject(scan, "too_many_points", "7 points exceed scan.max_points = 5")
    (text,) = warnings.of("lidar")
    assert text == (
        "source 'lidar': 1 of its scans were refused, the last since scan 0: "
        "7 points exceed scan.max_points = 5"
    )
    assert not warnings.of("other")
    assert warnings.all() == (text,)


def test_the_log_has_one_line_for_each_telling(caplog: pytest.LogCaptureFixture) -> None:
    clock = Clock()
    warnings = watch(clock=clock)
    with caplog.at_level(logging.WARNING):
        for _ in range(25):
            take_in(warnings, cloud((500, 8.0), (500, 1.0)))
            warnings.check()
            clock.now_s += 10.0
    told_s = (0.0, 30.0, 90.0, 210.0)
    assert [record.levelno for record in caplog.records] == [logging.WARNING] * len(told_s)


def test_a_warning_whose_cause_is_gone_is_no_longer_told() -> None:
    clock = Clock()
    warnings = watch(clock=clock)
    take_in(warnings, cloud((500, 8.0), (500, 1.0)))
    assert warnings.of("cam")
    take_in(warnings, cloud((500, 8.0)))
    clock.now_s += 61.0
    assert not warnings.of("cam")
    assert not warnings.all()


def test_sources_that_are_invented_take_no_memory_without_end() -> None:
    warnings = watch()
    points = cloud((10, 8.0))
    rays = usable_rays(points, np.eye(4), SETTINGS.scan)
    for number in range(2000):
        warnings.add(Scan(points, np.eye(4), number, f"s{number}", 0, 0), rays)
    assert len(warnings._points) == 256
