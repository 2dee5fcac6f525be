"""``triquad-server``: the command line of the map server."""

import argparse
import logging
import os
import queue
import signal
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import triquad_format
from triquad_format.errors import FormatError
from triquad_format.wire.endpoints import DEFAULT_ENDPOINT, full_endpoint

from triquad_server.errors import (
    LastCheckpointError,
    ListenError,
    ServerError,
    StoreError,
)
from triquad_server.process.installed import DEVICES, require_libraries
from triquad_server.process.log import LOG_FORMATS, TEXT, start_log

_PROGRAM = "triquad-server"
_LOG_FORMAT_VARIABLE = "TRIQUAD_LOG_FORMAT"

OK, UNEXPECTED, USAGE, CANNOT_LISTEN, STORE, LAST_CHECKPOINT = 0, 1, 2, 3, 4, 5
_CODES = {ListenError: CANNOT_LISTEN, LastCheckpointError: LAST_CHECKPOINT, StoreError: STORE}

_EPILOG = """\
exit codes:
  0  stopped by SIGINT or SIGTERM; the map is in the store, if there is one
  1  an unexpected error; the log has the details
  2  wrong usage or settings, or a missing extra (install triquad[server])
  3  cannot listen on an endpoint or on the port for metrics (in use), or cannot connect to one
  4  the store cannot be used: not readable or writable, in use, all checkpoints are damaged,
     or the newest needs a newer release or more memory; or there is none of --restore
  5  the last checkpoint could not be written, such as on a full disk: what was mapped since the
     one before is lost; the log says which that is
"""

_log = logging.getLogger("triquad_server")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the server until SIGINT or SIGTERM, and return the exit code."""
    _on_signals(_leave)
    parser = _parser()
    if "_ARGCOMPLETE" in os.environ:  # the shell asks what could come next
        import argcomplete

        argcomplete.autocomplete(parser)
    options = parser.parse_args(argv)
    start_log(options.log_format)
    logging.getLogger().setLevel(options.log_level.upper())
    return _exit_code(options)


def _on_signals(handler: Callable[..., None]) -> None:
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, handler)


def _leave(*_: object) -> None:
    """Stop before anything is open: an exception could get lost during an import."""
    _log.info("stopped")
    os._exit(OK)


def _exit_code(options: argparse.Namespace) -> int:
    """Do what the options say; every error becomes a line in the log and an exit code."""
    try:
        return _run(options)
    except (ServerError, FormatError) as error:
        _log.error("%s", error)
        return next((code for kind, code in _CODES.items() if isinstance(error, kind)), USAGE)
    except Exception:
        _log.exception("unexpected")
        return UNEXPECTED


def _run(options: argparse.Namespace) -> int:
    require_libraries()
    from triquad_format.wire.keys import DEFAULT_MAP

    from triquad_server.launch_options import LaunchOptions
    from triquad_server.network import NetworkOptions
    from triquad_server.process.stop import Stop, Stops
    from triquad_server.settings.loading import load_settings, settings_toml

    port = options.metrics_port
    assignments = [*options.set, *([] if port is None else [f"metrics.port={port}"])]
    settings = load_settings(options.settings, assignments, preset=options.preset)
    if options.print_settings:
        sys.stdout.write(settings_toml(settings))
        return OK
    network = NetworkOptions(
        listen=tuple(map(full_endpoint, options.listen)),
        connect=tuple(map(full_endpoint, options.connect)),
        mode=options.mode,
        config_file=options.config,
        multicast_scouting=options.multicast_scouting,
    )
    launch = LaunchOptions(
        map_names=tuple(options.map) or (DEFAULT_MAP,),
        network=network,
        settings=settings,
        store=options.store,
        device=options.device,
        restore=options.restore,
        share=options.share,
    )
    # Only now, since it takes seconds to import.
    from triquad_server.launch import run_server

    stops: Stops = queue.SimpleQueue()
    _on_signals(lambda *_: stops.put(Stop.ASKED))
    why = run_server(launch, stops)
    return OK if why is Stop.ASKED else UNEXPECTED


def _log_format(name: str) -> str:
    if name not in LOG_FORMATS:
        formats = " or ".join(LOG_FORMATS)
        raise argparse.ArgumentTypeError(
            f"{name!r}, given here or in {_LOG_FORMAT_VARIABLE}, is no format: use {formats}"
        )
    return name


def _epoch(text: str) -> int:
    if not (text.isascii() and text.isdigit() and len(text) < 20):
        raise argparse.ArgumentTypeError(
            f"{text!r:.80} is not the number of an epoch: triquad-inspect STORE --log lists them"
        )
    return int(text)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=_PROGRAM,
        description="A long-running map server: learns a signed-distance field from scans that "
        "arrive over Zenoh, and answers queries.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add(
        "--map",
        action="append",
        default=[],
        metavar="NAME",
        help="name of a map, repeatable (default: default)",
    )
    add(
        "--store",
        type=Path,
        metavar="DIR",
        help="folder for checkpoints, in a folder per map; without it the map is not kept",
    )
    add(
        "--restore",
        type=_epoch,
        metavar="EPOCH",
        help="take the map back to an older checkpoint of the store, such as the one that is kept "
        "before a reset (triquad-inspect STORE --log lists them); what it was stays on disk",
    )
    add(
        "--share",
        action="store_true",
        help="share the map with other servers, which are started likewise and reach each other by "
        "--connect and the same --store: each has some of its regions (docs/scale.md)",
    )
    add("--device", choices=DEVICES, default="cpu", help="what it trains on (default: cpu)")
    _add_settings(parser.add_argument_group("settings (docs/settings.md)"))
    _add_network(parser.add_argument_group("network"))
    add(
        "--log-format",
        type=_log_format,
        default=os.environ.get(_LOG_FORMAT_VARIABLE) or TEXT,
        metavar="FORMAT",
        help="text, or json: an object per line, for what collects logs (default: "
        f"{_LOG_FORMAT_VARIABLE} of the environment, or text)",
    )
    add(
        "--log-level",
        choices=("debug", "info", "warning", "error"),
        default="info",
        help="default: info",
    )
    add("--version", action="version", version=f"triquad {triquad_format.__version__}")
    return parser


def _add_settings(group: argparse._ArgumentGroup) -> None:
    add = group.add_argument
    add(
        "--preset",
        metavar="NAME",
        help="settings that fit a kind of place and sensor, below all others: street (as without "
        "any), indoor, tabletop or long-range",
    )
    add("--settings", type=Path, metavar="FILE", help="settings of the server, TOML")
    add(
        "--set",
        action="append",
        default=[],
        metavar="SECTION.KEY=VALUE",
        help="one setting, such as training.batch=4096, repeatable; goes before the environment "
        "(TRIQUAD_TRAINING__BATCH=4096), and that before the file",
    )
    add("--print-settings", action="store_true", help="print the settings in effect, and exit")


def _add_network(group: argparse._ArgumentGroup) -> None:
    add = group.add_argument
    add(
        "-l",
        "--listen",
        action="append",
        default=[],
        metavar="ENDPOINT",
        help="HOST:PORT or an endpoint of Zenoh, such as tcp/0.0.0.0:7447, repeatable "
        f"(default: {DEFAULT_ENDPOINT})",
    )
    add(
        "-e",
        "--connect",
        action="append",
        default=[],
        metavar="ENDPOINT",
        help="another Zenoh router to connect to, repeatable",
    )
    add("-m", "--mode", choices=("router", "peer", "client"), help="default: router")
    add(
        "-c",
        "--config",
        type=Path,
        metavar="FILE",
        help="Zenoh configuration, JSON5; what it leaves out is as without it: docs/server.md",
    )
    add(
        "--metrics-port",
        metavar="PORT",
        help="answer /metrics (Prometheus) and /healthz there, on this machine alone unless "
        "metrics.address says otherwise: docs/metrics.md",
    )
    add(
        "--multicast-scouting",
        action=argparse.BooleanOptionalAction,
        default=None,
        help="look for others by multicast, and be found (default: no)",
    )


if __name__ == "__main__":
    sys.exit(main())
