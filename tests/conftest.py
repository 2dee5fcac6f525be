"""What every run of the tests does: long modules come first, and what each took is kept.

``tests/durations.json`` holds the seconds that a core takes for each file. The newest run
is kept in ``test-durations.json`` next to the project's configuration, and the files that grew most
are listed at the end. So are the tests that compiled kernels: ``triquad_server.warm_up`` compiles
what most tests need, and each kernel beyond takes seconds to a minute.
"""

import json
import signal
import sys
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings

_KNOWN = Path(__file__).with_name("durations.json")
_GREW_S = 5.0  # the least growth of a file that is listed
_LISTED = 5  # files, at most
_COMPILED = "compiled kernels"


class Durations:
    """The seconds that each file took, with what it set up; from all workers."""

    def __init__(self, config: pytest.Config) -> None:
        self._config = config
        self._seconds: dict[str, float] = defaultdict(float)
        self._compiled: dict[str, int] = defaultdict(int)  # kernels, by test

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        self._seconds[report.nodeid.partition("::")[0]] += report.duration
        for name, value in report.user_properties:
            if name == _COMPILED:
                self._compiled[report.nodeid] += int(str(value))

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        if not self._seconds:
            return
        for test, kernels in self._compiled.items():
            terminalreporter.write_line(f"{test} compiled {kernels} kernels")
        took = {name: round(seconds, 1) for name, seconds in sorted(self._seconds.items())}
        newest = self._config.rootpath / "test-durations.json"
        earlier = _read(newest)  # of files that did not run this time
        newest.write_text(json.dumps(earlier | took, indent=1) + "\n", encoding="utf-8")
        known = _read(_KNOWN)
        growth = {name: took[name] - known[name] for name in took.keys() & known.keys()}
        grown = sorted(growth, key=lambda name: -growth[name])[:_LISTED]
        for name in grown:
            if growth[name] > _GREW_S:
                text = f"{name}: {took[name]} s, {growth[name]:+.1f} s against durations.json"
                terminalreporter.write_line(text)


def _read(path: Path) -> dict[str, float]:
    """The seconds of each file, as they were kept; of none where nothing was."""
    if not path.exists():
        return {}
    found: dict[str, float] = json.loads(path.read_text(encoding="utf-8"))
    return found


def pytest_configure(config: pytest.Config) -> None:
    # A shell's background ignores Ctrl-C, and so would all processes that tests start.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    settings.register_profile("untimed", deadline=None)  # a busy machine is no fault
    settings.load_profile("untimed")
    config.pluginmanager.register(Kernels())
    if not hasattr(config, "workerinput"):  # the process that hears of all workers
        config.pluginmanager.register(Durations(config))


class Kernels:
    """Notes which tests, with what they set up, compile kernels in this process."""

    def __init__(self) -> None:
        self._before = 0

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(self) -> Iterator[pytest.TestReport]:
        report: pytest.TestReport = yield
        module = sys.modules.get("triquad_map.compiled.kernel")
        count = module.count_compiled() if module else 0
        if count > self._before:
            report.user_properties.append((_COMPILED, count - self._before))
            self._before = count
        return report


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Long files first, so that none of them is what the other workers wait for in the end."""
    known = _read(_KNOWN)
    root = config.rootpath

    def seconds(item: pytest.Item) -> float:
        return known.get(item.path.relative_to(root).as_posix(), 0.0)

    items.sort(key=seconds, reverse=True)
