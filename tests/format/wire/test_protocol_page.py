"""docs/wire-protocol.md is complete: it names every message, field, operation and error code."""

import dataclasses
import re
from pathlib import Path

import pytest
from support.operations import OPERATIONS
from triquad_format.errors import ERROR_CODES
from triquad_format.wire import (
    mesh_messages,
    messages,
    metrics_messages,
    query_messages,
    source_messages,
    status_messages,
)
from triquad_format.wire.codec import Message

PAGE = (Path(__file__).parents[3] / "docs" / "wire-protocol.md").read_text(encoding="utf-8")
PASSAGES = re.split(r"^(?:#{2,3} |(?=`[A-Z]\w+`))", PAGE, flags=re.MULTILINE)
"""From each heading, and from each line that begins with the name of a message."""


MODULES = (
    *(mesh_messages, messages, metrics_messages),
    *(query_messages, source_messages, status_messages),
)


def all_messages():
    kinds = {
        kind
        for module in MODULES
        for kind in vars(module).values()
        if isinstance(kind, type) and issubclass(kind, Message) and not kind.__subclasses__()
    }
    return sorted(kinds, key=lambda kind: kind.__name__)


@pytest.mark.parametrize("kind", all_messages(), ids=lambda kind: kind.__name__)
def test_every_field_stands_where_its_message_is_described(kind):
    named = f"`{kind.__name__}`"
    passages = [text[text.index(named) :] for text in PASSAGES if named in text]
    assert passages, f"{named} is described nowhere"
    missing = [
        field.name
        for field in dataclasses.fields(kind)
        if not any(f"`{field.name}`" in text for text in passages)
    ]
    assert not missing, f"{named} lacks {missing}"


@pytest.mark.parametrize("operation", OPERATIONS)
def test_every_operation_has_its_key_and_messages(operation):
    row = re.search(rf"^\| `triquad/<map>/{operation}` \| query \| `\w+` → `\w+` \|$", PAGE, re.M)
    assert row, f"no row for {operation}"


def test_every_error_code_is_explained():
    section = PAGE[PAGE.index("## 6. Errors") : PAGE.index("## 7.")]
    assert set(re.findall(r"^\| `(\w+)` \|", section, re.M)) == set(ERROR_CODES)
