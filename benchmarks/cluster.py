"""One long flight over the workers of a Dask cluster, and what many workers ask of its scheduler.

    python -m benchmarks.cluster film FOLDER --minutes 10 --every 5 --workers 2

makes a flight of so many minutes of film in a folder: the sample's 12 s (rendered, logs with errors)
forwards and backwards in turns, so that people, cameras and pictures move on without a jump. It is
ingested, and reconstructed by `auto` on so many workers of this machine. Processor seconds count, because
other work may keep the cores busy: those of the blocks, and those of the process that holds the session,
the owner. Machines that do nothing else take as long as the busiest worker and then the owner; one worker
takes all blocks. The same command continues an interrupted run.

    python -m benchmarks.cluster sleep --flights 10000 --workers 4 16 64 256

runs flights of tasks that sleep: a task for each, as `mocap batch` has it, that gives one block to the
cluster and waits. Eight workers share a process, so that 256 fit on this machine. Blocks sleep longer on more
workers, so that the same number of flights ends each second. The scheduler has a process of its own, whose
processor time is measured, also while the workers do nothing.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import Any, Self, TypeVar

import av
import numpy as np
import pandas as pd
import yaml  # type: ignore[import-untyped]

from benchmarks.results_page import markdown_table
from pipelines.formats.videos.video import VideoReader
from pipelines.formats.videos.video_writing import write_h264
from pipelines.geometry.arrays import Int64, Picture
from pipelines.ingest import ingest
from pipelines.reconstruct import Settings, reconstruct
from pipelines.session.clusters import Cluster, connected, local_cluster

SAMPLE = Path(__file__).parents[1] / "sample_data" / "mound_walk"
DASK = str(Path(sys.executable).with_name("dask"))
T = TypeVar("T")
R = TypeVar("R")

FRAME_NS = 1_000_000_000 // 30


def main() -> None:
    """Run the chosen part, and print its table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parts = parser.add_subparsers(required=True)
    film = parts.add_parser("film", help="one flight over workers")
    film.add_argument("folder", type=Path)
    film.add_argument("--minutes", type=float, default=10.0)
    film.add_argument("--every", type=int, default=5)
    film.add_argument("--workers", type=int, default=2)
    film.set_defaults(run=lambda given: print_film(given.folder, given.minutes, given.every, given.workers))
    sleep = parts.add_parser("sleep", help="many flights that sleep")
    sleep.add_argument("--flights", type=int, default=10_000)
    sleep.add_argument("--workers", type=int, nargs="+", default=[4, 16, 64, 256])
    sleep.set_defaults(run=lambda given: print_sleep(given.flights, given.workers))
    given = parser.parse_args()
    given.run(given)


# --- one flight ----------------------------------------------------------------------------------------


def print_film(folder: Path, minutes: float, every: int, workers: int) -> None:
    """Make the flight, reconstruct it, and print what its parts took."""
    session = folder / f"workers{workers}.session"
    if not session.exists():
        ingest(write_flight(folder, minutes), session)
    log = folder / f"workers{workers}.jsonl"
    own_s = time.process_time()
    with local_cluster(workers) as client:
        client.wait_for_workers(workers)
        made = reconstruct(session, Settings(every=every), cluster=_Timed.keeping(client, log))
    own_s = time.process_time() - own_s
    blocks = pd.read_json(log, lines=True)
    of_worker = blocks.groupby("worker")["s"].sum()
    assert len(of_worker) == workers
    one, several = blocks["s"].sum() + own_s, of_worker.max() + own_s
    print(made.metrics["method_used"]["summary"], file=sys.stderr)
    header = [
        "workers",
        "blocks",
        "s of all blocks",
        "of the busiest worker",
        "of the owner",
        "times as fast",
    ]
    row = [str(workers), str(len(blocks)), *(f"{s:.0f}" for s in (blocks["s"].sum(), of_worker.max(), own_s))]
    print("\n".join(markdown_table(header, [[*row, f"{one / several:.2f}"]])))


class _Timed(Cluster):
    """Cluster that notes the processor seconds of every part, so that an interrupted run counts as well."""

    log: Path

    @classmethod
    def keeping(cls, client: Any, log: Path) -> Self:
        """Use an open connection, and append a line to the log for each part."""
        made = cls.of(client)
        made.log = log
        return made

    def each(
        self, work: Callable[[T], R], parts: Sequence[T], *, on_gpu: bool = False, progress: Any = None
    ) -> Generator[tuple[int, R]]:
        """Note what the parts take, see `Cluster.each`."""
        for number, (result, worker, spent_s) in super().each(
            partial(_timed, work), parts, on_gpu=on_gpu, progress=progress
        ):
            with self.log.open("a") as file:
                file.write(json.dumps({"worker": worker, "s": spent_s}) + "\n")
            yield number, result


def _timed(work: Callable[[T], R], part: T) -> tuple[R, str, float]:
    """Call a function; return also the worker's name and the processor seconds."""
    import distributed  # on the worker

    started_s = time.process_time()
    result = work(part)
    return result, str(distributed.get_worker().name), time.process_time() - started_s


def write_flight(folder: Path, minutes: float) -> Path:
    """Write the sample forwards and backwards in turns; return its flight.yaml."""
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as place:
        once = ingest(SAMPLE / "flight.yaml", Path(place) / "once.session").folder
        manifest = yaml.safe_load((SAMPLE / "flight.yaml").read_text())
        described = json.loads((once / "session.json").read_text())
        cameras = {}
        for name, stated in manifest["cameras"].items():
            frames = pd.read_parquet(once / "cameras" / name / "frames.parquet")["t_ns"].to_numpy(np.int64)
            poses = pd.read_parquet(once / "cameras" / name / "poses.parquet")
            turns = round(minutes * 60e9 / (frames[-1] - frames[0] + FRAME_NS))
            start, period = frames[0], frames[-1] - frames[0] + FRAME_NS
            times = in_turns(frames, start, frames[-1], period, turns)
            pd.DataFrame({"frame": np.arange(len(times)), "t_ns": times}).to_csv(
                folder / f"{name}_times.csv", index=False
            )
            within = poses[poses["t_ns"].between(start, frames[-1])]
            rows = [within if turn % 2 == 0 else within[::-1] for turn in range(turns)]
            stamps = in_turns(within["t_ns"].to_numpy(np.int64), start, frames[-1], period, turns)
            pd.concat(rows).assign(t_ns=stamps).to_csv(folder / f"{name}_poses.csv", index=False)
            write_film(SAMPLE / stated["video"], folder / stated["video"], frames - start, turns)
            lens = described["cameras"][name]["intrinsics"]
            cameras[name] = {
                "video": stated["video"],
                "frame_times": {"csv": f"{name}_times.csv"},
                "clock": stated["clock"],
                "intrinsics": {key: lens[key] for key in ("width", "height", "fx", "fy", "cx", "cy")},
                "pose": {"csv": f"{name}_poses.csv"},
                "pose_noise": stated["pose_noise"],
            }
    document = {"schema": 1, "name": "Mound walk, to and fro", "world": {"frame": "enu"}, "cameras": cameras}
    path = folder / "flight.yaml"
    path.write_text(yaml.safe_dump(document, sort_keys=False))
    return path


def in_turns(t_ns: Int64, start: int, end: int, period: int, turns: int) -> Int64:
    """Repeat times within [start, end], every second turn backwards."""
    there, back = t_ns - start, (end - t_ns)[::-1]
    return np.concatenate([start + turn * period + (back if turn % 2 else there) for turn in range(turns)])


def write_film(source: Path, target: Path, pts_ns: Int64, turns: int) -> None:
    """Write a video forwards and backwards in turns; each direction is encoded once."""
    with VideoReader(source) as reader, tempfile.TemporaryDirectory() as place:
        first = reader.read(0)
        assert first is not None
        height, width = first.shape[:2]
        parts = [Path(place) / "there.mp4", Path(place) / "back.mp4"][:turns]
        for part, backwards in zip(parts, (False, True), strict=False):
            write_h264(part, pictures_of(reader, len(pts_ns), backwards), pts_ns, width=width, height=height)
        with av.open(str(target), "w") as container:
            with av.open(str(parts[0])) as one:
                stream = container.add_stream_from_template(one.streams.video[0])
            stream.time_base = Fraction(1, 90_000)
            length = round((int(pts_ns[-1]) + FRAME_NS) * 90_000 / 1e9)
            for turn in range(turns):
                with av.open(str(parts[turn % 2])) as one:
                    for packet in one.demux(one.streams.video[0]):
                        if packet.size and packet.pts is not None and packet.dts is not None:
                            packet.pts, packet.dts = packet.pts + turn * length, packet.dts + turn * length
                            packet.stream = stream
                            container.mux(packet)


def pictures_of(reader: VideoReader, count: int, backwards: bool) -> Iterator[Picture]:
    """Read the pictures of a video in either direction, always forwards within a second or two."""
    firsts = range(0, count, 60)
    for first in reversed(firsts) if backwards else firsts:
        read = [reader.read(number) for number in range(first, min(first + 60, count))]
        for picture in reversed(read) if backwards else read:
            assert picture is not None
            yield picture


# --- many flights that sleep ---------------------------------------------------------------------------

FLIGHTS_PER_S = 60  # that end, at most: the workers' own work is not to keep all cores busy
WORKERS_TOGETHER = 8  # in a process: they take turns there
IDLE_S = 10.0


def flight(sleep_s: float) -> float:
    """Give a block to the cluster that sleeps, as a flight's task gives its blocks."""
    for _ in Cluster.of_task().each(time.sleep, [sleep_s]):
        pass
    return sleep_s


def print_sleep(flights: int, counts: list[int]) -> None:
    """Run the flights on each number of workers; print the scheduler's processor time."""
    rows = []
    for workers in counts:
        with scheduler() as address, emulated_workers(address, workers), connected(address) as client:
            client.wait_for_workers(workers)
            time.sleep(5)  # connections settle
            idle_s = client.run_on_scheduler(time.process_time)
            time.sleep(IDLE_S)
            started_s, started = client.run_on_scheduler(time.process_time), time.perf_counter()
            idle_s = (started_s - idle_s) / IDLE_S
            sleep_s = workers / FLIGHTS_PER_S
            done = client.gather(client.map(flight, [sleep_s] * flights, pure=False))
            took_s = time.perf_counter() - started
            spent_s = client.run_on_scheduler(time.process_time) - started_s
            assert done == [sleep_s] * flights
        tasks = 2 * flights
        each_ms = 1000 * (spent_s - idle_s * took_s) / tasks
        rows.append(
            [str(workers), f"{spent_s:.1f}", f"{each_ms:.2f}", f"{100 * idle_s:.1f}", f"{took_s:.0f}"]
        )
        print(rows[-1], file=sys.stderr, flush=True)
    header = ["workers", "scheduler s", "ms a task", "% of a core while idle", "by the clock s"]
    print("\n".join(markdown_table(header, rows)))


@contextmanager
def scheduler() -> Iterator[str]:
    """Start a scheduler in a process of its own; yield its address."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "scheduler.json"
        process = subprocess.Popen(  # noqa: S603  # Dask's own command
            [
                DASK,
                "scheduler",
                "--no-dashboard",
                "--host",
                "127.0.0.1",
                *("--port", "0", "--scheduler-file", file),
            ],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        try:
            while not file.exists():
                time.sleep(0.05)
            yield json.loads(file.read_text())["address"]
        finally:
            process.kill()
            process.wait()


_WORKERS = """
import asyncio, sys, distributed

async def main():
    made = (distributed.Worker(sys.argv[1], nthreads=1, memory_limit=0) for _ in range(int(sys.argv[2])))
    workers = list(made)
    await asyncio.gather(*workers)
    await asyncio.gather(*(worker.finished() for worker in workers))

asyncio.run(main())
"""


@contextmanager
def emulated_workers(address: str, count: int) -> Iterator[None]:
    """Start workers of one thread each, several in a process."""
    processes = [
        subprocess.Popen(  # noqa: S603  # this program
            [sys.executable, "-c", _WORKERS, address, str(min(WORKERS_TOGETHER, count - first))],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        for first in range(0, count, WORKERS_TOGETHER)
    ]
    try:
        yield
    finally:
        for process in processes:
            process.kill()
            process.wait()


if __name__ == "__main__":
    main()
