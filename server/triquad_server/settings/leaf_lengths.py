"""Lengths in leaves: a setting that is not given follows the side of the field's leaves."""

from typing import Any, TypeVar

from pydantic import BaseModel, Field
from pydantic.config import JsonDict
from triquad_format.records.field_settings import FieldSettings

DEFAULT_LEAF_M = FieldSettings().leaf_m
"""The defaults of lengths are those at this leaf."""

IN_LEAVES = "in_leaves"
"""In the JSON schema of a setting: how many leaves long its default is."""

_DIGITS = 9  # of a length: the default times a ratio has noise behind them

SectionT = TypeVar("SectionT", bound=BaseModel)


def length(default_m: float, least_m: float, most_m: float) -> Any:
    """A length that follows ``field.leaf_m`` unless it is given.

    The range has to hold what follows from any leaf.
    """
    leaves: JsonDict = {IN_LEAVES: _rounded(default_m / DEFAULT_LEAF_M)}
    return Field(default=default_m, ge=least_m, le=most_m, json_schema_extra=leaves)


def at_leaf(section: SectionT, leaf_m: float) -> SectionT:
    """The section with each length that was not given in proportion to the leaf."""
    lengths = {
        name: _rounded(setting.default * (leaf_m / DEFAULT_LEAF_M))
        for name, setting in type(section).model_fields.items()
        if follows_leaf(section, name)
    }
    # A copy would count them as given, and they could not follow another leaf.
    return type(section).model_construct(section.model_fields_set, **dict(section) | lengths)


def follows_leaf(section: BaseModel, name: str) -> bool:
    """Whether a setting of a section follows the leaf: a length that was not given."""
    extra = type(section).model_fields[name].json_schema_extra
    return isinstance(extra, dict) and IN_LEAVES in extra and name not in section.model_fields_set


def _rounded(value: float) -> float:
    return float(f"{value:.{_DIGITS}g}")
