"""Settings of the server: one record per section, with ranges and descriptions.

:mod:`triquad_server.settings.loading` reads them from a file, the environment and the command line.
"""

from triquad_server.settings.change import ChangeSettings
from triquad_server.settings.memory import MemorySettings
from triquad_server.settings.mesh import MeshSettings
from triquad_server.settings.metrics import MetricsSettings
from triquad_server.settings.scan import ScanSettings
from triquad_server.settings.service import ServiceSettings
from triquad_server.settings.settings import Settings, UnfitSettingsError
from triquad_server.settings.source import ANY_SOURCE, SourceSettings
from triquad_server.settings.store import StoreSettings
from triquad_server.settings.training import TrainingSettings

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
