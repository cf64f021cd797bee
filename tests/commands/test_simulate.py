"""Simulated flights through the commands: results agree with the truth, other programs read the files."""

import json
import re
from pathlib import Path
from typing import Any

import av
import numpy as np
import pandas as pd
import pytest
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader

from pipelines.formats.common.files import read_yaml
from pipelines.formats.videos import video
from pipelines.formats.videos.video_writing import write_h264
from pipelines.session.errors import DataError
from pipelines.session.storage import read_json
from pipelines.simulate import simulate
from tests.commands.runner import content, measured, mocap, refused, result_of, succeeds
from tests.real_data import real_data

EXACT = """
schema: 1
name: Exact
duration_s: 4
actor:
  motion:
    - walk: {distance_m: 3, turn_deg: 60}
    - kick: {run_up_m: 1.5}
drones:
  count: 3
  camera: {shutters: synchronised}
keypoints: {scale: 0, missed_share: 0, outlier_share: 0, swap_share: 0}
"""
SMALL = """
schema: 1
name: Small
duration_s: 2
actor: {motion: [walk: {distance_m: 5}]}
world:
  ground: {size_m: 30}
  mounds: [{centre: [6, 6], sigma_m: [2, 3], height_m: 2}]
  trees: [{position: [-6, 3]}]
  walls: [{start: [-8, -8], end: [8, -8]}]
  map: {resolution_m: 0.5, height_m: 6}
drones:
  count: 2
  camera: {width: 320, height: 180, rate_hz: 30, dropped_share: 0.1}
  pose_noise: {white: {position_m: 0.1, rotation_deg: 0.5}, bias: {position_m: 0.2}}
  clock_offsets_s: [0, 0.12]
"""


TWO = """
schema: 1
name: Two
duration_s: 1
actors:
  anna: {motion: [walk: {distance_m: 5}]}
  ben: {motion: [walk: {distance_m: 5}], start: [0, 4], body: {sex: female, height_m: 1.6}}
world: {ground: {size_m: 40}, map: {resolution_m: 0.5, height_m: 4}}
drones:
  count: 3
  camera: {shutters: synchronised}
  formation: {tilt_deg: 35}
keypoints: {scale: 0, missed_share: 0, outlier_share: 0, swap_share: 0}
"""


SMALLEST = "width: 128, height: 72"


def scenario(folder: Path, text: str) -> Path:
    path = folder / "scenario.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def simulated(folder: Path, text: str, *options: str) -> Path:
    """Simulate a flight and return its flight.yaml."""
    output = folder / "flight"
    succeeds("simulate", scenario(folder, text), "-o", output, *options)
    return output / "flight.yaml"


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Simulate the small flight without videos and return its flight.yaml; tests must not change it."""
    return simulated(tmp_path_factory.mktemp("small"), SMALL, "--no-video")


def reconstructed(flight: Path, *options: str) -> dict[str, Any]:
    succeeds("ingest", flight)
    return measured(flight.with_suffix(".session"), *options)


def test_the_truth_closes(tmp_path: Path) -> None:
    """Allow only the error of linear pose interpolation between 50 Hz stamps: all data are exact."""
    metrics = reconstructed(simulated(tmp_path, EXACT, "--no-video"))
    assert metrics["mpjpe_mm"] < 0.5
    # The field of view holds the person throughout and nothing stands in the way.
    assert metrics["reconstructed_share"] > 0.99


def test_the_same_seed_gives_the_same_bytes_and_another_does_not(small: Path, tmp_path: Path) -> None:
    flights = [content(small.parent)]
    for name, text in {"b": SMALL, "c": SMALL.replace("name", "seed: 2\nname")}.items():
        (tmp_path / name).mkdir()
        flights.append(content(simulated(tmp_path / name, text, "--no-video").parent))
    assert flights[0] == flights[1]
    same = {name for name in flights[0] if flights[0][name] == flights[2][name]}
    # What a seed cannot change: the lens, the map, the offsets, and how the files hang together.
    lenses = {"drone1_camera.yaml", "drone2_camera.yaml"}
    assert same == {
        *lenses,
        *("flight.yaml", "true_poses.yaml", "site.npz", "truth/clocks.json", "truth/body_shape.parquet"),
    }


@pytest.mark.slow
def test_videos_have_the_frames_that_were_kept_and_workers_do_not_matter(tmp_path: Path) -> None:
    text = SMALL.replace("duration_s: 2", "duration_s: 0.5").replace("width: 320, height: 180", SMALLEST)
    flights = []
    for workers in ("1", "2"):
        (tmp_path / workers).mkdir()
        flights.append(simulated(tmp_path / workers, text, "--workers", workers))
    logs = [
        {name: digest for name, digest in content(flight.parent).items() if not name.endswith(".mp4")}
        for flight in flights
    ]
    assert logs[0] == logs[1]

    summary = read_json(flights[0].parent / "simulation.json")
    assert summary["frames"]["drone1"] < 15  # some were dropped
    stated = result_of("ingest", flights[0])
    camera = stated["cameras"]["drone2"]
    assert camera["frames"]["count"] == summary["frames"]["drone2"]
    assert (camera["intrinsics"]["width"], camera["intrinsics"]["height"]) == (128, 72)
    assert stated["simulated"] is True
    assert stated["map"] is not None
    assert stated["actor"] is not None


def test_the_log_is_read_by_the_libraries_that_others_use(small: Path) -> None:
    log = small.parent / "drone1.mcap"
    with log.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    topics = {channel.topic for channel in summary.channels.values()}
    assert topics == {"/drone1/odometry", "/drone1/gimbal", "/drone1/camera/camera_info", "/actor"}
    with AnyReader([log]) as reader:
        stamps = [stamp for _, stamp, _ in reader.messages()]
        odometry = [
            reader.deserialize(data, connection.msgtype)
            for connection, _, data in reader.messages()
            if connection.topic == "/drone1/odometry"
        ]
    assert stamps == sorted(stamps)
    # 50 Hz for two seconds and 0.2 s on either side, give or take the ends.
    assert abs(len(odometry) - 120) <= 2
    covariance = odometry[0].pose.covariance.reshape(6, 6)  # type: ignore[attr-defined]
    # White 0.1 m and bias 0.2 m are the camera's; the lever arm adds what 0.5 deg does to 0.11 m.
    assert np.sqrt(np.diag(covariance)[:3]) == pytest.approx(np.hypot(0.1, 0.2), rel=1e-3)


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The flight.yaml of two people's flight without videos, to look at and not to change."""
    return simulated(tmp_path_factory.mktemp("two"), TWO, "--no-video")


def test_every_person_is_in_the_truth_the_keypoints_and_the_log(two: Path) -> None:
    folder = two.parent
    assert read_json(folder / "truth" / "people.json") == {"people": ["anna", "ben"]}
    truth = pd.read_csv(folder / "truth" / "joints.csv")
    assert truth.groupby("t_ns").size().eq(2 * 17).all()
    hip = truth[truth["joint"] == "left_hip"]
    north = hip.groupby("person")["y"].mean()
    assert north.to_dict() == {0: pytest.approx(0, abs=0.3), 1: pytest.approx(4, abs=0.3)}
    shown = pd.read_csv(folder / "truth" / "drone1_visible.csv")
    assert shown.groupby("frame")["person"].apply(list).tolist() == [[0, 1]] * 30
    found = json.loads((folder / "drone1_keypoints.json").read_text())
    assert {entry["idx"] for entry in found} == {1, 2}

    with AnyReader([folder / "drone1.mcap"]) as reader:
        logged = {
            connection.topic: reader.deserialize(data, connection.msgtype).pose.pose.position.y  # type: ignore[attr-defined]
            for connection, _, data in reader.messages()
            if connection.topic.startswith("/actor")
        }
    # Estimates err by 0.2 m; the second walks 4 m north of the first.
    assert logged == {"/actor/anna": pytest.approx(0, abs=1), "/actor/ben": pytest.approx(4, abs=1)}
    assert read_yaml(two)["actors"] == {
        name: {"file": "drone1", "topic": f"/actor/{name}", "point": "hip"} for name in ("anna", "ben")
    }
    assert list(result_of("info", folder / "scenario.yaml")["readings"][0]["actors"]) == ["anna", "ben"]


def test_everybody_reconstructed_is_compared_with_their_own_truth(tmp_path: Path) -> None:
    """As exact as one person alone, whoever is named first: that one is the logged actor, and person 0."""
    anna, ben = (line for line in TWO.splitlines(keepends=True) if line.startswith(("  anna", "  ben")))
    flight = simulated(tmp_path, TWO.replace(anna + ben, ben + anna), "--no-video")
    session = tmp_path / "two.session"
    succeeds("ingest", flight, "-o", session)
    truth = pd.read_parquet(session / "truth.parquet")
    actor = truth[(truth["person"] == 0) & (truth["joint"] == "left_hip")]
    metrics = measured(session, "--persons", "2")
    assert metrics["joint_frames"] == 2 * 30 * 17
    assert metrics["mpjpe_mm"] < 0.5
    assert metrics["reconstructed_share"] > 0.97
    found = pd.read_parquet(session / "reconstruct" / "skeleton.parquet")
    hip = found[(found["person"] == 0) & (found["joint"] == "left_hip") & (found["status"] == "ok")]
    # People walk 4 m from each other, and the logged actor errs by 0.2 m.
    assert np.abs(np.interp(hip["t_ns"], actor["t_ns"], actor["y"]) - hip["y"]).max() < 0.1


def test_a_flight_that_is_there_is_not_made_again(tmp_path: Path) -> None:
    flight = simulated(tmp_path, SMALL, "--no-video")
    written = flight.stat().st_mtime_ns
    assert "unchanged" in succeeds("simulate", tmp_path / "scenario.yaml", "-o", flight.parent, "--no-video")
    assert flight.stat().st_mtime_ns == written
    succeeds("simulate", tmp_path / "scenario.yaml", "-o", flight.parent, "--no-video", "--force")
    assert flight.stat().st_mtime_ns > written
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").write_text("")
    line = refused("simulate", tmp_path / "scenario.yaml", "-o", tmp_path / "mine", "--no-video")
    assert "thesis.tex" in line
    assert "--overwrite" in line


def test_an_interrupted_rendering_goes_on_where_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = SMALL.replace("duration_s: 2", "duration_s: 0.6").replace("width: 320, height: 180", SMALLEST)
    path = scenario(tmp_path, text.replace("count: 2", "count: 1").replace("[0, 0.12]", "[0]"))
    output, parts = tmp_path / "flight", tmp_path / ".flight.making"
    command = ("simulate", path, "-o", output, "--workers", "1")

    def interrupted(part: Path, *arguments: Any, **options: Any) -> None:
        if list(parts.glob("*/drone1-0/part.mp4")):
            raise KeyboardInterrupt
        write_h264(part, *arguments, **options)

    monkeypatch.setattr("pipelines.simulate._BLOCK", 10)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("pipelines.simulate.write_h264", interrupted)
        assert mocap(*command).returncode == 130
    assert not output.exists()
    # Black pictures in the place of the finished part show that it is not made again.
    (kept,) = parts.glob("*/drone1-0/part.mp4")
    stamps = video.FORMAT.index(kept).pts_ns
    black = (np.zeros((72, 128, 3), np.uint8) for _ in stamps)
    write_h264(kept, black, stamps, width=128, height=72)

    succeeds(*command)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["flight", "scenario.yaml"]
    with av.open(str(output / "drone1.mp4")) as container:
        brightness = [frame.to_ndarray(format="gray").mean() for frame in container.decode(video=0)]
    assert max(brightness[: len(stamps)]) < 20 < min(brightness[len(stamps) :])
    assert len(brightness) == read_json(output / "simulation.json")["frames"]["drone1"]


@pytest.mark.parametrize("name", ["cmu_10_01_soccer_kick"])
def test_recorded_motion_is_flown_around(tmp_path: Path, name: str) -> None:
    recording = real_data(f"motion/{name}.bvh")
    text = EXACT.replace("duration_s: 4", "duration_s: 2")
    begin, end = text.index("  motion:"), text.index("drones:")
    metrics = reconstructed(
        simulated(tmp_path, f"{text[:begin]}  motion: {{bvh: {recording}}}\n{text[end:]}", "--no-video")
    )
    # Exact again, whoever moves: pictures are taken together, so that even a kick is not interpolated.
    assert metrics["mpjpe_mm"] < 0.5
    assert metrics["reconstructed_share"] > 0.99


HOSTILE = {
    "negative size": ("size_m: 30", "size_m: -30", "world.ground.size_m"),
    "a billion voxels": ("resolution_m: 0.5", "resolution_m: 0.011", "voxels"),
    "unknown motion": ("walk: {distance_m: 5}", "moonwalk: {distance_m: 5}", "walk"),
    "unknown key": ("duration_s: 2", "duration_s: 2\nwind_mps: 5", "wind_mps"),
    "no number": ("duration_s: 2", "duration_s: .nan", "duration_s"),
    "unknown noise": ("white:", "pink:", "pink"),
    "unknown planner": ("count: 2", "count: 2\n  formation: {planner: magic}", "magic"),
    "a wood too dense": ("walls:", "wood: {count: 2000, radius_m: 3}\n  walls:", "wood"),
    "more offsets than drones": ("[0, 0.12]", "[0, 0.12, 0.3]", "clock_offsets_s"),
    "nobody": ("actor: {motion: [walk: {distance_m: 5}]}\n", "", "actors"),
    "newer schema": ("schema: 1", "schema: 3", "schema"),
    "an exposure longer than a picture": ("rate_hz: 30", "rate_hz: 30, exposure_ms: 34", "exposure_ms"),
    "a lens that misses the corners": (
        "rate_hz: 30",
        "rate_hz: 30, distortion: [-0.4, 0, 0, 0]",
        "distortion",
    ),
    "a flight shorter than a picture": ("duration_s: 2", "duration_s: 0.001", "duration_s"),
    "before the epoch": ("duration_s: 2", "duration_s: 2\nstart: 0", "start"),
    "a BVH that is not there": ("[walk: {distance_m: 5}]", "{bvh: dance.bvh}", "dance.bvh"),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_hostile_scenarios_get_one_line(tmp_path: Path, case: str) -> None:
    old, new, said = HOSTILE[case]
    assert old in SMALL
    path = scenario(tmp_path, SMALL.replace(old, new))
    with pytest.raises(DataError) as refusal:
        simulate(path, tmp_path / "flight", video=False)
    assert said in str(refusal.value)
    assert "\n" not in str(refusal.value)
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["scenario.yaml"]


def test_what_the_camera_does_is_stated_where_it_is_read(tmp_path: Path) -> None:
    distortion = [-0.132, 0.111, 0.0, 0.0, -0.016]
    shot = f"rate_hz: 30, exposure_ms: 2, distortion: {distortion}, readout_ms: 20, bitrate_mbps: 0.5"
    flight = simulated(tmp_path, SMALL.replace("rate_hz: 30", shot), "--no-video")
    said = result_of("ingest", flight)
    for camera in said["cameras"].values():
        assert camera["intrinsics"]["model"] == "radtan"
        assert camera["intrinsics"]["distortion"] == distortion
        assert camera["intrinsics"]["readout_s"] == pytest.approx(0.02)
    with AnyReader([flight.parent / "drone1.mcap"]) as reader:
        infos = [
            reader.deserialize(data, connection.msgtype)
            for connection, _, data in reader.messages()
            if connection.topic == "/drone1/camera/camera_info"
        ]
    assert list(infos[0].d) == distortion  # type: ignore[attr-defined]
    assert re.search(r"# .* 2 ms, .* 20 ms, 0\.5 Mbit/s", flight.read_text())
