"""Process that reads damaged files, with limits on memory and time: a bad reader ends only this process.

Paths and formats come as JSON lines on stdin, outcomes leave on stdout.
"""

from __future__ import annotations

import json
import os
import resource
import signal
import sys
import traceback
import warnings
from pathlib import Path

MOST_CPU_S = 10.0
MOST_BYTES = 10**9


def main() -> None:
    """Read files one after the other until there are no more."""
    from pipelines.session.registries import FORMATS
    from tests.fuzz.reading import read_or_refuse

    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # output of libraries must not be read as answers
    FORMATS.all()
    warm = json.loads(sys.stdin.readline())  # valid files load the libraries before memory is counted
    for path, stated in warm:
        read_or_refuse(Path(path), stated)
    most = _data_bytes() + MOST_BYTES
    resource.setrlimit(resource.RLIMIT_DATA, (most, most))
    warnings.simplefilter("error")  # a terminal would show them as lines of code
    for line in sys.stdin:
        path, stated = json.loads(line)
        signal.setitimer(signal.ITIMER_PROF, MOST_CPU_S)  # ends the process
        try:
            read, refused = read_or_refuse(Path(path), stated)
            answer: dict[str, object] = {"read": read, "refused": refused}
        except BaseException:
            answer = {"trouble": traceback.format_exc()}
        signal.setitimer(signal.ITIMER_PROF, 0)
        print(json.dumps(answer), file=answers, flush=True)


def _data_bytes() -> int:
    """Return the size of the process's own data: its heap and anonymous memory, touched or not."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmData:"):
            return int(line.split()[1]) * 1024
    raise OSError("the kernel does not tell VmData")


if __name__ == "__main__":
    main()
