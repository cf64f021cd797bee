"""Long flights: errors, memory and time of the commands.

    python -m benchmarks.scale [--minutes 2 10]        # memory, time and page of each command
    python -m benchmarks.scale --accuracy [--count 8]  # `auto` beside `robust` on flights of 90 s

Everything is simulated, with modelled keypoints and no film. Each command of --minutes has a process of its
own.
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
from pipelines.reconstruct import ReconstructSettings, reconstruct
from pipelines.simulate import simulate

_CONSTANT = {
    "white": {"position_m": 0.02, "rotation_deg": 0.2},
    "bias": {"position_m": 0.05, "rotation_deg": 0.3},
}
_DRIFTING = {
    "white": {"position_m": 0.02, "rotation_deg": 0.2},
    "gauss-markov": {"position_m": 0.1, "rotation_deg": 0.4, "correlation_s": 20},
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


def flown(seed: int, seconds: float, place: Path) -> Path:
    """Fly the sample's scenario with a longer walk, and two or three drones; return flight.yaml."""
    document: Any = yaml.safe_load((SAMPLE / "scenario.yaml").read_text(encoding="utf-8"))
    turn = (-75, 60, 80, 45)[seed % 4]
    walk = {"walk": {"distance_m": 16, "turn_deg": turn, "speed_mps": 1.3}}
    document["actor"]["motion"] = [walk] * (int(seconds / 12) + 1)
    document["drones"]["count"] = 2 + seed // 2 % 2
    document["drones"]["pose_noise"] = _DRIFTING if seed % 2 else _CONSTANT
    place.mkdir(parents=True, exist_ok=True)
    document |= {"seed": seed, "duration_s": seconds}
    (place / "scenario.yaml").write_text(yaml.safe_dump(document), encoding="utf-8")
    simulate(place / "scenario.yaml", place / "made", video=False)
    return place / "made" / "flight.yaml"


def commands(minutes: float) -> Iterator[list[str]]:
    """Run the commands of a session of so many minutes; yield command, peak MB, processor s, page MB."""
    with tempfile.TemporaryDirectory(prefix="scale-") as folder:
        session = ingest(flown(300, 60 * minutes, Path(folder)), Path(folder) / "long.session").folder
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


def accuracy(seed: int) -> Iterator[list[str]]:
    """Reconstruct a flight of 90 s by both methods, with its pose noise stated and without."""
    with tempfile.TemporaryDirectory(prefix="scale-") as folder:
        manifest = flown(seed, 90.0, Path(folder))
        document: Any = yaml.safe_load(manifest.read_text(encoding="utf-8"))
        for stated in (True, False):
            if not stated:
                for camera in document["cameras"].values():
                    del camera["pose_noise"]
            path = manifest.with_name(f"{stated}.yaml")
            path.write_text(yaml.safe_dump(document), encoding="utf-8")
            session = ingest(path, Path(folder) / f"{stated}.session").folder
            found = [reconstruct(session, ReconstructSettings(method=m)).metrics for m in ("robust", "auto")]
            yield [
                f"{seed}, {len(document['cameras'])} drones, {'drifting' if seed % 2 else 'constant'}",
                "yes" if stated else "no",
                *(fixed(each[key]) for key in ("mpjpe_mm", "root_mpjpe_mm") for each in found),
            ]


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("--minutes", type=float, nargs="+", default=[2.0, 10.0])
    parser.add_argument("--accuracy", action="store_true", help="errors of flights of 90 s instead")
    parser.add_argument("--first", type=int, default=300, help="seed of the first flight of --accuracy")
    parser.add_argument("--count", type=int, default=8, help="flights of --accuracy")
    options = parser.parse_args()
    if options.accuracy:
        key, header = "scale-accuracy", ["flight", "noise stated", "robust", "auto"]
        header += ["root-relative, robust", "root-relative, auto"]
        seeds = range(options.first, options.first + options.count)
        rows = [row for seed in seeds for row in accuracy(seed)]
    else:
        key, header = "scale", ["minutes", "command", "peak MB", "CPU s", "page MB"]
        rows = [row for minutes in options.minutes for row in commands(minutes)]
    show(key, markdown_table(header, rows), write=options.write)


if __name__ == "__main__":
    main()
