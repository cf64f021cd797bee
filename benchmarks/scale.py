"""Long flights: memory, time and page of each command: `python -m benchmarks.scale [--minutes 2 10]`.

Everything is simulated, with modelled keypoints and no film. Each command has a process of its own.
"""

import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml  # type: ignore[import-untyped]

from benchmarks.flights import SAMPLE
from benchmarks.results import fixed, markdown_table, parser_of, show
from pipelines.ingest import ingest
from pipelines.simulate import simulate

_NOISE = {
    "white": {"position_m": 0.02, "rotation_deg": 0.2},
    "bias": {"position_m": 0.05, "rotation_deg": 0.3},
}
COMMANDS = (
    ("reconstruct", "--workers", "1"),
    ("check",),
    ("replan-compare", "--arms", "adaptive,fixed,flown"),
    ("report",),
    ("export", "--to", "trc,csv,tum", "--overwrite"),
)
# A browser opens pages of this size at once, and a laptop beside other programs has this memory.
MAX_PAGE_MB, MAX_REPORT_MB = 25.0, 700.0
# A process of its own: a child's peak memory begins with that of the process that starts it.
_MEASURED = """
import json, resource, subprocess, sys
code = subprocess.run(sys.argv[1:], stdout=subprocess.DEVNULL).returncode
used = resource.getrusage(resource.RUSAGE_CHILDREN)
print(json.dumps([code, used.ru_maxrss, used.ru_utime + used.ru_stime]))
"""


def flown(seconds: float, place: Path) -> Path:
    """Fly the sample's scenario with a longer walk; return flight.yaml."""
    document: Any = yaml.safe_load((SAMPLE / "scenario.yaml").read_text(encoding="utf-8"))
    walk = {"walk": {"distance_m": 16, "turn_deg": -75, "speed_mps": 1.3}}
    document["actor"]["motion"] = [walk] * (int(seconds / 12) + 1)
    document["drones"]["count"] = 2
    document["drones"]["pose_noise"] = _NOISE
    place.mkdir(parents=True, exist_ok=True)
    document |= {"seed": 300, "duration_s": seconds}
    (place / "scenario.yaml").write_text(yaml.safe_dump(document), encoding="utf-8")
    simulate(place / "scenario.yaml", place / "made", video=False)
    return place / "made" / "flight.yaml"


def commands(minutes: float) -> Iterator[list[str]]:
    """Run the commands of a session of so many minutes; yield command, peak MB, processor s, page MB."""
    with tempfile.TemporaryDirectory(prefix="scale-") as folder:
        session = ingest(flown(60 * minutes, Path(folder)), Path(folder) / "long.session").folder
        for command, *options in COMMANDS:
            peak_mb, took_s = cost_of(command, str(session), *options)
            row = [f"{minutes:g}", command, fixed(peak_mb), fixed(took_s), ""]
            if command == "report":
                page_mb = (session / "report" / "index.html").stat().st_size / 1e6
                row[-1] = fixed(page_mb, 1)
                if peak_mb > MAX_REPORT_MB or page_mb > MAX_PAGE_MB:
                    raise SystemExit(f"a page of {page_mb:.1f} MB took {peak_mb:.0f} MB of memory")
            yield row


def cost_of(command: str, *options: str) -> tuple[float, float]:
    """Run a command of `mocap`; return its peak memory (MB) and processor time (s)."""
    mocap = str(Path(sys.executable).with_name("mocap"))
    asked = [sys.executable, "-c", _MEASURED, mocap, command, *options]
    done = subprocess.run(asked, stdout=subprocess.PIPE, check=True)  # noqa: S603
    code, peak_kib, took_s = json.loads(done.stdout)
    if code:
        raise SystemExit(f"mocap {command} ended with {code}")
    return peak_kib * 1024 / 1e6, took_s


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("--minutes", type=float, nargs="+", default=[2.0, 10.0])
    options = parser.parse_args()
    header = ["minutes", "command", "peak MB", "CPU s", "page MB"]
    rows = [row for minutes in options.minutes for row in commands(minutes)]
    show("scale", markdown_table(header, rows), write=options.write)


if __name__ == "__main__":
    main()
