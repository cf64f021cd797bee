"""Long run of the kill tests: `python -m tests.kills`; `--power` loses power."""

import argparse
import sys
import tempfile
from pathlib import Path

from tests.kills.killing import commands_on, soak
from tests.kills.power import print_replays


def main() -> int:
    """Kill all commands; return 1 if any result differs from that of an undisturbed run."""
    parser = argparse.ArgumentParser(prog="python -m tests.kills", description=__doc__)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="*", help="commands, with those before them")
    parser.add_argument("--power", action="store_true", help="replay losses of power instead")
    parser.add_argument("--moments", type=int, default=100, help="of each command, with --power")
    stated = parser.parse_args()
    if stated.power:
        return print_replays(stated.only or (), moments=stated.moments, seed=stated.seed)
    found = []
    with tempfile.TemporaryDirectory() as folder:
        commands = commands_on(Path(folder))
        chosen = {name: commands[name] for name in stated.only or commands}
        for kill in soak(chosen, stated.kills, seed=stated.seed):
            found.append(kill)
            if kill.trouble:
                print(f"--- {kill}", flush=True)  # noqa: T201
    for name in chosen:
        of_it = [kill for kill in found if kill.command == name]
        if of_it:
            hit = [kill for kill in of_it if kill.hit]
            print(  # noqa: T201
                f"{name}: {len(hit)} kills after {min(kill.after_s for kill in of_it):.1f} to"
                f" {max(kill.after_s for kill in of_it):.1f} s of {of_it[0].length_s:.1f} s,"
                f" {sum(kill.over_finished for kill in hit)} of them over a finished run"
            )
    troubles = sum(bool(kill.trouble) for kill in found)
    print(f"{sum(kill.hit for kill in found)} kills, {troubles} made trouble")  # noqa: T201
    return 1 if troubles else 0


if __name__ == "__main__":
    sys.exit(main())
