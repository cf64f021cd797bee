"""Flights with pictures: container stamps, overlays on frames, and pictures that are gone."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from pipelines.session.storage import read_json
from tests.commands.runner import ingested, measured, mocap, refused, succeeds
from tests.synthetic.flights import START_NS, SyntheticFlight, write_flight
from tests.synthetic.logged_flights import write_logged_flight
from tests.synthetic.videos import SIZE, TICK_S, even_ticks, uneven_ticks, write_video

HALF_SECOND = 15


def with_videos(folder: Path) -> SyntheticFlight:
    """Write a clean flight with frame times from its videos; the lens is scaled to their size."""
    flight = write_flight(folder, seconds=0.5, clean=True)
    for name in flight.cameras:
        write_video(folder / f"{name}.mp4", even_ticks(HALF_SECOND))
        camera = flight.settings["cameras"][name]
        camera["video"] = f"{name}.mp4"
        camera["frame_times"] = {"start": START_NS // 10**9}
        # The pictures are small: their keypoints lie where a camera of that size would see them.
        width, height = SIZE
        scale = np.array([width / 1280, height / 720])
        keypoints = folder / camera["keypoints"]["file"]
        people = json.loads(keypoints.read_text(encoding="utf-8"))
        for person in people:
            joints = np.array(person["keypoints"]).reshape(-1, 3)
            joints[:, :2] *= scale
            person["keypoints"] = joints.ravel().tolist()
        keypoints.write_text(json.dumps(people), encoding="utf-8")
        lens = camera["intrinsics"]
        lens.update(width=width, height=height)
        for key, factor in (("fx", 0), ("cx", 0), ("fy", 1), ("cy", 1)):
            lens[key] = float(lens[key] * scale[factor])
    flight.save()
    return flight


def session_json(folder: Path) -> dict[str, Any]:
    return read_json(folder / "flight.session" / "session.json")


def test_frames_are_stamped_by_the_container(tmp_path: Path) -> None:
    flight = with_videos(tmp_path)
    ticks = uneven_ticks(HALF_SECOND)
    write_video(tmp_path / "drone2.mp4", ticks)
    succeeds("ingest", flight.manifest)
    frames = pd.read_parquet(tmp_path / "flight.session" / "cameras" / "drone2" / "frames.parquet")
    expected = [START_NS + round(tick * TICK_S * 10**9) for tick in ticks]
    assert np.abs(frames["t_ns"].to_numpy() - expected).max() <= 1
    assert frames["frame"].tolist() == list(range(HALF_SECOND))


def test_frame_times_of_a_csv(tmp_path: Path) -> None:
    flight = with_videos(tmp_path)
    rows = [f"{k},{START_NS + 40_000_000 * k}" for k in range(HALF_SECOND + 2) if k != 3]
    (tmp_path / "times.csv").write_text("\n".join(["frame,t_ns", *rows]) + "\n", encoding="utf-8")
    flight.settings["cameras"]["drone1"]["frame_times"] = {"file": "times.csv"}
    flight.save()
    done = mocap("ingest", flight.manifest)
    assert done.returncode == 0, done.stderr
    assert "drone1: frames dropped: 1 without a time, 2 time without a picture" in done.stderr
    frames = pd.read_parquet(tmp_path / "flight.session" / "cameras" / "drone1" / "frames.parquet")
    assert frames["frame"].tolist() == [0, 1, 2, *range(4, HALF_SECOND)]
    assert frames["t_ns"].iloc[3] == START_NS + 160_000_000


def test_overlays_lie_on_frames_until_the_video_is_gone(tmp_path: Path) -> None:
    flight = with_videos(tmp_path)
    session = ingested(flight)
    assert measured(session)["mpjpe_mm"] < 2
    succeeds("report", session)
    page = session / "report" / "index.html"
    pictures = page.read_text(encoding="utf-8").count("UklGR")
    assert pictures > 0
    (tmp_path / "drone1.mp4").unlink()
    succeeds("report", session)
    fewer = page.read_text(encoding="utf-8").count("UklGR")
    assert 0 < fewer < pictures
    stage = read_json(session / "report" / "stage.json")
    assert any("drone1" in warning for warning in stage["warnings"])


def test_overlays_on_pictures_of_a_log(tmp_path: Path) -> None:
    write_logged_flight(tmp_path, "ros2-mcap")
    session = tmp_path / "flight.session"
    succeeds("ingest", tmp_path / "flight.yaml")
    succeeds("reconstruct", session, "--method", "robust")
    succeeds("report", session)
    page = session / "report" / "index.html"
    assert "UklGR" in page.read_text(encoding="utf-8")


def test_video_without_keypoints_is_ingested_and_reconstruct_says_what_is_missing(tmp_path: Path) -> None:
    flight = with_videos(tmp_path)
    for name in flight.cameras:
        del flight.settings["cameras"][name]["keypoints"]
    flight.save()
    succeeds("ingest", flight.manifest)
    assert session_json(tmp_path)["cameras"]["drone1"]["keypoints"] is None
    session = tmp_path / "flight.session"
    assert "keypoints" in refused("reconstruct", session, "--method", "robust")
    succeeds("report", tmp_path / "flight.session")
