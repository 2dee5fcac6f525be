"""A map file read in full, with the other files of its folder that it needs."""

from contextlib import closing
from pathlib import Path

from triquad_format.errors import NoIndexError
from triquad_format.mapfile.file_errors import named
from triquad_format.mapfile.index import MapIndex, file_in
from triquad_format.mapfile.mcap.random_access import FileBytes
from triquad_format.mapfile.reader import MapFile, read_map_file

from triquad_tools.console.errors import ToolError


class MissingFilesError(ToolError):
    """A map file whose parts lie in files that are not there."""


def read_whole(path: Path) -> MapFile:
    """The map in a file, checked.

    Raises:
        MissingFilesError: it needs other files that are not in its folder; the text names them.
        ToolError: it is a folder.
        MapFileError: it is not a map file, is damaged, or needs a newer reader.
        OSError: it cannot be read.
    """
    if path.is_dir():
        raise ToolError(f"{path} is a folder: --log lists the checkpoints in it")
    missing = [name for name in _needed_files(path) if not file_in(path.parent, name).exists()]
    if missing:
        raise MissingFilesError(
            f"{path} needs {', '.join(missing)}: not in its folder, copy what is missing there"
        )
    return read_map_file(path)


def _needed_files(path: Path) -> list[str]:
    with closing(FileBytes(path)) as source, named(str(path)):
        try:
            return [file.name for file in MapIndex(source).manifest.files]
        except NoIndexError:
            return []
