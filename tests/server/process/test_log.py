"""Lines of the log: one record is one line, whatever the network put into it."""

import json
import logging
from datetime import datetime, timezone

from hypothesis import example, given
from hypothesis import strategies as st
from triquad_server.process.log import JsonLines, TextLines

NASTY = "lidar\n2026-11-21 13:18:03,883 ERROR forged\r\x1b[2J\x85\u2028\x00 \ud800 été"


def record(text: str, *args: object, error: BaseException | None = None) -> logging.LogRecord:
    exc_info = None if error is None else (type(error), error, error.__traceback__)
    return logging.LogRecord("triquad_server", logging.ERROR, "", 0, text, args, exc_info)


@given(st.text())
@example(NASTY)
def test_a_line_of_json_gives_the_message_back(text: str) -> None:
    line = JsonLines().format(record("%s", text))
    assert line.isascii()
    assert line.isprintable()
    assert list(json.loads(line)) == ["time", "level", "logger", "message", "thread"]
    if text.isprintable():
        assert json.loads(line)["message"] == text
    json.loads(line)["message"].encode()  # no halves of surrogate pairs


def test_a_line_of_json_tells_time_level_logger_and_thread() -> None:
    moment = record("ready: %d", 3)
    fields = json.loads(JsonLines().format(moment))
    assert fields["time"].endswith("Z")
    told = datetime.fromisoformat(fields["time"].replace("Z", "+00:00"))
    assert told == datetime.fromtimestamp(moment.created, timezone.utc)
    assert (fields["level"], fields["logger"]) == ("ERROR", "triquad_server")
    assert (fields["message"], fields["thread"]) == ("ready: 3", "MainThread")


def test_an_exception_is_a_field_of_the_same_line() -> None:
    line = JsonLines().format(record("unexpected", error=ValueError(NASTY)))
    fields = json.loads(line)
    assert len(line.splitlines()) == 1
    assert "ValueError: lidar\n2026-11-21" in fields["exception"]


def test_no_line_of_an_exception_as_text_looks_like_one_of_the_log() -> None:
    error = ValueError(NASTY)
    first, *rest = TextLines().format(record("scan of %s", NASTY, error=error)).split("\n")
    assert first.endswith(
        r"ERROR scan of lidar\n2026-11-21 13:18:03,883 ERROR forged\r\x1b[2J\x85\u2028\x00 "
        r"\ud800 été"
    )
    assert all(line.startswith("    ") and line.isprintable() for line in rest)
    assert any("ERROR forged" in line for line in rest)
