"""Processor time that compiling the numerical functions takes, and the list `pipelines/data/kernels.json`.

python tools/kernels.py                       # compiles the list
python tools/kernels.py SESSION...            # simulates, reconstructs and replays with an empty cache
python tools/kernels.py SESSION... --write    # and makes the list from what was compiled

Functions of ingest and detection, which a session does not run again, keep their entries while they exist.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Mapping
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml  # type: ignore[import-untyped]

if TYPE_CHECKING:
    from pipelines.precompile import Signatures

LIST = Path(__file__).resolve().parents[1] / "pipelines" / "data" / "kernels.json"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sessions", nargs="*", type=Path, metavar="SESSION")
    parser.add_argument("--write", action="store_true", help="write the list")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as cache:
        os.environ["NUMBA_CACHE_DIR"] = cache  # before numba is imported
        from pipelines.geometry import compilation

        compilation.SHIPPED = Path(cache)  # before functions are made
        seconds, signatures = compiled_by(arguments.sessions) if arguments.sessions else (of_list(), {})
    for name, taken in sorted(seconds.items(), key=lambda item: -item[1]):
        print(f"{taken:6.2f} s  {name}")
    print(f"{sum(seconds.values()):6.2f} s  of processor time for {len(seconds)} functions")
    if arguments.write and arguments.sessions:
        slowest_first = {name: signatures[name] for name in sorted(signatures, key=lambda n: -seconds[n])}
        kept = not_reached(signatures)
        print(f"{len(kept)} listed functions were not called and stay: {', '.join(kept) or 'none'}")
        LIST.write_text(f"{json.dumps(slowest_first | kept, indent=0)}\n", encoding="utf-8")


def not_reached(signatures: Mapping[str, object]) -> Signatures:
    """Return the list's entries of functions that still exist and are not among those compiled."""
    from pipelines.precompile import listed

    def exists(name: str) -> bool:
        module, _, function = name.partition(":")
        return find_spec(module) is not None and hasattr(import_module(module), function)

    return {name: kinds for name, kinds in listed().items() if name not in signatures and exists(name)}


def of_list() -> dict[str, float]:
    """Compile the functions of the list one after the other; return seconds of processor time."""
    from pipelines.precompile import compile_function, listed

    everything = listed()
    for name in everything:
        import_module(name.partition(":")[0])
    seconds = {}
    for name, kinds in everything.items():
        began_s = time.process_time()
        compile_function(name, kinds)
        seconds[name] = time.process_time() - began_s
    return seconds


def compiled_by(sessions: list[Path]) -> tuple[dict[str, float], dict[str, list[list[object]]]]:
    """Simulate, reconstruct and replay; return seconds and types of the arguments of all that was compiled.

    The simulated flight is the first second of the sample flight, with and without pictures.
    """
    from numba.core import event

    from pipelines.precompile import entry_of
    from pipelines.reconstruct import reconstruct
    from pipelines.replan import replan
    from pipelines.simulate import example_scenario, simulate

    seconds: dict[str, float] = defaultdict(float)
    signatures: dict[str, list[list[object]]] = defaultdict(list)
    begun = threading.local()

    class Listener(event.Listener):  # type: ignore[misc]  # numba has no types
        def on_start(self, event: Any) -> None:  # noqa: ARG002  # numba calls it so
            begun.stack = [*getattr(begun, "stack", []), time.thread_time()]

        def on_end(self, event: Any) -> None:
            start = begun.stack.pop()
            if not begun.stack:  # helpers are compiled within the function that calls them
                function = event.data["dispatcher"].py_func
                name = f"{function.__module__}:{function.__qualname__}"
                seconds[name] += time.thread_time() - start
                signatures[name].append([entry_of(kind) for kind in event.data["args"]])

    event.register("numba:compile", Listener())
    with tempfile.TemporaryDirectory() as folder:
        scenario = yaml.safe_load(example_scenario("mound_walk").read_text(encoding="utf-8"))
        short = Path(folder) / "scenario.yaml"
        short.write_text(yaml.safe_dump(scenario | {"duration_s": 1}), encoding="utf-8")
        for video in (False, True):
            simulate(short, Path(folder) / f"{video}", video=video)
    for session in sessions:
        reconstruct(session, force=True)
        replan(session, force=True)
    return seconds, signatures


if __name__ == "__main__":
    main()
