"""Kills of commands at random moments, second runs, and comparison of their files with an undisturbed run."""

import shutil
import signal
import subprocess
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tests.commands.runner import MOCAP, content, mocap, mocap_process
from tests.keypoints.spotted_flights import spot_detector, write_spotted_flight

_ATTEMPTS, _QUICKER = 5, 0.7  # to hit a command before it ends
_FRAMES = 64  # a replay needs a second of joints that are ok
_EXPORTED = "trc,c3d,csv,tum,mcap"  # nobody is as tall as these spots, so they have no body
SMALL_STUDY = (
    *("tilt_deg=0:60:15", "noise=medium", "method=dlt,robust"),
    *("seconds=8", "rate_hz=5", "trials=2", "--workers", "1"),
)
SCENARIO = """\
schema: 1
name: Kills
seed: 3
duration_s: 1
actor:
  start: [9, -6]
  motion:
    - walk: {distance_m: 6, speed_mps: 1.2}
world:
  ground: {size_m: 40}
  mounds: [{centre: [0, 0], sigma_m: [5, 2.5], height_m: 4}]
  map: {resolution_m: 0.5, height_m: 8}
drones:
  count: 2
  formation: {planner: adaptive, radius_m: 10, tilt_deg: 15}
  camera: {width: 160, height: 96, hfov_deg: 80, rate_hz: 10}
"""


@dataclass(frozen=True)
class Command:
    """Command with the one folder that it writes."""

    arguments: Sequence[str | Path]
    folder: Path
    anew: Sequence[str] = ("--force",)  # options to do everything again; none if it always does
    before: Path | None = None  # the command begins with a copy of this


@dataclass(frozen=True)
class Killed:
    """Result of one kill."""

    command: str
    after_s: float
    length_s: float  # of an undisturbed run
    over_finished: bool  # its results existed already
    hit: bool  # it had not ended by itself
    trouble: str  # empty if all is as it should be


def commands_on(folder: Path) -> dict[str, Command]:
    """Build the commands, by name, with the flight, the models and the scenario that they need."""
    folder.mkdir(parents=True, exist_ok=True)
    manifest = write_spotted_flight(folder, _FRAMES)
    detector = spot_detector(folder)
    (folder / "scenario.yaml").write_text(SCENARIO, encoding="utf-8")
    ingested, reconstructed, replanned, reported = (
        folder / f"{name}.session" for name in ("ingested", "reconstructed", "replanned", "reported")
    )
    exported, simulated, studied = (folder / name for name in ("exported", "simulated", "studied"))
    detected, batched = folder / "detected.session", folder / "batched"
    detection = ("--method", "robust", "--detector", detector, "--workers", "1")
    return {
        "ingest": Command(["ingest", manifest, "-o", ingested], ingested),
        "detect": Command(["reconstruct", detected, *detection], detected, before=ingested),
        "reconstruct": Command(["reconstruct", reconstructed, *detection], reconstructed, before=ingested),
        "replan-compare": Command(["replan-compare", replanned], replanned, before=reconstructed),
        "report": Command(["report", reported], reported, before=replanned),
        "export": Command(["export", reconstructed, "-o", exported, "--to", _EXPORTED], exported, ()),
        "simulate": Command(["simulate", folder / "scenario.yaml", "-o", simulated], simulated),
        "study": Command(["study", *SMALL_STUDY, "-o", studied], studied),
        "batch": Command(
            ["batch", manifest, "-o", batched, "--stages", "ingest,reconstruct", *detection], batched
        ),
    }


def soak(
    commands: Mapping[str, Command], kills: int, *, seed: int, known_s: Mapping[str, float] | None = None
) -> Iterator[Killed]:
    """Kill the commands in turns, each at a random moment of its run, and run it again.

    Half of the kills hit a command that writes for the first time, half one that does everything again over
    existing results. `commands` depend on those before; `known_s` are their durations, else measured.
    """
    moments = np.random.default_rng(seed)
    lengths, expected = {}, {}
    for name, command in commands.items():
        _begin_anew(command)
        done = mocap(*command.arguments)  # may compile kernels, so its duration is not used
        assert done.returncode == 0, done.stderr
        expected[name] = kept(command.folder)
        lengths[name] = known_s[name] if known_s else _length_s(command)
    for k in range(kills):
        name = list(commands)[k % len(commands)]
        yield _killed_once(name, commands[name], lengths[name], expected[name], moments)


def kept(folder: Path) -> dict[str, str]:
    """List every file and folder except locks and times of day; files with their hashes."""
    folders = {f"{path.relative_to(folder).as_posix()}/": "" for path in folder.rglob("*") if path.is_dir()}
    return folders | content(folder)


def _killed_once(
    name: str, command: Command, length_s: float, expected: Mapping[str, str], moments: np.random.Generator
) -> Killed:
    hit = False
    for attempt in range(_ATTEMPTS):
        over_finished = bool(moments.integers(2))
        if not over_finished:
            _begin_anew(command)
        # A command that ended by itself was faster this time, and may be so again.
        after_s = float(moments.uniform(0.0, length_s * _QUICKER**attempt))
        hit = _kill(after_s, [*command.arguments, *(command.anew if over_finished else [])])
        if hit:
            break
    done = mocap(*command.arguments)
    trouble = f"exit status {done.returncode}: {done.stderr[-500:]}" if done.returncode else ""
    found = kept(command.folder)
    others = {path.name for path in command.folder.parent.iterdir() if path.name.startswith(".")}
    differing = sorted(set(expected.items()) ^ set(found.items()))
    if not trouble and differing:
        trouble = f"other bytes: {', '.join(sorted({path for path, _ in differing})[:5])}"
    if not trouble and others:
        trouble = f"left behind: {', '.join(sorted(others))}"
    return Killed(name, after_s, length_s, over_finished, hit, trouble)


def _length_s(command: Command) -> float:
    _begin_anew(command)
    started = time.monotonic()
    done = mocap_process(*command.arguments, timeout=600)
    assert done.returncode == 0, done.stderr
    return time.monotonic() - started


def _begin_anew(command: Command) -> None:
    shutil.rmtree(command.folder, ignore_errors=True)
    if command.before is not None:
        shutil.copytree(command.before, command.folder)


def _kill(after_s: float, arguments: Sequence[str | Path]) -> bool:
    process = subprocess.Popen(
        [MOCAP, *map(str, arguments)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        process.wait(after_s)
    except subprocess.TimeoutExpired:
        process.send_signal(signal.SIGKILL)
    return process.wait() == -signal.SIGKILL
