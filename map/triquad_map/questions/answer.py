"""The behaviour that all answers about many things share."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

import numpy as np
from triquad_format.errors import InvalidInputError
from triquad_format.records.arrays import Bools, Ints, Longs
from triquad_format.records.status import Status, Statuses

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes

AnswerT = TypeVar("AnswerT", bound="Answer")
_AXES = "xyz"


class Answer:
    """An answer of one ``epoch`` about N things, whose arrays [N, ...] have a row for each.

    ``len(answer)`` is N, and ``answer[i]``, with a number, a slice, numbers or a mask, is the
    answer about these alone.
    """

    _things: ClassVar[str] = "points"
    epoch: int

    def __post_init__(self) -> None:
        """Let statuses be told by their names."""
        if (status := getattr(self, "status", None)) is not None:
            object.__setattr__(self, "status", Statuses.of(status))

    def __len__(self) -> int:
        return next(map(len, self._arrays().values()))

    def __getitem__(self: AnswerT, which: int | slice | Ints | Longs | Bools) -> AnswerT:
        rows = np.atleast_1d(np.arange(len(self))[which])
        if rows.ndim > 1:
            raise IndexError(f"an index of {rows.ndim} dimensions: use a number, a slice or [N]")
        parts = {name: array[rows] for name, array in self._arrays().items()}
        return dataclasses.replace(self, **parts)  # type: ignore[type-var]

    def __repr__(self) -> str:
        told = f"{len(self)} {self._things}"
        if len(self):
            told += f": {self._told()}"
        return f"{type(self).__name__}({told}; epoch {self.epoch})"

    def to_pandas(self) -> pd.DataFrame:
        """Return a table with a row for each thing, and three columns for each vector.

        Raises:
            InvalidInputError: pandas is not installed.
        """
        try:
            import pandas as pd
        except ModuleNotFoundError as error:
            told = "pandas is missing: pip install 'triquad[notebook]'"
            raise InvalidInputError(told) from error
        columns: dict[str, Any] = {}
        for field, array in self._arrays().items():
            name = field.removeprefix("_")
            if isinstance(array, Statuses):
                columns[name] = pd.Categorical.from_codes(array, [one.name for one in Status])
            elif array.ndim == 1:
                columns[name] = array
            else:
                columns |= {f"{name}_{axis}": array[:, i] for i, axis in enumerate(_AXES)}
        return pd.DataFrame(columns)

    def _told(self) -> str:
        """Return how many things are of which kind."""
        status: Statuses = self.status  # type: ignore[attr-defined]
        return status.counted()

    def _arrays(self) -> dict[str, np.ndarray]:
        """Return the arrays by the names of their fields; what was not asked for has none."""
        values = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}  # type: ignore[arg-type]
        return {name: value for name, value in values.items() if isinstance(value, np.ndarray)}


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
