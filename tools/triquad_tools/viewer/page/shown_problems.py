"""What goes wrong on a page, at its top."""

import threading

import viser

from triquad_tools.viewer.page.panel_html import problem_html


class ShownProblems:
    """The problems that the parts of one page have now; for several threads."""

    def __init__(self, text: viser.GuiHtmlHandle) -> None:
        """``text`` is where they are shown."""
        self._text = text
        self._problems: dict[str, str] = {}  # by part of the page
        self._changing = threading.Lock()

    def tell(self, part: str, problem: str) -> None:
        """Show the problem of a part; with an empty text it has none any more."""
        with self._changing:
            self._problems[part] = problem
            different = dict.fromkeys(filter(None, self._problems.values()))
            self._text.content = problem_html("\n".join(different))
