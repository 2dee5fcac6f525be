"""The forms of lines with poses: which column holds what.

A header line tells it, or else the number of columns and what stands in them. A form is written as
the names of its columns: ``t`` is a time, ``sec`` and ``nsec`` its two parts, ``n`` the number of
a scan, ``m`` each number of a matrix, row by row, and ``_`` whatever is not used.
"""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from triquad_client.pose import UNIT_TOLERANCE
from triquad_format.records.arrays import Doubles
from triquad_format.records.pose import is_rotation

from triquad_tools.console.command import ToolError
from triquad_tools.recordings.text_lines import Line, all_lines, parse_number


class Form(NamedTuple):
    """The names of the columns of a trajectory, whose quaternion may have w first or last."""

    name: str
    columns: Sequence[str]
    unit_ns: int | None = None  # of times, where a header says it; else by their size
    has_header: bool = False

    @property
    def order(self) -> str:
        """Where its quaternion has w: ``xyzw`` or ``wxyz``."""
        return "xyzw" if self.columns.index("qx") < self.columns.index("qw") else "wxyz"

    def numbers(self, lines: Sequence[Line], *wanted: str) -> Doubles:
        """Return the numbers of columns, [lines, columns], of which some may not be finite.

        Raises:
            ToolError: a word is no number.
        """
        places = [i for name in wanted for i, each in enumerate(self.columns) if each == name]
        table = np.empty((len(lines), len(places)))
        for row, line in zip(table, lines, strict=True):
            words = line.words
            row[:] = [parse_number(line.place, words[place]) for place in places]
        return table


_XYZ = "x y z"
_XYZW, _WXYZ = "qx qy qz qw", "qw qx qy qz"
_ROWS, _SQUARE = " m" * 12, " m" * 16

_FORMS = [
    Form(name, columns.split())
    for name, columns in (
        ("positions and quaternions", f"{_XYZ} {_XYZW}"),
        ("TUM trajectory", f"t {_XYZ} {_XYZW}"),  # HeLiPR: in nanoseconds
        ("RTAB-Map trajectory", f"t {_XYZ} {_XYZW} _"),
        ("MCD trajectory", f"n t {_XYZ} {_XYZW}"),
        ("Newer College trajectory", f"sec nsec {_XYZ} {_XYZW}"),
        ("Newer College trajectory", f"n sec nsec {_XYZ} {_XYZW}"),
        ("KITTI poses", _ROWS),
        ("KITTI-360 poses", f"n {_ROWS}"),
        ("MulRan trajectory", f"t {_ROWS}"),
        ("poses of 4 x 4", _SQUARE),
        ("KITTI-360 poses", f"n {_SQUARE}"),
        ("poses of 4 x 4 with times", f"t {_SQUARE}"),
        ("EuRoC trajectory", f"t {_XYZ} {_WXYZ} _ _ _ _ _ _ _ _ _"),
    )
]

_TIMES = {"t", "time", "timestamp", "stamp", "timestamps", "utime"}
_PARTS = {"sec": "sec", "secs": "sec", "nsec": "nsec", "nsecs": "nsec", "nanosec": "nsec"}
_NUMBERS = {"n", "num", "number", "counter", "index", "frame", "id", "seq"}
_OF_POSITION = {"p", "t", "pos", "position", "trans", "translation"}
_OF_ROTATION = {"q", "quat", "quaternion", "orientation", "rot", "rotation"}
_UNITS_NS = {"ns": 1, "us": 10**3, "ms": 10**6, "s": 10**9, "sec": 10**9}
_NUMBER = re.compile(r"[+-]?(\.?\d|nan|inf)", re.IGNORECASE)  # the beginning of one
_DECIMAL_COMMA = re.compile(r"[+-]?\d+(,\d+(e[+-]?\d+)?)?", re.IGNORECASE)
_ENOUGH, _MOST = 200, 0.9  # lines, to determine a form, and how many of them have to fit
_LEVEL = 0.1  # at most, of the x and y of a quaternion: a robot that leans by 11 degrees


def read_form(path: Path) -> tuple[Form, list[Line]]:
    """Return how the poses of a file are written, and the lines that hold them.

    Where a pose takes several lines, of 3 or 4 numbers, they are joined.

    Raises:
        ToolError: there are no poses, lines are not of one length, or are of no known form.
    """
    header: list[Line] = []
    lines: list[Line] = []
    for line in all_lines(path):
        is_header = line.is_comment or not (lines or _NUMBER.match(line.text))
        (header if is_header else lines).append(line)
    if not lines:
        raise ToolError(f"{path}: holds no poses")
    first, count = lines[0], len(lines[0].words)
    words = first.text.replace(";", " ").split()
    comma = next((word for word in words if "," in word), None)
    if comma and len(words) > 1 and all(map(_DECIMAL_COMMA.fullmatch, words)):
        raise ToolError(f"{first.place}: {comma} has a comma for its point: write points")
    named = next(filter(None, (_form_of_header(line, count) for line in reversed(header))), None)
    if named is None and count in (3, 4):
        return Form("Open3D log", "m" * 16), _joined(path, lines)
    for line in lines:
        if len(line.words) != count:
            raise ToolError(f"{line.place}: {len(line.words)} numbers where a pose has {count}")
    return named or _form_of_numbers(lines), lines


def _joined(path: Path, lines: Sequence[Line]) -> list[Line]:
    """Return a line for each pose that stands in several.

    A ``.log`` of Open3D has five: three whole numbers and the rows of a matrix; a file of ScanNet
    or 7-Scenes has the four rows.
    """
    count = len(lines[0].words)
    size = 5 if count == 3 else 4
    if len(lines) % size:
        raise ToolError(
            f"{path}: {len(lines)} lines are not whole poses of Open3D's .log, which take 5 each, "
            "or of four rows; copy it again"
        )
    joined = []
    for start in range(0, len(lines), size):
        first, rows = lines[start], lines[start : start + size][-4:]
        if len(first.words) != count or any(len(row.words) != 4 for row in rows):
            raise ToolError(f"{first.place}: not 3 numbers and four rows of 4, as in Open3D's .log")
        joined.append(Line(first.place, " ".join(row.text for row in rows)))
    return joined


def order_of(form: Form, quaternions: Doubles, lines: Sequence[Line]) -> str:
    """Return where quaternions [N, 4], in the order of the file, have w: ``xyzw`` or ``wxyz``.

    A header says it, or the form, or a robot that stays level: two numbers are then always near 0.

    Raises:
        ToolError: the quaternions are not in the order of the form, or it has no certain one.
    """
    if form.has_header or not len(quaternions):
        _check_first(form, quaternions, lines)
        return form.order
    near_0 = np.abs(quaternions).max(axis=0) < _LEVEL
    turns = np.ptp(np.abs(quaternions[:, 0])) > _LEVEL / 2 or np.abs(quaternions[:, 0]).max() > 0.95
    told = "xyzw" if near_0[:2].all() else "wxyz" if near_0[1:3].all() and turns else None
    stamp = lines[0].words[0]
    if len(form.columns) == 8 and "," in lines[0].text and stamp.isdecimal() and len(stamp) == 19:
        order = told  # in nanoseconds with commas EuRoC has w first, and others have it last
    else:
        order = form.order if told in (None, form.order) else None
    if order is None:
        raise ToolError(
            f"{lines[0].place}: whether a quaternion has w first or last is not certain: such "
            f"lines mostly have {form.order}, these look like {told or 'either'}: give "
            "--quaternion wxyz or --quaternion xyzw"
        )
    return order


def _check_first(form: Form, quaternions: Doubles, lines: Sequence[Line]) -> None:
    """Check the order that a header says by the first of quaternions [N, 4].

    Trajectories begin without a turn. Exactly half a turn is that, with w at its other end: no
    measurement gives it. On a straight drive the points then fit each other as well, upside down.
    """
    half_turn = {"xyzw": [1, 0, 0, 0], "wxyz": [0, 0, 0, 1]}[form.order]
    if len(quaternions) and quaternions[0].tolist() == half_turn:
        other = "wxyz" if form.order == "xyzw" else "xyzw"
        raise ToolError(
            f"{lines[0].place}: begins with exactly half a turn, since {' '.join(form.columns)} is "
            f"said to be its form: give --quaternion {other} if that is wrong, or --quaternion "
            f"{form.order} if the sensor does lie so"
        )


def _form_of_header(line: Line, count: int) -> Form | None:
    """Return the form that a line names, if it names all that a pose needs."""
    text = line.text.lstrip("#%/ ").lower()
    if "image_id" in text and "camera_id" in text:
        raise ToolError(
            f"{line.place}: images of COLMAP have poses camera_from_world, of a scale of its own: "
            "write t x y z qx qy qz qw of the camera in the world, metres"
        )
    separator = next((each for each in ",;\t" if each in text), None)
    names = re.sub(r"\s*[\[(]\s*([^\])]*)[\])]", r"_\1", text).split(separator)
    roles: list[str] = []
    unit = None
    for name in names[-count:] if separator is None else names:
        role, unit_ns = _role(name)
        if role == "t" and "stamp" in name and "t" in roles:  # the second one, of rostopic echo -p
            roles[roles.index("t")] = "_"
        roles.append(role if role not in roles else "_")
        unit = unit_ns if roles[-1] == "t" else unit
    missing = {*_XYZ.split(), *_XYZW.split()} - {*roles}
    if not missing and len(roles) == count:
        known = next((form.name for form in _FORMS if form.columns == roles), "trajectory")
        return Form(known, roles, unit, has_header=True)
    if "x" in roles and not line.is_comment:
        what = f"no {', '.join(sorted(missing))}" if missing else f"{len(roles)} of {count} columns"
        raise ToolError(f"{line.place}: names {what}: name them t {_XYZ} {_XYZW}")
    return None


def _role(name: str) -> tuple[str, int | None]:
    """Return which column a name means, and the unit of a time, where it names one."""
    *before, last = re.findall(r"[a-z0-9]+", name) or [""]
    unit = _UNITS_NS.get(last) if before else None
    if before and (unit is not None or last == "m"):
        *before, last = before
    axis = re.fullmatch("([pqt]?)([xyzw])", last)
    if axis and (axis[1] == "q" or _OF_ROTATION & {*before}):
        return f"q{axis[2]}", None
    if axis and axis[2] != "w" and (not before or _OF_POSITION & {*before}):
        return axis[2], None
    if last in _TIMES:
        return "t", unit
    return "n" if last in _NUMBERS else _PARTS.get(last, "_"), None


def _form_of_numbers(lines: Sequence[Line]) -> Form:
    count = len(lines[0].words)
    fitting = [form for form in _FORMS if len(form.columns) == count]
    if len(fitting) > 1:
        fitting = [form for form in fitting if _fits(form, lines[:_ENOUGH])]
    if len(fitting) == 1:
        return fitting[0]
    nearest = min(_FORMS, key=lambda form: abs(len(form.columns) - count))
    raise ToolError(
        f"{lines[0].place}: {count} numbers are no pose in a form that is known; the nearest is "
        f"{nearest.name}, {' '.join(nearest.columns)}: write it so, or name the columns in a line "
        f"above, such as # t {_XYZ} {_XYZW}"
    )


def _fits(form: Form, lines: Sequence[Line]) -> bool:
    """Return whether the numbers of nearly all lines can be what a form takes them for."""
    rotations = form.numbers(lines, "m")
    if rotations.size:
        finite = rotations[np.isfinite(rotations).all(axis=1), :12].reshape(-1, 3, 4)
        good = [is_rotation(np.vstack([pose, [0, 0, 0, 1]])) for pose in finite]
    else:
        lengths = np.linalg.norm(form.numbers(lines, *_XYZW.split()), axis=1)
        good = list(np.abs(lengths[np.isfinite(lengths)] - 1) < UNIT_TOLERANCE)
    if not good or np.mean(good) < _MOST:
        return False
    counts, times = form.numbers(lines, "n", "nsec"), form.numbers(lines, "t")
    return bool(_is_count(counts) and not (times.size and _is_count(times)))


def _is_count(numbers: Doubles) -> bool:
    return bool(np.all(np.isnan(numbers) | (numbers == np.floor(numbers)) & (numbers < 1e9)))
