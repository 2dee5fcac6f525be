"""The axes on which answers are drawn, for people who have matplotlib."""

from __future__ import annotations

from typing import TYPE_CHECKING

from triquad_format.errors import InvalidInputError

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def drawn_on(axes: Axes | None) -> Axes:
    """Return ``axes``, or where there are none those of a new figure, labelled as a plan.

    Raises:
        InvalidInputError: matplotlib is not installed.
    """
    try:
        from matplotlib import pyplot
    except ModuleNotFoundError as error:
        told = "matplotlib is missing: pip install 'triquad[notebook]'"
        raise InvalidInputError(told) from error
    drawn = pyplot.subplots()[1] if axes is None else axes
    drawn.set(xlabel="x, m", ylabel="y, m", aspect="equal")
    return drawn
