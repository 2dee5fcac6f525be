"""The errors of the tools. Each names the file, the place in it and the offending value."""


class ToolError(Exception):
    """Base of all errors of the tools."""


class ScanFolderError(ToolError):
    """A folder of scans that is missing, incomplete or contradicts itself."""


class ScanFileError(ToolError):
    """A scan file that does not hold whole points."""


class PoseError(ToolError):
    """A pose or calibration that is not 12 finite numbers of a rigid motion."""


class StampError(ToolError):
    """A time stamp that is not a number of seconds, or that runs backwards."""


class MeshFileError(ToolError):
    """A mesh file that cannot be read."""
