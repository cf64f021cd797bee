"""Make the corpus: film, detect with both networks, follow the background, and keep what that gives.

    python -m benchmarks.accuracy films [--films FOLDER] [--workers N] [--refollow] [FLIGHT ...]

What exists is kept, so an interrupted run goes on. `--refollow` follows the backgrounds anew, with the films
that are in the folder. A film is removed once all of its flight is kept. The detectors must be there
(`mocap models fetch`), and the recorded motions (MOCAP_REAL_DATA).
"""

import argparse
import shutil
import time
from collections.abc import Iterator
from pathlib import Path

from benchmarks.corpus.stored import (
    DETECTORS,
    RECORDED,
    SAMPLE,
    Background,
    Flight,
    Keypoints,
    flights,
    write_backgrounds,
    write_keypoints,
)
from pipelines.detect import detect, follow
from pipelines.ingest import ingest
from pipelines.reconstruction.background_tracks import tracks_path
from pipelines.session.stages import locked
from pipelines.session.tables import KEYPOINTS, TRACKS, read_table
from pipelines.simulate import simulate


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("flights", nargs="*", metavar="FLIGHT", help="names; all by default")
    parser.add_argument("--films", type=Path, default=Path("build/corpus_films"))
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--refollow", action="store_true", help="follow the backgrounds anew")


def run(arguments: argparse.Namespace) -> Iterator[tuple[str, list[str]]]:
    """Make the flights that are not complete; there is nothing to show."""
    for flight in flights():
        if arguments.flights and flight.name not in arguments.flights:
            continue
        began, spent = time.perf_counter(), time.process_time()
        if make(flight, arguments.films, arguments.workers, again=arguments.refollow):
            took, cpu = time.perf_counter() - began, time.process_time() - spent
            print(f"{flight.name}: {took:.0f} s, {cpu:.0f} s of the processor", flush=True)
        for path in arguments.films.glob(f"{flight.name}*"):
            shutil.rmtree(path)
    yield from ()


def make(flight: Flight, films: Path, workers: int = 1, *, again: bool = False) -> bool:
    """Make what is missing of a flight; return False if nothing is."""
    missing = [name for name in DETECTORS if not flight.keypoints_path(name).is_file()]
    follows = flight.with_pictures and (again or not flight.background_paths[0].is_file())
    if not missing and not follows:
        return False
    flight.folder.mkdir(parents=True, exist_ok=True)
    filmed = film(flight, films, workers)
    session = ingest(filmed / "flight.yaml", films / f"{flight.name}.session").folder
    for detector in missing:
        keep_detections(flight, session, detector, workers)
    if follows:
        write_backgrounds(flight, _followed(session))
    return True


def film(flight: Flight, films: Path, workers: int) -> Path:
    """Film the flight, or find its film; the sample's is in the repository."""
    if flight.folder.name == SAMPLE.name:
        return SAMPLE
    named = films / f"{flight.name}.scenario"
    named.mkdir(parents=True, exist_ok=True)
    scenario = Path(shutil.copy(flight.scenario_path, named))
    for file, _ in flight.scenario.motion_files(RECORDED).values():
        shutil.copy(file, named)
    return simulate(scenario, films / flight.name, workers=workers).folder


def keep_detections(flight: Flight, session: Path, detector: str, workers: int) -> None:
    """Detect in the pictures of a flight's session, and write what is kept of it."""
    with locked(session) as writable:
        record = detect(writable, detector=detector, people=len(flight.scenario.people), workers=workers)
    assert record is not None, "a film was ingested without pictures"
    counts = {
        camera: {key: value for key, value in counted.items() if isinstance(value, int)}
        for camera, counted in record.counts["cameras"].items()
    }
    tables = {
        camera: read_table(session / "detect" / camera / "keypoints.parquet", KEYPOINTS) for camera in counts
    }
    found = Keypoints(tuple(record.counts["joints"]), counts, tables)
    write_keypoints(flight.keypoints_path(detector), found)


def _followed(session: Path) -> dict[str, Background]:
    """Follow the background through all pictures of every camera."""
    with locked(session) as writable:
        record = follow(writable)
    backgrounds = {}
    for camera in record.counts["cameras"]:
        folder = session / "background" / camera
        stills = {int(path.stem): path.read_bytes() for path in sorted(folder.glob("stills/*.jpg"))}
        backgrounds[camera] = Background(read_table(tracks_path(folder), TRACKS), stills)
    return backgrounds
