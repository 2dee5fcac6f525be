"""Somebody who looks at the map of a server: a process with the viewer and a browser.

It would run on another machine: here it only takes what this one has left. Commands on its standard
input, a line each: ``open`` opens the page, and is answered with the seconds until a mesh is drawn;
``freeze`` stops the browser, which goes on to be sent what changes but takes no processor any
more, and ``thaw`` lets it go on; ``close`` closes the page. It ends with its input.
"""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

from triquad_client import connect
from triquad_tools.console.command import ToolError
from triquad_tools.console.lines import print_line
from triquad_tools.viewer.sources.live_source import LiveSource
from triquad_tools.viewer.viewer import Viewer

from bench.clients.browser import opened_page, running_browser, wait_until_drawn

_SIGNALS = {"freeze": signal.SIGSTOP, "thaw": signal.SIGCONT}


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

    def freeze(self) -> None:
        """Stop the browser's processes, as if they ran elsewhere."""
        self._ask("freeze")

    def thaw(self) -> None:
        """Let them go on."""
        self._ask("thaw")

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


def _descendants(parent: int) -> Iterator[int]:
    """The processes that a process has started, and theirs."""
    found = subprocess.run(["ps", "-o", "pid=", "--ppid", str(parent)], capture_output=True)
    for text in found.stdout.split():
        yield from _descendants(int(text))
        if Path(f"/proc/{int(text)}").exists():  # not that of ps itself
            yield int(text)


def main() -> None:
    """Obey until the input ends."""
    endpoint, map_name = sys.argv[1:]
    with connect(endpoint, map_name) as client, ExitStack() as page:
        # From here on, for the threads of the network have to take what the server sends.
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
        browser = page.enter_context(running_browser())
        viewer = Viewer(LiveSource(client, endpoint), "127.0.0.1", 0)
        page.callback(viewer.close)
        shown = page.enter_context(ExitStack())
        for command in sys.stdin:
            started = time.monotonic()
            if command.strip() == "open":
                wait_until_drawn(shown.enter_context(opened_page(browser, viewer.url)))
            elif command.strip() in _SIGNALS:
                for process in _descendants(os.getpid()):
                    os.kill(process, _SIGNALS[command.strip()])
            elif command.strip() == "close":
                shown.close()
            print_line(str(time.monotonic() - started))


if __name__ == "__main__":
    main()
