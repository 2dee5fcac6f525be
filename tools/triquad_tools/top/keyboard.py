"""What is typed while a page is on the terminal."""

import os
import select
import signal
import sys
import termios
import time
import tty

_LEAVE, _ENTER = b"\x1b[?25h\x1b[?1049l", b"\x1b[?1049h\x1b[?25l"
"""From the page's screen, without a cursor, back to that of the shell; and the reverse."""


class Keyboard:
    """Keys that are typed are not shown; ``q`` ends the page, and Ctrl-Z suspends it.

    Where nobody can type, as with ``</dev/null``, nothing happens.
    """

    def __init__(self) -> None:
        self._input = sys.stdin.fileno() if sys.stdin is not None and sys.stdin.isatty() else None

    def __enter__(self) -> "Keyboard":
        if self._input is not None:
            self._before = termios.tcgetattr(self._input)
            tty.setcbreak(self._input)
            self._suspend_before = signal.signal(signal.SIGTSTP, self._suspend)
        return self

    def __exit__(self, *_: object) -> None:
        if self._input is not None:
            signal.signal(signal.SIGTSTP, self._suspend_before)
            termios.tcsetattr(self._input, termios.TCSADRAIN, self._before)

    def ends_within(self, seconds: float) -> bool:
        """Whether ``q`` is typed, or the terminal closed, within so many seconds."""
        end_s = time.monotonic() + seconds
        if self._input is None:
            time.sleep(seconds)
            return False
        while select.select([self._input], [], [], max(0.0, end_s - time.monotonic()))[0]:
            typed = os.read(self._input, 1024)
            if not typed or b"q" in typed.lower():
                return True
        return False

    def _suspend(self, *_: object) -> None:
        """Give the terminal back to the shell, and take it again once this goes on."""
        assert self._input is not None
        output = sys.stdout.fileno()
        os.write(output, _LEAVE)
        termios.tcsetattr(self._input, termios.TCSADRAIN, self._before)
        signal.signal(signal.SIGTSTP, self._suspend_before)
        signal.raise_signal(signal.SIGTSTP)
        signal.signal(signal.SIGTSTP, self._suspend)
        tty.setcbreak(self._input)
        os.write(output, _ENTER)
