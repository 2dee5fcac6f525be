"""The processes that do tasks: those of a cluster of Dask, or some of this machine."""

import logging
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import triquad_format
from distributed import Client, LocalCluster, WorkerPlugin

from triquad_tools.console.command import ToolError

_CONNECT_S = 10
_THREADS = "TRIQUAD_THREADS"  # which triquad_map.compiled.team reads: not to be imported before


class _OneThread(WorkerPlugin):
    """Has each worker compute in one thread, also one that is started later.

    Two that have a thread for each core each took twice as long as one.
    """

    name = "triquad-one-thread"

    def setup(self, worker: object) -> None:  # noqa: ARG002 - as the library calls it
        """Set what is read once the map's code is imported, for the first task."""
        os.environ[_THREADS] = "1"


@contextmanager
def opened(cluster: str | None, workers: int | None) -> Iterator[Client]:
    """Yield a client of a cluster's scheduler, or of that many workers of this machine.

    Each worker computes in one thread.

    Raises:
        ToolError: there is no scheduler, or it has no workers.
    """
    if cluster is None:
        # Dask would end workers that take more than their part of the memory: a map keeps to its
        # own limit. Without certificates any user of the machine could run programs as this one.
        with (
            LocalCluster(  # type: ignore[no-untyped-call]
                n_workers=workers,
                threads_per_worker=1,
                dashboard_address="127.0.0.1:0",
                memory_limit=0,
                security=True,
                silence_logs=logging.ERROR,
            ) as local,
            Client(local) as client,  # type: ignore[no-untyped-call]
        ):
            client.register_plugin(_OneThread())
            yield client
        return
    try:
        client = Client(cluster, timeout=_CONNECT_S)  # type: ignore[no-untyped-call]
    except (OSError, ValueError) as error:
        raise ToolError(
            f"no scheduler of Dask answers at {cluster}: start 'dask scheduler' there, and 'dask "
            f"worker {cluster} --nthreads 1' on each machine ({error})"
        ) from error
    with client:
        if not client.scheduler_info()["workers"]:
            raise ToolError(
                f"the scheduler at {cluster} has no workers: start 'dask worker {cluster} "
                "--nthreads 1' on each machine"
            )
        client.register_plugin(_OneThread())
        yield client


def check_workers(client: Client, paths: Sequence[Path]) -> None:
    """See that all workers have the same release, and find files and folders.

    Raises:
        ToolError: one does not.
    """
    try:
        found = client.run(_told, paths)
    except ModuleNotFoundError as error:
        raise ToolError(f"a worker lacks {error.name}: install triquad[tools,cluster]") from error
    for worker, (release, missing) in found.items():
        if release != triquad_format.__version__:
            raise ToolError(
                f"worker {worker} has release {release}, and this is {triquad_format.__version__}"
            )
        if missing:
            raise ToolError(
                f"worker {worker} does not find {missing[0]}: OUT and the recordings have to be in "
                "folders that all workers have at the same place"
            )


def _told(paths: Sequence[Path]) -> tuple[str, list[Path]]:
    return triquad_format.__version__, [path for path in paths if not path.exists()]
