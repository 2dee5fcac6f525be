"""What the records of all sections of the settings have in common."""

from pydantic import ConfigDict

RECORD = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, use_attribute_docstrings=True)
# Neither text nor a truth value is a number.
SECTION = RECORD | ConfigDict(strict=True)
