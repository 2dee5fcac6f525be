"""The choice of the checkpoint that a page shows."""

import time

from triquad_format.mapfile.checkpoint_folder import CheckpointFile

from triquad_tools.console.command import ToolError
from triquad_tools.viewer.page.layer import Layer, newest_epoch
from triquad_tools.viewer.page.legends import problem_html, text_html
from triquad_tools.viewer.page.page import Page
from triquad_tools.viewer.sources import History, moment

_PERIOD_S = 1.0
_PREVIOUS, _NEXT = "◀ Previous", "Next ▶"
_PLAY, _PAUSE = "Play", "Pause"


class TimePanel(Layer):
    """A slider over the checkpoints of a store, to which a server may add."""

    def __init__(self, page: Page, history: History) -> None:
        super().__init__(page, "Time", _PERIOD_S)
        self._history = history
        self._files: list[CheckpointFile] = []
        self._playing, self._due_s = False, 0.0  # monotonic: when the next one is chosen
        with self.folder:
            self._slider = page.gui.add_slider("Checkpoint", 1, 1, 1, 1)
            self._buttons = page.gui.add_button_group("", (_PREVIOUS, _NEXT))
            self._play = page.gui.add_button(_PLAY)
            self.add_text()
        self._buttons.on_click(
            lambda _: self._slide_to(self._slider.value + (-1, 1)[self._buttons.value == _NEXT])
        )
        self._play.on_click(self._press)
        self.start(self._slider)

    def refresh(self) -> None:
        """Add new checkpoints, and show the one that is chosen."""
        files, shown = self._history.files(), newest_epoch(self.page.source.queries)
        if not files:
            raise ToolError("the store has no checkpoint left that can be shown")
        # What is shown, or the one before if it was deleted.
        place = sum(file.epoch <= shown for file in files)
        if files != self._files:  # the slider stays where it is in time
            self._files = files
            self._slider.max = len(files)
            self._slide_to(place)
        self._play_on()
        wanted = files[min(self._slider.value, len(files)) - 1]
        told = f"{moment(wanted)}\n{self._slider.value} of {len(files)}"
        try:
            if wanted.epoch != shown:
                self._say(f"opening {moment(wanted)} …")
                self.page.source = self._history.opened(wanted)
        except ToolError:
            self._slide_to(place)
            raise
        finally:
            self._say(told)

    def _slide_to(self, number: int) -> None:
        chosen = max(min(number, len(self._files)), 1)
        self._slider.value = chosen  # type: ignore[misc] # viser has a setter that mypy overlooks
        self.wake()

    def _press(self, _: object) -> None:
        self._playing = not self._playing
        if self._playing:
            self._step()

    def _step(self) -> None:
        """Choose the next one; after the last, the first."""
        self._due_s = time.monotonic() + _PERIOD_S
        self._slide_to(self._slider.value % max(len(self._files), 1) + 1)

    def _play_on(self) -> None:
        """Choose the next one where the mesh of the one before is drawn and was for a while."""
        is_drawn = self.page.drawn is self.page.source
        if self._playing and is_drawn and time.monotonic() >= self._due_s:
            self._playing = self._slider.value < len(self._files)
            if self._playing:
                self._step()
        self._play.label = _PAUSE if self._playing else _PLAY

    def _say(self, text: str) -> None:
        self.tell(text_html(text) + problem_html("\n".join(self._history.damaged())))
