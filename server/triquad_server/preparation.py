"""Compiled code is prepared: what answers before the server is ready, what maps right after it."""

import logging
import threading
import time
from collections.abc import Callable

from triquad_map.compiled.bitcode import pack_bitcode
from triquad_map.compiled.kernel import COMPILING

from triquad_server import compilers
from triquad_server.compilers import Compilers
from triquad_server.process.threads import Teams
from triquad_server.settings import Settings
from triquad_server.warm_up import (
    ANSWERING,
    MAPPING,
    MESHING,
    STAGES,
    WarmUp,
    can_keep,
    is_compiled,
)

_QUICK_S = 3.0
"""Compiled code that is found on disk is ready by then."""

_log = logging.getLogger("triquad_server")


class _ClosedError(Exception):
    """Nothing needs to be prepared any more."""


class Preparation:
    """Has all kernels compiled, or found on disk; whoever waits for it is told how it goes."""

    def __init__(
        self,
        settings: Settings,
        device: str,
        teams: Teams,
        *,
        starting: Callable[[str], None],
        check: Callable[[], None],
    ) -> None:
        """Until the server is ready, ``starting`` is told what comes next.

        ``check`` is called now and then meanwhile, and may raise what ends the start.
        """
        self._settings = settings
        self._device = device
        self._teams = teams
        self._starting = starting
        self._check = check
        self._made_up = WarmUp(settings, device, teams)
        self._compilers: Compilers | None = None
        self._is_done = False
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None

    def for_answers(self) -> None:
        """Prepare what answers; where code cannot be kept on disk, all is compiled here and now."""
        _log.info("preparing compiled code")
        self._started_s = time.monotonic()
        can_wait = self._device == "cpu" and can_keep() and compilers.can_start()
        if can_wait:
            self._compile_beside()
        for stage in ANSWERING if can_wait else STAGES:
            self._report(stage.replace("_", " "))
            self._go_through(stage, self._check)
        self._check()
        self._is_done = not can_wait

    def for_mapping(self, done: Callable[[], None], failed: Callable[[], None]) -> None:
        """Prepare the rest beside what is served; call ``done`` after it, or ``failed``."""
        if self._is_done:
            done()
            return
        self._thread = threading.Thread(
            target=self._prepare_mapping, args=(done, failed), name="preparation"
        )
        self._thread.start()

    def close(self) -> None:
        """Prepare nothing more."""
        self._closing.set()
        if self._thread is not None:
            self._thread.join()
        if self._compilers is not None:
            self._compilers.close()

    def _compile_beside(self) -> None:
        """Have others compile, where something is missing."""
        if all(map(is_compiled, STAGES)):
            return
        _log.warning(
            "%s. Questions are answered as soon as they can be; "
            "scans wait until they can be taken in",
            COMPILING,
        )
        self._compilers = Compilers(self._settings)

    def _go_through(self, stage: str, look: Callable[[], None]) -> None:
        look()
        if self._compilers is not None:
            self._compilers.wait_for(stage, look)
        self._made_up.go_through(stage)

    def _prepare_mapping(self, done: Callable[[], None], failed: Callable[[], None]) -> None:
        try:
            for stage in MAPPING:
                self._tell(f"next, while scans wait: {stage.replace('_', ' ')}")
                self._go_through(stage, self._look_for_close)
            self._tell("scans are taken in from now on")
            done()
            for stage in MESHING:
                self._go_through(stage, self._look_for_close)
            self._tell("all is compiled")
            _pack()
        except _ClosedError:
            pass
        except Exception:
            _log.exception("compiled code could not be prepared")
            failed()

    def _tell(self, what: str) -> None:
        if self._compilers is not None:
            _log.info("%.0f s since the start: %s", time.monotonic() - self._started_s, what)

    def _report(self, stage: str) -> None:
        self._starting(f"preparing compiled code: {stage}")
        seconds = time.monotonic() - self._started_s
        if seconds > _QUICK_S:
            _log.info("%.0f s so far; next: %s", seconds, stage)

    def _look_for_close(self) -> None:
        if self._closing.is_set():
            raise _ClosedError


def _pack() -> None:
    """Keep the bitcode of kernels in less memory; without it, the server merely takes more."""
    try:
        pack_bitcode()
    except Exception:
        _log.warning("the bitcode of compiled code could not be packed", exc_info=True)
