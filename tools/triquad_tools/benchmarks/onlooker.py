"""Somebody who looks at the map of a server: a process with the viewer and a browser.

It only takes what the machine has left, as it would run on another one. Commands on its standard
input, a line each: ``open`` opens the page, and is answered with the seconds until a mesh is drawn;
``close`` closes it. It ends with its input.
"""

import os
import subprocess
import sys
import time
from contextlib import ExitStack

from triquad_client import connect

from triquad_tools.benchmarks.browser import opened_page, running_browser, wait_until_drawn
from triquad_tools.console.command import ToolError
from triquad_tools.viewer.sources.live_source import LiveSource
from triquad_tools.viewer.viewer import Viewer


class Onlooker:
    """That process; leaving the ``with`` statement ends it."""

    def __init__(self, endpoint: str, map_name: str) -> None:
        command = [sys.executable, "-m", __name__, endpoint, map_name]
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        self._ask("wait")

    def __enter__(self) -> "Onlooker":
        return self

    def __exit__(self, *_: object) -> None:
        self._process.__exit__(None, None, None)

    def open(self) -> float:
        """Open the page; seconds until a mesh is drawn."""
        return float(self._ask("open"))

    def close(self) -> None:
        """Close the page."""
        self._ask("close")

    def _ask(self, command: str) -> str:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(f"{command}\n")
        self._process.stdin.flush()
        answer = self._process.stdout.readline()
        if not answer:
            raise ToolError(f"the viewer's process ended with exit code {self._process.wait()}")
        return answer


def main() -> None:
    """Obey until the input ends."""
    os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    endpoint, map_name = sys.argv[1:]
    with connect(endpoint, map_name) as client, running_browser() as browser, ExitStack() as page:
        viewer = Viewer(LiveSource(client, endpoint), "127.0.0.1", 0)
        page.callback(viewer.close)
        shown = page.enter_context(ExitStack())
        for command in sys.stdin:
            started = time.monotonic()
            if command.strip() == "open":
                wait_until_drawn(shown.enter_context(opened_page(browser, viewer.url)))
            elif command.strip() == "close":
                shown.close()
            print(time.monotonic() - started, flush=True)


if __name__ == "__main__":
    main()
