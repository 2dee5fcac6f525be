"""Settings of the server: one record per section, with ranges and descriptions.

:mod:`triquad_server.settings.loading` reads them from a file, the environment and the command line.
"""

from triquad_server.settings.sections import (
    ANY_SOURCE,
    ChangeSettings,
    MemorySettings,
    MeshSettings,
    MetricsSettings,
    ScanSettings,
    ServiceSettings,
    SourceSettings,
    StoreSettings,
    TrainingSettings,
)
from triquad_server.settings.settings import Settings, UnfitSettingsError

__all__ = [
    "ANY_SOURCE",
    "ChangeSettings",
    "MemorySettings",
    "MeshSettings",
    "MetricsSettings",
    "ScanSettings",
    "ServiceSettings",
    "Settings",
    "SourceSettings",
    "StoreSettings",
    "TrainingSettings",
    "UnfitSettingsError",
]
