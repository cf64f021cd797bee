"""Input that cannot be used: one line with the file, what is wrong and what to do, and exit status 1."""

import json
import os
import re
import shutil
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from pipelines.geometry.cameras import project
from pipelines.session.description import read_description
from pipelines.session.registries import FORMATS
from pipelines.session.storage import read_json
from tests.commands.runner import content, mocap, mocap_process, refusal, refused, succeeds
from tests.synthetic.flights import SyntheticFlight, write_flight


@pytest.fixture
def flight(tmp_path: Path) -> SyntheticFlight:
    return write_flight(tmp_path, cameras=3, seconds=0.5)


def session_json(folder: Path) -> dict[str, Any]:
    return read_json(folder / "flight.session" / "session.json")


def test_unknown_key_names_the_nearest(flight: SyntheticFlight) -> None:
    flight.settings["cameras"]["drone2"]["keypoint"] = "d.json"
    flight.settings["wrold"] = {}
    flight.save()
    line = refusal(mocap_process("ingest", flight.manifest))  # as a shell sees it
    assert re.search(r"cameras\.drone2\.keypoint: [^;]*'keypoints'\?; wrold: [^;]*'world'\?$", line)


@pytest.mark.parametrize("stated", ["../drone1.tum", "poses/../../drone1.tum"])
def test_a_relative_path_does_not_leave_the_folder(flight: SyntheticFlight, stated: str) -> None:
    outside = flight.manifest.parent.parent / f"{flight.manifest.parent.name}.tum"
    shutil.copy(flight.manifest.parent / "drone1.tum", outside)
    stated = stated.replace("drone1.tum", outside.name)
    flight.settings["cameras"]["drone1"]["pose"]["file"] = stated
    flight.save()
    assert f"({stated})" in refused("ingest", flight.manifest)
    flight.settings["cameras"]["drone1"]["pose"]["file"] = str(outside)
    flight.save()
    succeeds("ingest", flight.manifest)


def test_nan_poses_are_counted_and_the_rest_is_used(flight: SyntheticFlight, tmp_path: Path) -> None:
    log = tmp_path / "drone1.tum"
    rows = log.read_text(encoding="utf-8").splitlines()
    for k in (20, 21, 22):
        stamp, *_ = rows[k].split()
        rows[k] = f"{stamp} nan nan nan 0 0 0 1"
    log.write_text("\n".join(rows) + "\n", encoding="utf-8")
    done = mocap("ingest", flight.manifest)
    assert done.returncode == 0
    assert re.search("^warning: drone1: poses .*: 3 ", done.stderr, re.MULTILINE)
    stored = read_json(tmp_path / "flight.session" / "session.json")
    assert list(stored["cameras"]["drone1"]["poses"]["dropped"].values()) == [3]


@pytest.mark.parametrize("absurd", [1e9, -1e308])
def test_absurd_keypoints_are_counted_and_the_rest_is_used(
    flight: SyntheticFlight, tmp_path: Path, absurd: float
) -> None:
    path = tmp_path / "drone2.json"
    people = json.loads(path.read_text(encoding="utf-8"))
    for person in people[3:5]:
        person["keypoints"][0] = absurd
    people[6]["keypoints"][2::3] = [1.5] * 17
    people.append(people[8])
    path.write_text(json.dumps(people), encoding="utf-8")
    done = mocap("ingest", flight.manifest)
    assert done.returncode == 0
    keypoints = session_json(tmp_path)["cameras"]["drone2"]["keypoints"]
    assert sorted(keypoints["dropped"].values()) == [1, 2]
    assert list(keypoints["adjusted"].values()) == [17]
    lines = [line for line in done.stderr.splitlines() if line.startswith("warning: drone2: keypoints")]
    assert len(lines) == 2
    assert any(re.search(r": .*\b2 joint .*\b1000000 px", line) for line in lines)
    assert any(re.search(r": 17 confidence ", line) for line in lines)
    succeeds("reconstruct", tmp_path / "flight.session", "--method", "robust")
    metrics = read_json(tmp_path / "flight.session" / "reconstruct" / "metrics.json")
    assert metrics["mpjpe_mm"] < 500  # one view at 1e9 px would put the joint kilometres away


@pytest.mark.parametrize(("absurd", "missing", "dropped"), [("nan", 5, 0), ("1e9", 5, 5), ("-1e308", 5, 5)])
def test_absurd_truth_is_counted_and_measures_nothing(
    flight: SyntheticFlight, tmp_path: Path, absurd: str, missing: int, dropped: int
) -> None:
    path = tmp_path / "truth.csv"
    header, *rows = path.read_text(encoding="utf-8").splitlines()
    column = header.split(",").index("y")
    for k in range(40, 45):
        cells = rows[k].split(",")
        cells[column] = absurd
        rows[k] = ",".join(cells)
    path.write_text("\n".join([header, *rows]) + "\n", encoding="utf-8")
    done = mocap("ingest", flight.manifest)
    assert done.returncode == 0
    truth = session_json(tmp_path)["truth"]
    assert truth["missing"] == missing
    assert sum(truth["dropped"].values()) == dropped
    assert len([line for line in done.stderr.splitlines() if line.startswith("warning: truth: ")]) == 1
    stored = pd.read_parquet(tmp_path / "flight.session" / "truth.parquet")
    assert len(stored) == flight.position.shape[0] * 17 - 5
    assert stored[["x", "y", "z"]].abs().to_numpy().max() < 100
    succeeds("reconstruct", tmp_path / "flight.session", "--method", "robust")
    assert read_json(tmp_path / "flight.session" / "reconstruct" / "metrics.json")["mpjpe_mm"] < 500
    if dropped:
        assert f"truth: {dropped} position" in refused("ingest", flight.manifest, "--strict")
    else:
        succeeds("ingest", flight.manifest, "--strict")


def test_true_poses_that_are_left_out_are_counted(flight: SyntheticFlight, tmp_path: Path) -> None:
    path = tmp_path / "drone1_true.tum"
    rows = path.read_text(encoding="utf-8").splitlines()
    rows[20] = f"{rows[20].split()[0]} nan nan nan 0 0 0 1"
    path.write_text("\n".join(rows) + "\n", encoding="utf-8")
    done = mocap("ingest", flight.manifest)
    assert re.search("^warning: drone1: true .*: 1 ", done.stderr, re.MULTILINE)
    dropped = session_json(tmp_path)["truth"]["poses_dropped"]
    assert {name: list(counts.values()) for name, counts in dropped.items()} == {"drone1": [1]}


# A mistake in what is said of drone1 or of the flight, the code of the refusal, and what the line must name.
USUAL_MISTAKES: list[tuple[str, Any, str, list[str]]] = [
    ("drone1.pose", {"file": "logs/drone1.tum"}, "no-such-file", ["logs/drone1.tum"]),
    ("drone1.pose", {"file": "drone1.json"}, "wrong-kind", ["AlphaPose", "tum"]),
    ("drone1.pose", {"file": "drone1.tum", "topic": "/odom"}, "wrong-option", ["topic", "log"]),
    ("drone1.pose", {"file": "drone1.tum", "of": "body"}, "bad-value", ["`mount`", "`gimbal`"]),
    ("drone1.pose", {"file": "empty.tum"}, "no-poses", ["empty.tum", "no rows"]),
    ("drone1.pose", "pictures", "bad-value", ["needs a video"]),
    ("drone1.pose.attitude", "pictures", "bad-value", ["needs a video"]),
    ("drone1.pose", None, "bad-value", ["cameras.drone1.pose: ", "of: body"]),
    ("drone1.intrinsics", None, "bad-value", ["cameras.drone1.intrinsics: ", "fx: 1400"]),
    ("drone1.intrinsics.fx", -3, "bad-value", ["cameras.drone1.intrinsics.fx: "]),
    ("drone1.intrinsics.fx", 24, "bad-value", ["cameras.drone1.intrinsics: ", "24", "64 px"]),
    ("drone1.keypoints", None, "bad-value", ["video or keypoints"]),
    ("drone1.keypoints.file", "drone2.json", "bad-value", ["cameras.drone2.keypoints: ", "drone1"]),
    ("drone1.keypoints.skeleton", "coco-17", "no-such-name", ["coco17", "body25"]),
    ("drone1.keypoint", "drone1.json", "bad-value", ["'keypoints'"]),
    ("drone1.frame_times.start", 1_700_003_600, "no-overlap", ["cameras.drone1.frame_times.start: 16999"]),
    ("drone1.frame_times.fps", 0, "bad-value", ["cameras.drone1.frame_times.fps: "]),
    ("drone1.frame_times.fps", 3000, "bad-value", ["cameras.drone1.frame_times.fps: ", "29.97"]),
    ("world.frame", "nedd", "bad-value", ["world.frame: ", "'ned'"]),
    ("cameras", {}, "bad-value", ["cameras: "]),
    ("map", "site.bt", "no-such-file", ["site.bt"]),
    ("drone1.gimbal", {"file": "a.mcap", "topic": "/g"}, "bad-value", ["relative_to"]),
    ("clock_reference", "drone4", "bad-value", ["clock_reference: 'drone4'", "'drone"]),
    ("truth.poses", {"dron1": "drone1_true.tum"}, "bad-value", ["truth.poses: 'dron1'", "'drone1'"]),
    ("drone1.frame_times.start", 12.5, "no-overlap", ["frame_times.start: 1699999", "clock: {offset_s"]),
    ("drone1.frame_times", {"fps": 30, "file": "a.csv"}, "bad-value", ["frame_times: has file, fps, "]),
    ("drone1.frame_times", {"start": 0, "file": "a.srt"}, "bad-value", ["frame_times: has file, start, "]),
    ("drone1.keypoints.image_size", [1920, 1200], "wrong-size", ["cameras.drone1.intrinsics", "1920"]),
    ("drone1.clock", {"sigma_s": True}, "bad-value", ["cameras.drone1.clock"]),
    ("drone1.pose_noise", {"white": {"position_m": True}}, "bad-value", ["cameras.drone1.pose_noise"]),
    ("drone1.intrinsics.fx", True, "bad-value", ["cameras.drone1.intrinsics"]),
]


@pytest.mark.parametrize(
    ("key", "value", "code", "names"), USUAL_MISTAKES, ids=lambda each: each if isinstance(each, str) else ""
)
def test_a_usual_mistake_is_one_line_with_its_remedy(
    flight: SyntheticFlight, key: str, value: Any, code: str, names: list[str]
) -> None:
    (flight.manifest.parent / "empty.tum").touch()
    *way, last = key.split(".")
    place: Any = flight.settings["cameras"] if key.startswith("drone1") else flight.settings
    for part in way:
        place = place[part]
    place.pop(last, None) if value is None else place.update({last: value})
    flight.save()
    line = refused("ingest", flight.manifest, code=code)
    assert [name for name in names if name not in line] == []
    assert not flight.manifest.with_suffix(".session").exists()


def test_an_inline_fisheye_without_distortion_is_equidistant(flight: SyntheticFlight, tmp_path: Path) -> None:
    inline = flight.settings["cameras"]["drone1"]["intrinsics"]
    inline.update(model="fisheye", fx=300, cx=640, cy=360)
    del inline["distortion"]
    flight.save()
    succeeds("ingest", flight.manifest)
    lens = read_description(tmp_path / "flight.session").cameras["drone1"].intrinsics
    # 45 degrees to the side: r = f theta, where a pinhole has f tan(theta).
    pixel = project(np.array([1.0, 0.0, 1.0]), lens)
    np.testing.assert_allclose(pixel, [640 + 300 * np.pi / 4, 360])


def test_keypoints_outside_the_calibrated_picture(flight: SyntheticFlight) -> None:
    for name in flight.cameras:
        inline = flight.settings["cameras"][name]["intrinsics"]
        inline.update(width=640, height=360, cx=320, cy=180)
    flight.save()
    line = refused("ingest", flight.manifest)
    assert line.startswith(f"mocap: {flight.manifest}: cameras.drone1.intrinsics: ")
    assert "image_size: [W, H]" in line


def test_a_detector_that_is_none_is_refused_and_one_without_pictures_is_of_no_use(tmp_path: Path) -> None:
    session = write_flight(tmp_path, cameras=2, seconds=0.2).manifest.with_suffix(".session")
    succeeds("ingest", session.with_suffix(".yaml"))
    assert "blazepose" in refused("reconstruct", session, "--detector", "yolo", code="no-such-name")
    done = mocap("reconstruct", session, "--method", "dlt", "--detector", "blazepose-heavy")
    assert "--detector" in done.stderr


def test_when_nothing_is_reconstructed_the_gate_is_named(tmp_path: Path) -> None:
    flight = write_flight(tmp_path, cameras=2, seconds=0.5)
    # Both cameras are said to be in one place: no two viewing lines differ.
    (tmp_path / "drone2.tum").write_bytes((tmp_path / "drone1.tum").read_bytes())
    flight.save()
    succeeds("ingest", flight.manifest)
    line = refused("reconstruct", tmp_path / "flight.session", "--method", "robust")
    assert line.startswith(f"mocap: {tmp_path}/flight.session: ")
    assert "rejected 255" in line
    assert not (tmp_path / "flight.session" / "reconstruct").exists()


def test_session_of_another_flight_is_not_replaced_silently(flight: SyntheticFlight, tmp_path: Path) -> None:
    succeeds("ingest", flight.manifest)
    before = content(tmp_path / "flight.session")
    flight.settings["name"] = "Another flight"
    flight.save()
    assert refused("ingest", flight.manifest).startswith(f"mocap: {tmp_path}/flight.session: ")
    assert content(tmp_path / "flight.session") == before


def test_no_format_opens_a_pipe(tmp_path: Path) -> None:
    signal.alarm(60)  # it would wait without end
    suffixes = sorted({suffix for format_ in FORMATS.all() for suffix in getattr(format_, "suffixes", ())})
    pipes = [tmp_path / f"pipe{suffix}" for suffix in suffixes]
    for pipe in pipes:
        os.mkfifo(pipe)
    assert not [pipe for pipe in pipes if any(each.recognises(pipe) for each in FORMATS.all())]
    signal.alarm(0)
