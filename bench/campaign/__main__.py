"""The campaign from the command line: all of it, or one turn of one part.

``python -m bench.campaign`` goes on with the campaign in ``campaign-out/``, or begins one; with
``--part``, as often as wanted, it runs these parts alone;
``python -m bench.campaign --part kills --seed 17`` repeats one turn.
"""

import argparse
import faulthandler
import shutil
import sys
import time
import traceback
from collections.abc import Sequence
from pathlib import Path

from bench.campaign.all_parts import BY_NAME, PARTS
from bench.campaign.campaign import Campaign
from bench.campaign.record import TurnResult
from bench.campaign.turn import BrokenError, Part, Turn

_TRACEBACK = 2000  # characters of it that are kept


def main(argv: Sequence[str] | None = None) -> int:
    """Run what the arguments say: 0 where nothing broke, 1 where something did."""
    options = _parser().parse_args(argv)
    if options.seed is not None and len(options.part) != 1:
        _parser().error("--seed is of one turn: name its --part")
    if options.seed is not None:
        return _one_turn(options)
    parts = [BY_NAME[name] for name in options.part] or PARTS
    campaign = Campaign(options.out, parts)
    try:
        campaign.run(60.0 * options.minutes)
    except KeyboardInterrupt:
        print("stopped; the same command goes on from here", file=sys.stderr)
    finally:
        print(campaign.table())
    return 1 if campaign.broken else 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m bench.campaign", description=__doc__)
    add = parser.add_argument
    add("--part", choices=sorted(BY_NAME), action="append", default=[], help="this one alone")
    add("--seed", type=int, help="repeat the turn of --part with this seed, and nothing else")
    add("--minutes", type=float, default=5.0, help="how long (default: 5)")
    add("--out", type=Path, default=Path("campaign-out"), help="default: campaign-out")
    add("--most", type=int, help="of --seed: things to do, at most")
    return parser


def _one_turn(options: argparse.Namespace) -> int:
    """Run a turn in this process, and write what it did to the campaign's folder."""
    part = BY_NAME[options.part[0]]
    folder = options.out / f"{part.name}-{options.seed}"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    faulthandler.dump_traceback_later(0.9 * 60 * options.minutes + 60)
    turn = Turn(options.seed, folder, options.most or part.per_turn, seconds=60.0 * options.minutes)
    seconds = _run(part, turn)
    result = TurnResult(turn.seed, dict(turn.counts), turn.most_seen, turn.broken, seconds)
    result.write(folder.with_name(f"{folder.name}.json"))
    print(result)
    faulthandler.cancel_dump_traceback_later()
    return 1 if turn.broken else 0


def _run(part: Part, turn: Turn) -> float:
    """Run the turn, and return its seconds. Any exception broke a promise."""
    started = time.monotonic()
    try:
        part.run(turn)
    except BrokenError as error:
        turn.broke(str(error))
    except Exception:
        turn.broke(traceback.format_exc()[-_TRACEBACK:])
    return time.monotonic() - started


if __name__ == "__main__":
    sys.exit(main())
