"""All settings of the server: one record, of a record per section."""

from typing import Any

from pydantic import BaseModel, ValidationError, model_validator
from triquad_format.errors import FormatError, SettingsError
from triquad_format.records.field_settings import FieldSettings
from triquad_format.wire.keys import check_name

from triquad_server.settings.sections import (
    DEFAULT_LEAF_M,
    RECORD,
    ChangeSettings,
    MemorySettings,
    MeshSettings,
    MetricsSettings,
    ScanSettings,
    ServiceSettings,
    SourceSettings,
    StoreSettings,
    TrainingSettings,
    at_leaf,
    check_robot_box,
    follows_leaf,
)

SOURCE_SECTION = "sources.NAME"

Key = tuple[str, ...]
"""A setting: its section, for a source its name, and its key."""

_RANGES = ("range_min_m", "range_max_m")


class UnfitSettingsError(ValueError):
    """Settings that do not go together."""

    def __init__(self, text: str, keys: tuple[Key, ...]) -> None:
        super().__init__(text)
        self.keys = keys  # that decide


class Settings(BaseModel):
    """All settings; each part of the server receives its own section.

    Lengths that are not given are in proportion to ``field.leaf_m``.
    """

    model_config = RECORD

    field: FieldSettings = FieldSettings()
    scan: ScanSettings = ScanSettings()
    change: ChangeSettings = ChangeSettings()
    training: TrainingSettings = TrainingSettings()
    mesh: MeshSettings = MeshSettings()
    store: StoreSettings = StoreSettings()
    service: ServiceSettings = ServiceSettings()
    memory: MemorySettings = MemorySettings()
    metrics: MetricsSettings = MetricsSettings()
    sources: dict[str, SourceSettings] = {}

    @model_validator(mode="after")
    def _lengths_follow_the_leaf(self) -> "Settings":
        # Not yet in anyone's hands, so this is no change of what is frozen.
        for name in ("scan", "mesh"):
            self.__dict__[name] = at_leaf(self.__dict__[name], self.field.leaf_m)
        return self

    @model_validator(mode="after")
    def _sections_fit(self) -> "Settings":
        self._check_ranges(*(("scan", key) for key in _RANGES))
        cell, reach = ("mesh", "cell_m"), ("mesh", "reach_m")
        most_m = 4 * self.field.leaf_m
        if self._value(cell) + self._value(reach) > most_m:
            raise UnfitSettingsError(
                f"{self._said(cell)} and {self._said(reach)} are too coarse for field.leaf_m = "
                f"{self.field.leaf_m:g}: together, use at most {most_m:g}",
                keys=(cell, reach),
            )
        return self

    @model_validator(mode="after")
    def _sources_fit(self) -> "Settings":
        for name, source in self.sources.items():
            try:
                check_name("source", name)
            except FormatError as error:
                raise ValueError(f"sources: {error}") from error
            self._check_ranges(
                *(
                    ("scan", key) if getattr(source, key) is None else ("sources", name, key)
                    for key in _RANGES
                )
            )
            if (box := source.robot_box_m) is not None:
                check_robot_box(f"sources.{name}.robot_box_m", box, self.field.leaf_m)
        return self

    def scan_of(self, source: SourceSettings) -> ScanSettings:
        """The section ``[scan]`` with the ranges of a source."""
        ranges = source.model_dump(include=set(_RANGES), exclude_none=True)
        return self.scan.model_copy(update=ranges)

    def with_field(self, field: FieldSettings) -> "Settings":
        """The same for another field, whose leaf the lengths follow that are not given.

        Raises:
            SettingsError: those that are given do not go with it.
        """
        try:
            return Settings(**dict(self) | {"field": field})
        except ValidationError as error:
            texts = [str(details["ctx"]["error"]) for details in error.errors()]
            raise SettingsError("; ".join(texts)) from error

    def _check_ranges(self, nearest: Key, farthest: Key) -> None:
        low_m, high_m, thin = self._value(nearest), self._value(farthest), ("scan", "thin_m")
        if high_m < low_m:
            raise UnfitSettingsError(
                f"{self._said(farthest)} is less than {self._said(nearest)}: use at least that",
                keys=(nearest, farthest),
            )
        most_m = 8 * self.field.region_pitch_m
        if high_m > most_m:
            raise UnfitSettingsError(
                f"{self._said(farthest)} reaches over too many regions of field.leaf_m = "
                f"{self.field.leaf_m:g} and field.depth = {self.field.depth}: use at most "
                f"{most_m:g}, or larger regions",
                keys=(farthest,),
            )
        if self._value(thin) * 1e6 < high_m:
            raise UnfitSettingsError(
                f"{self._said(thin)} is too fine for {self._said(farthest)}: use at least "
                f"{high_m * 1e-6:g}",
                keys=(thin, farthest),
            )

    def _value(self, key: Key) -> float:
        return float(getattr(self._table(key), key[-1]))

    def _said(self, key: Key) -> str:
        """A setting with its value, and where that comes from if nobody gave it."""
        follows = follows_leaf(self._table(key), key[-1]) and self.field.leaf_m != DEFAULT_LEAF_M
        why = f" (which follows field.leaf_m = {self.field.leaf_m:g})" if follows else ""
        return f"{'.'.join(key)} = {self._value(key):g}{why}"

    def _table(self, key: Key) -> BaseModel:
        table: BaseModel = getattr(self, key[0]) if len(key) == 2 else self.sources[key[1]]
        return table


def setting_schemas() -> dict[str, dict[str, Any]]:
    """The JSON schema of each setting: by section, then by key.

    The sections of all sources are one, ``sources.NAME``.
    """
    schema = Settings.model_json_schema()
    references = {**schema["properties"]}
    references[SOURCE_SECTION] = references.pop("sources")["additionalProperties"]
    return {
        section: schema["$defs"][reference["$ref"].rpartition("/")[2]]["properties"]
        for section, reference in references.items()
    }
