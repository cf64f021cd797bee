"""Flights longer than the stretches from which the refinement learns: `auto` beside `robust`.

    python -m benchmarks.long_flights            # the table of docs/measurements-refined.md

Simulated, modelled keypoints with a detector's lasting errors; noise stated, and nothing stated. There is no
film and so no background: keypoints alone tell of the cameras. Odd seeds drift; half of the flights have
three drones.

    python -m benchmarks.long_flights --memory 2 5 10

measures instead the most memory and the processor time that `mocap reconstruct`, `check`, `report` and
`export` take on the first of these flights, of so many minutes, each in a process of its own. `--given
nothing` leaves its noise out. `--repeat 15` repeats the flight to and fro so often, which takes less time
than to simulate an hour; with several numbers each in turn. `--film` films the flight, and repeats what was
found in its pictures. `--session` takes an ingested flight of so many minutes instead of flying one.
`--compare` measures `mocap replan-compare` instead of these commands.

    python -m benchmarks.long_flights --segments 60 300 900 --minutes 12 --first 302

reconstructs one flight in segments of so many seconds, each in turn, and says what that costs: errors, NEES,
and the error of the acceleration about the seams of the shortest segments beside that elsewhere. `--session`
takes an ingested flight instead of flying one, in which the truth is known.

    python -m benchmarks.long_flights --page demo/mound_walk.session    # the figure of docs/report.md

measures the page of an hour: the session's tables are repeated, its pictures and settings kept. The page is
written beside the session, as hour.html, and opened in Chromium where that is installed.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any
from unittest.mock import patch

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import yaml  # type: ignore[import-untyped]

from benchmarks.cluster import FRAME_NS, write_film
from benchmarks.results_page import markdown_table
from pipelines.geometry.arrays import Float, Int64
from pipelines.ingest import ingest
from pipelines.reconstruct import Settings, reconstruct
from pipelines.reconstruction import segments
from pipelines.reconstruction.background_tracks import still_name
from pipelines.report import content_of
from pipelines.reporting.content import SessionContent
from pipelines.reporting.page import render_page
from pipelines.session.description import read_description
from pipelines.session.errors import DataError
from pipelines.session.people import true_joints_at
from pipelines.session.records import POINT_COVARIANCE_COLUMNS
from pipelines.session.stage_records import Stage, key_of
from pipelines.session.stages import Run, WritableSession
from pipelines.session.storage import sha256_of
from pipelines.session.tables import motion_from
from pipelines.simulate import simulate
from pipelines.sources.pictures import open_pictures
from tests.reporting.browser import browser

if TYPE_CHECKING:
    import pandas as pd

SAMPLE = Path(__file__).parents[1] / "sample_data" / "mound_walk" / "scenario.yaml"
NOISE = (
    {
        "white": {"position_m": 0.02, "rotation_deg": 0.2},
        "bias": {"position_m": 0.05, "rotation_deg": 0.3},
    },
    {
        "white": {"position_m": 0.02, "rotation_deg": 0.2},
        "gauss-markov": {"position_m": 0.1, "rotation_deg": 0.4, "correlation_s": 20},
    },
)
COLUMNS = ("flight", "stated", "robust mm", "auto mm", "root-relative, robust", "the same, auto", "refused")


def scenario(seed: int, seconds: float) -> dict[str, object]:
    """Return the sample's scenario with a longer walk, another seed, and two or three drones."""
    document: dict[str, object] = yaml.safe_load(SAMPLE.read_text())
    turn = (-75, 60, 80, 45)[seed % 4]
    walk = {"walk": {"distance_m": 16, "turn_deg": turn, "speed_mps": 1.3}}
    actor, drones = document["actor"], document["drones"]
    assert isinstance(actor, dict)
    assert isinstance(drones, dict)
    actor["motion"] = [walk] * (int(seconds / 12) + 1)
    drones["count"], drones["pose_noise"] = 2 + seed // 2 % 2, NOISE[seed % 2]
    return document | {"seed": seed, "duration_s": seconds}


def flown(seed: int, minutes: float, place: Path, *, stated: bool, film: bool = False) -> Path:
    """Fly a flight of so many minutes and ingest it; return its session. With film, detect people in it."""
    document = scenario(seed, 60 * minutes)
    (place / "scenario.yaml").write_text(yaml.safe_dump(document))
    simulate(place / "scenario.yaml", place / "made", video=film)
    manifest = yaml.safe_load((place / "made" / "flight.yaml").read_text())
    if not stated:
        for camera in manifest["cameras"].values():
            del camera["pose_noise"]
    (place / "made" / "flown.yaml").write_text(yaml.safe_dump(manifest))
    session = ingest(place / "made" / "flown.yaml", place / "flown.session").folder
    if film:
        reconstruct(session)
        shutil.rmtree(session / "reconstruct")
    return session


COMMANDS = (
    ("reconstruct", "--workers", "1"),
    ("check",),
    ("report",),
    ("export", "--to", "trc,csv,tum", "--overwrite"),
)
COMPARISON = (("replan-compare", "--arms", "adaptive,fixed,flown"),)
# A process of its own: a child's most memory begins with that of the process that starts it.
_MEASURED = """
import json, resource, subprocess, sys
code = subprocess.run(sys.argv[1:], stdout=subprocess.DEVNULL).returncode
used = resource.getrusage(resource.RUSAGE_CHILDREN)
print(json.dumps([code, used.ru_maxrss, used.ru_utime + used.ru_stime]))
"""


def memory_rows(
    session: Path, minutes: float, commands: tuple[tuple[str, ...], ...] = COMMANDS
) -> Iterator[str]:
    """Run the commands of a session; yield rows: minutes, command, peak MB, processor seconds.

    Each has one process; with more of them each takes as much.
    """
    mocap = Path(sys.executable).parent / "mocap"
    for command, *options in commands:
        done = subprocess.run(  # noqa: S603  # our own command, with folders made here
            [sys.executable, "-c", _MEASURED, mocap, command, session, *options],
            stdout=subprocess.PIPE,
            check=True,
        )
        code, peak_kib, took_s = json.loads(done.stdout)
        if code:
            raise SystemExit(f"mocap {command} ended with {code}")
        yield f"| {minutes:g} | {command} | {peak_kib * 1024 / 1e6:.0f} | {took_s:.0f} |"


SEGMENT_COLUMNS = (
    *("seconds of a segment", "segments", "MPJPE mm", "root-relative mm", "NEES", "in the 95 % ellipsoids %"),
    *("acceleration error m/s^2", "the same about seams", "memory so far MB"),
)
_ABOUT_NS = 4_000_000_000  # of a seam: results go over from one segment to the next within 3 s of it
_CHI2_95 = 7.815  # of three numbers


@dataclass(frozen=True)
class Divided:
    """Result of a reconstruction in segments of one length."""

    cells: list[str]  # of SEGMENT_COLUMNS, without those of accelerations and memory
    seams_ns: Float
    t_ns: Int64  # [T]
    change: Float  # [T - 2, J] m/s^2, error of the acceleration
    peak_mb: float  # of this process until then

    def row(self, seams_ns: Float) -> list[str]:
        """Return its row, with the error of the acceleration about these seams."""
        near = (np.abs(self.t_ns[1:-1, None] - seams_ns) < _ABOUT_NS).any(axis=1)
        apart = [f"{np.nanmean(self.change[rows]):.2f}" if rows.any() else "" for rows in (~near, near)]
        return [*self.cells, *apart, f"{self.peak_mb:.0f}"]


def in_segments(session: Path, length_s: float) -> Divided:
    """Reconstruct a session in segments of this length."""
    with patch.object(segments, "LENGTH_S", length_s):
        metrics = reconstruct(session, workers=1, force=True).metrics
    skeleton = pq.read_table(session / "reconstruct" / "skeleton.parquet").to_pandas()
    joints = tuple(dict.fromkeys(skeleton["joint"]))
    t_ns = np.unique(skeleton["t_ns"].to_numpy())
    truth = motion_from(pq.read_table(session / "truth.parquet").to_pandas(), joints)
    true = true_joints_at(truth, t_ns)[:, 0]
    found = skeleton[["x", "y", "z"]].to_numpy().reshape(len(t_ns), len(joints), 3)
    covariance = np.zeros((len(skeleton), 3, 3))
    rows, columns = np.triu_indices(3)
    covariance[:, rows, columns] = skeleton[list(POINT_COVARIANCE_COLUMNS)].to_numpy()
    covariance[:, columns, rows] = covariance[:, rows, columns]
    missed = (found - true).reshape(-1, 3)
    there = np.isfinite(missed).all(axis=1) & (skeleton["status"] == "ok").to_numpy()
    whitened = np.linalg.solve(covariance[there], missed[there][..., None])[..., 0]
    nees = np.sum(missed[there] * whitened, axis=1)
    step_s = float(np.median(np.diff(t_ns))) / 1e9
    parts = metrics.get("segments", [])
    return Divided(
        [
            f"{length_s:g}",
            f"{max(len(parts), 1)}",
            f"{metrics['mpjpe_mm']:.1f}",
            f"{metrics['root_mpjpe_mm']:.1f}",
            f"{nees.mean():.2f}",
            f"{100 * (nees < _CHI2_95).mean():.1f}",
        ],
        read_description(session).start_ns + np.array([1e9 * of["first_s"] for of in parts[1:]]),
        t_ns,
        np.linalg.norm(np.diff(found - true, 2, axis=0), axis=2) / step_s**2,
        resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6,
    )


def lengthen(session: Path, turns: int) -> None:
    """Make an ingested flight longer: to and fro in turns, so that people, drones and pictures do not jump.

    What was found in its pictures is repeated as well, and its stages get the keys of the longer flight.
    Longer videos are written into a new folder beside the session, `<session>.films`.
    """
    path = session / "session.json"
    document = json.loads(path.read_text())
    spans = {name: entry["frames"] for name, entry in document["cameras"].items()}
    start = min(span["first_t_ns"] for span in spans.values())
    end = max(span["last_t_ns"] for span in spans.values())
    period = end - start + FRAME_NS
    counts = {
        name: pq.read_metadata(session / "cameras" / name / "frames.parquet").num_rows for name in spans
    }
    records = {}
    for stage in ("ingest", "detect", "background", "reconstruct"):
        if (session / stage / "stage.json").exists():
            records[stage] = json.loads((session / stage / "stage.json").read_text())
    films = session.with_name(f"{session.name}.films")
    for name, entry in document["cameras"].items():
        if entry["media"] is not None:
            film, pts = (
                films / f"{name}.mp4",
                pq.read_table(session / "cameras" / name / "frames.parquet")["pts_ns"],
            )
            films.mkdir(exist_ok=True)
            write_film(session / entry["media"]["paths"][0], film, pts.to_numpy(), turns)
            entry["media"]["paths"] = [f"../{films.name}/{film.name}"]
            document["sources"][entry["media"]["sources"][0]] = sha256_of(film)
    for record in records.values():
        for name in [name for name in record["outputs"] if name.endswith(".parquet")]:
            _lengthen_table(
                session / name, turns, (start, end), period, counts.get(Path(name).parent.name, 0)
            )
        for name in [name for name in record["outputs"] if name.endswith(".jpg")]:
            count, number = counts[Path(name).parts[1]], int(Path(name).stem)
            for turn in range(1, turns):
                there = turn * count + (count - 1 - number if turn % 2 else number)
                other = Path(name).with_name(still_name(there))
                os.link(session / name, session / other)
                record["outputs"][other.as_posix()] = record["outputs"][name]
    for name, entry in document["cameras"].items():
        last = pq.read_table(session / "cameras" / name / "frames.parquet")["t_ns"][-1].as_py()
        entry["frames"] |= {"count": turns * counts[name], "last_t_ns": last}
    path.write_text(json.dumps(document))
    if "detect" in records:
        records["detect"]["counts"]["rows"] = {name: [0, turns * count] for name, count in counts.items()}
    for stage, record in records.items():
        for name in [name for name in record["outputs"] if not name.endswith(".jpg")]:
            record["outputs"][name] = sha256_of(session / name)
        (session / stage / "stage.json").write_text(json.dumps(record))
    _give_new_keys(session)


def _lengthen_table(path: Path, turns: int, span: tuple[int, int], period: int, frames: int) -> None:
    """Repeat a table to and fro, one part of it after the other; rows outside the span are left out."""
    start, end = span
    old = path.rename(path.with_suffix(".once"))
    with pq.ParquetFile(old) as source, pq.ParquetWriter(path, source.schema_arrow) as writer:
        there = [name for name in ("t_ns", "pts_ns", "frame", "point") if name in source.schema_arrow.names]
        most = {name: pc.max(pq.read_table(old, columns=[name])[name]).as_py() for name in there}
        # Of each column: what a number and its mirrored one add up to, and what each turn adds.
        mirrors = most | {"t_ns": start + end, "frame": frames - 1}
        added = {"t_ns": period, "pts_ns": period, "frame": frames, "point": most.get("point", 0) + 1}
        groups = list(range(source.num_row_groups))
        for turn in range(turns):
            back = turn % 2 == 1
            for group in groups[::-1] if back else groups:
                rows = source.read_row_group(group)
                if "t_ns" in there:
                    inside = pc.greater_equal(rows["t_ns"], start), pc.less_equal(rows["t_ns"], end)
                    rows = rows.filter(pc.and_(*inside))
                if back:
                    rows = rows.take(np.arange(rows.num_rows)[::-1])
                for name in there:
                    values = rows[name].to_numpy().astype(np.int64)
                    values = (mirrors[name] - values if back and name != "point" else values) + turn * added[
                        name
                    ]
                    place = rows.column_names.index(name)
                    field = rows.schema.field(place)
                    rows = rows.set_column(place, field, pa.array(values, field.type))
                writer.write_table(rows)
    old.unlink()


def _give_new_keys(session: Path) -> None:
    """Give the stages that looked at pictures the keys of their present inputs, so that they are finished."""
    begin = WritableSession.begin

    def begin_anew(self: WritableSession, stage: Stage, **given: Any) -> Run:
        if stage.name == "reconstruct":
            raise DataError(session, "was only prepared")
        path = session / stage.name / "stage.json"
        record = json.loads(path.read_text())
        key = key_of(stage, given["settings"], given["inputs"])
        path.write_text(json.dumps(record | {"key": key, "inputs": given["inputs"]}))
        return begin(self, stage, **given)

    with patch.object(WritableSession, "begin", begin_anew), suppress(DataError):
        reconstruct(session)


def repeated(content: SessionContent, seconds: float) -> tuple[SessionContent, dict[str, int]]:
    """Repeat a session's tables until they last so long; return them, and the frames of each camera once."""
    spans = [entry.frames for entry in content.session.cameras.values()]
    first, last = min(span.first_t_ns for span in spans), max(span.last_t_ns for span in spans)
    period = last - first + 33_333_333
    count = round(seconds * 1e9 / period)
    frames = {name: int(table["frame"].max()) + 1 for name, table in content.frames.items()}

    def longer(table: pd.DataFrame, per_round: int = 0) -> pd.DataFrame:
        inside = table[(table["t_ns"] >= first) & (table["t_ns"] < first + period)]
        rounds = np.repeat(np.arange(count), len(inside))
        made = inside.iloc[np.tile(np.arange(len(inside)), count)].reset_index(drop=True)
        made["t_ns"] += rounds * period
        if "frame" in made:
            made["frame"] += rounds * per_round
        return made

    def all_longer(tables: dict[str, pd.DataFrame]) -> dict[str, pd.DataFrame]:
        return {name: longer(table, frames[name]) for name, table in tables.items()}

    cameras = {
        name: entry.model_copy(
            update={
                "frames": entry.frames.model_copy(
                    update={
                        "count": count * entry.frames.count,
                        "last_t_ns": entry.frames.last_t_ns + (count - 1) * period,
                    }
                )
            }
        )
        for name, entry in content.session.cameras.items()
    }
    made = replace(
        content,
        session=content.session.model_copy(update={"cameras": cameras}),
        skeleton=None if content.skeleton is None else longer(content.skeleton),
        truth=None if content.truth is None else longer(content.truth),
        angles=None if content.angles is None else longer(content.angles),
        poses=all_longer(content.poses),
        frames=all_longer(content.frames),
        keypoints=all_longer(content.keypoints),
        refined=all_longer(content.refined),
        true_poses=all_longer(content.true_poses),
    )
    return made, frames


def page_lines(session: Path, minutes: float) -> list[str]:
    """Write the page of a repeated session; return its size and how long making and opening it took."""
    content, frames = repeated(content_of(session), 60 * minutes)
    began_s = time.process_time()
    with ExitStack() as stack:
        description = read_description(session)
        pictures = {
            name: stack.enter_context(open_pictures(session, description, name))
            for name, entry in description.cameras.items()
            if entry.media is not None
        }
        html = render_page(
            content, lambda camera, frame: pictures[camera].read(frame % frames[camera]), "small"
        )
    page = session.with_name("hour.html")
    page.write_text(html, encoding="utf-8")
    lines = [
        f"{page}: {minutes:g} minutes, {page.stat().st_size / 1e6:.1f} MB, "
        f"{time.process_time() - began_s:.0f} processor seconds after its tables were loaded"
    ]
    drawn = "new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() => done(true))))"
    with (
        tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile,
        browser(Path(profile)) as tab,
    ):
        tab.show_as()
        for _ in range(3):
            opened_s = time.perf_counter()
            tab.open(page.resolve())
            tab.wait_for("document.getElementById('viewer').dataset.ready === 'true'")
            tab.evaluate(drawn)
            lines.append(f"opened and drawn after {time.perf_counter() - opened_s:.1f} s")
        assert tab.complaints == []
    return lines


def main() -> None:
    """Fly, reconstruct and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--first", type=int, default=300, help="seed of the first flight")
    parser.add_argument("--count", type=int, default=8)
    parser.add_argument("--seconds", type=float, default=90.0)
    parser.add_argument("--memory", type=float, nargs="+", metavar="MINUTES", help="measure memory instead")
    parser.add_argument("--repeat", type=int, nargs="+", default=[1], metavar="TIMES", help="with --memory")
    parser.add_argument("--film", action="store_true", help="with --memory: film it")
    parser.add_argument("--compare", action="store_true", help="with --memory: replan-compare instead")
    parser.add_argument("--given", choices=("model", "nothing"), default="model", help="with --memory")
    parser.add_argument("--page", type=Path, metavar="SESSION", help="measure the page of an hour instead")
    parser.add_argument("--minutes", type=float, default=60.0, help="with --page and --segments")
    parser.add_argument("--segments", type=float, nargs="+", metavar="SECONDS", help="compare their lengths")
    parser.add_argument("--session", type=Path, help="with --segments and --memory: an ingested flight")
    arguments = parser.parse_args()
    stated = arguments.given == "model"
    if arguments.page:
        print("\n".join(page_lines(arguments.page, arguments.minutes)))
        return
    if arguments.segments:
        with tempfile.TemporaryDirectory() as folder:
            session = Path(folder) / "flown.session"
            if arguments.session is None:
                session = flown(arguments.first, arguments.minutes, Path(folder), stated=stated)
            else:
                shutil.copytree(arguments.session, session)
            results = [in_segments(session, length_s) for length_s in sorted(arguments.segments)]
        rows = [result.row(results[0].seams_ns) for result in results]
        print("\n".join(markdown_table(SEGMENT_COLUMNS, rows)))
        return
    if arguments.memory:
        for minutes in arguments.memory:
            with tempfile.TemporaryDirectory() as folder:
                once = arguments.session or flown(
                    arguments.first, minutes, Path(folder), stated=stated, film=arguments.film
                )
                for turns in arguments.repeat:
                    # Beside the other, because paths to its videos are relative.
                    session = once.with_name(f"{once.stem}-{turns}.session")
                    shutil.copytree(once, session)
                    lengthen(session, turns)
                    commands = COMPARISON if arguments.compare else COMMANDS
                    for row in memory_rows(session, minutes * turns, commands):
                        print(row, flush=True)
                    shutil.rmtree(session)
                    shutil.rmtree(session.with_name(f"{session.name}.films"), ignore_errors=True)
        return
    rows = []
    for seed in range(arguments.first, arguments.first + arguments.count):
        with tempfile.TemporaryDirectory() as folder:
            place = Path(folder)
            plan = scenario(seed, arguments.seconds)
            (place / "scenario.yaml").write_text(yaml.safe_dump(plan))
            simulate(place / "scenario.yaml", place / "made", video=False)
            manifest = yaml.safe_load((place / "made" / "flight.yaml").read_text())
            for stated in (True, False):
                if not stated:
                    for camera in manifest["cameras"].values():
                        del camera["pose_noise"]
                (place / "made" / "flown.yaml").write_text(yaml.safe_dump(manifest))
                session = place / f"{stated}.session"
                ingest(place / "made" / "flown.yaml", session)
                found = {}
                for method in ("robust", "auto"):
                    reconstruct(session, Settings(method=method))
                    found[method] = json.loads((session / "reconstruct" / "metrics.json").read_text())
                drones = plan["drones"]
                assert isinstance(drones, dict)
                noise = "drifting" if seed % 2 else "constant"
                rows.append(
                    [
                        f"{seed}, {drones['count']} drones, {noise}",
                        "yes" if stated else "no",
                        *(f"{found[method]['mpjpe_mm']:.0f}" for method in ("robust", "auto")),
                        *(f"{found[method]['root_mpjpe_mm']:.0f}" for method in ("robust", "auto")),
                        "yes" if found["auto"]["refinement"].get("fallback") else "",
                    ]
                )
    print("\n".join(markdown_table(COLUMNS, rows)))


if __name__ == "__main__":
    main()
