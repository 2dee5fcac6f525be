"""Sets how many files and links this process may have open."""

import contextlib
import resource


def allow_open_files() -> None:
    """Allow as many open files as the system permits.

    Of the usual 1024, links that are opened and send nothing would leave none for checkpoints.
    """
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    with contextlib.suppress(ValueError, OSError):  # no more than there were
        resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))
