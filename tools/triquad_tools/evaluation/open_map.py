"""Opens a map for queries, from a file or a server."""

import triquad_client
from triquad_client import Client, OfflineMap

from triquad_tools.mapfiles.source import Access, is_endpoint


def newest_epoch(opened: Client | OfflineMap) -> int:
    """Return the number of the epoch that a map answers from.

    Raises:
        TriquadError: the server does not answer.
    """
    return opened.epoch if isinstance(opened, OfflineMap) else opened.status().epoch


def open_map(target: str, access: Access) -> Client | OfflineMap:
    """Return the map in the file ``target``, or that of the server at the endpoint ``target``.

    Raises:
        TriquadError: no server there has the map.
        FormatError: the file cannot be read as a map.
        OSError: it cannot be read at all.
    """
    if is_endpoint(target):
        return triquad_client.connect(target, access.map_name, config=access.config)
    return triquad_client.open_map(target)
