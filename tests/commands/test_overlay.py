"""Overlay videos: the skeleton is drawn where geometry predicts, on every picture, at its own time."""

from __future__ import annotations

import hashlib
import json
import re
import shutil
from pathlib import Path
from typing import Any

import click
import numpy as np
import pandas as pd
import pytest
from numpy.typing import NDArray

import pipelines.overlay
from mocap_cli.reconstruct import reconstruct_command
from pipelines.formats.videos.video import VideoReader, index_video
from pipelines.formats.videos.video_writing import write_h264
from pipelines.geometry.poses import conjugate, rotate
from pipelines.ingest import ingest
from pipelines.overlay import write_overlays
from pipelines.reconstruct import Settings, reconstruct
from pipelines.report import report
from pipelines.reporting.frame_drawing import GREY as BLANK
from pipelines.reporting.frame_drawing import SIDES
from pipelines.session.errors import DataError
from pipelines.session.storage import read_json, write_json
from tests.commands.runner import as_if_written, refused, succeeds
from tests.synthetic.flights import LENS, START_NS, SyntheticFlight, film_at, write_flight
from tests.synthetic.logged_flights import write_logged_flight

GREY = 150  # of the flight's own pictures
FRAMES = 12
STEPS_NS = np.array([0, 33, 67, 100, 133, 150, 217, 250, 283, 317, 350, 400]) * 1_000_000


class Watcher:
    """Progress that records notes, and can interrupt the work."""

    def __init__(self, stop_after: int | None = None) -> None:
        self.notes: list[str] = []
        self.steps = 0
        self.total = 0
        self._stop_after = stop_after

    def start(self, _: str, total: int) -> None:
        self.total = total

    def advance(self, steps: int = 1) -> None:
        self.steps += steps
        if self.steps == self._stop_after:
            raise KeyboardInterrupt

    def note(self, message: str) -> None:
        self.notes.append(message)


def filmed_flight(folder: Path) -> SyntheticFlight:
    """Write a clean flight of 0.4 s with plain grey videos; drone2 has an uneven rate and other times."""
    flight = write_flight(folder, seconds=FRAMES / 30, clean=True)
    film_at(flight, "drone2", START_NS + STEPS_NS)
    stamps = {"drone1": flight.t_ns - START_NS, "drone2": STEPS_NS}
    for name, pts_ns in stamps.items():
        plain = np.full((LENS.height, LENS.width, 3), GREY, np.uint8)
        write_h264(folder / f"{name}.mp4", [plain] * FRAMES, pts_ns, width=LENS.width, height=LENS.height)
        camera = flight.settings["cameras"][name]
        camera["video"] = f"{name}.mp4"
        camera["frame_times"] = {"start": START_NS // 10**9}
    flight.save()
    return flight


def session_of(flight: SyntheticFlight) -> Path:
    session = flight.manifest.parent / "flight.session"
    ingest(flight.manifest, session)
    reconstruct(session, Settings(method="robust"))
    return session


@pytest.fixture(scope="module")
def filmed(tmp_path_factory: pytest.TempPathFactory) -> tuple[SyntheticFlight, Path]:
    flight = filmed_flight(tmp_path_factory.mktemp("filmed"))
    return flight, session_of(flight)


@pytest.fixture
def session(filmed: tuple[SyntheticFlight, Path], tmp_path: Path) -> Path:
    """Copy a reconstructed session, with its videos beside it."""
    flight, _ = filmed
    shutil.copytree(flight.manifest.parent, tmp_path / "copy")
    return tmp_path / "copy" / "flight.session"


def summary(session: Path) -> dict[str, Any]:
    return read_json(session / "overlay" / "stage.json")["counts"]  # type: ignore[no-any-return]


def is_near(picture: NDArray[np.uint8], pixel: NDArray[np.float64], colour: tuple[int, ...]) -> bool:
    """Test if a pixel within 2 px is nearer to a colour than to the ground or to another side's colour."""
    x, y = np.round(pixel).astype(int)
    part = picture[y - 2 : y + 3, x - 2 : x + 3].reshape(-1, 3).astype(float)
    others = np.array([*SIDES.values(), (GREY,) * 3, (0, 0, 0)], float)
    nearest = others[np.linalg.norm(part[:, None] - others, axis=2).argmin(axis=1)]
    return bool((nearest == colour).all(axis=1).any())


def true_pixels(flight: SyntheticFlight, name: str) -> NDArray[np.float64]:
    """Read the true pixels [F, J, 2] of the joints from the flight's clean keypoints."""
    people = json.loads((flight.manifest.parent / f"{name}.json").read_text(encoding="utf-8"))
    return np.array([person["keypoints"] for person in people]).reshape(FRAMES, -1, 3)[..., :2]


def decoded(path: Path) -> list[NDArray[np.uint8]]:
    with VideoReader(path) as reader:
        return [picture for _, picture in reader.frames()]


def side_colour(joint: str) -> tuple[int, int, int]:
    return SIDES[joint.partition("_")[0] if "_" in joint else ""]


def alone(pixels: NDArray[np.float64], joint: int) -> bool:
    """Test if no other joint's dot, of 3 px, can cover this one."""
    apart = np.linalg.norm(pixels - pixels[joint], axis=-1)
    return bool((np.delete(apart, joint) > 7).all())


@pytest.mark.parametrize("name", ["drone1", "drone2"])
def test_joints_are_drawn_where_they_are_seen_in_every_picture(
    filmed: tuple[SyntheticFlight, Path], session: Path, name: str
) -> None:
    flight, _ = filmed
    (video,) = write_overlays(session, cameras=[name])
    pictures = decoded(video)
    checked = 0
    # The skeleton's last time is drone1's last picture; drone2's is later.
    last = FRAMES if name == "drone1" else FRAMES - 1
    for picture, pixels in zip(pictures[:last], true_pixels(flight, name)[:last], strict=True):
        for joint, word in enumerate(flight.joints):
            if alone(pixels, joint):
                assert is_near(picture, pixels[joint], side_colour(word))
                checked += 1
        person = pixels.min(axis=0) - 20, pixels.max(axis=0) + 20
        beside = np.ones(picture.shape[:2], bool)
        beside[:80] = False  # the caption
        (left, upper), (right, lower) = np.round(person).astype(int)
        beside[max(upper, 0) : lower, max(left, 0) : right] = False
        # Every mark differs from the ground by 79 levels at least in one colour; coding does by a few.
        assert np.abs(picture[beside].astype(int) - GREY).max() < 79 / 2
    assert checked > 8 * last


def test_frames_and_stamps_are_those_of_the_pictures(session: Path) -> None:
    videos = write_overlays(session, workers=2)
    assert [video.name for video in videos] == ["drone1.mp4", "drone2.mp4"]
    for video in videos:
        source, drawn = index_video(session.parent / video.name), index_video(video)
        assert drawn.pts_ns.tolist() == source.pts_ns.tolist()
        assert (drawn.width, drawn.height) == (source.width, source.height)
    counts = summary(session)["cameras"]
    assert counts["drone2"] == {"frames": FRAMES, "undecoded": 0, "without_pose": 0}
    assert {path.name for path in session.iterdir() if "overlay" in path.name} == {"overlay"}


def test_a_span_begins_at_its_own_first_picture(session: Path) -> None:
    video = write_overlays(session, start_s=0.1, end_s=0.25)[1]
    wanted = (STEPS_NS >= 100_000_000) & (STEPS_NS < 250_000_000)
    expected = STEPS_NS[wanted] - STEPS_NS[wanted][0]
    assert np.abs(index_video(video).pts_ns - expected).max() <= 12_000  # one tick of 1/90000 s
    with pytest.raises(DataError, match="span") as error:
        write_overlays(session, start_s=100.0)
    assert error.value.source == session
    assert video.exists()


def test_unchanged_videos_are_not_made_again_and_another_skeleton_replaces_them(session: Path) -> None:
    videos = write_overlays(session)
    before = videos[0].stat().st_mtime_ns
    watcher = Watcher()
    assert write_overlays(session, progress=watcher) == videos
    assert (watcher.total, videos[0].stat().st_mtime_ns) == (0, before)
    videos[1].unlink()
    write_overlays(session, progress=watcher)
    assert watcher.steps == 2 * FRAMES
    assert summary(session)["method"] == "robust"
    replacing = Watcher()
    reconstruct(session, Settings(method="dlt"), progress=replacing)
    assert [note for note in replacing.notes if "overlay/" in note]
    assert not (session / "overlay").exists()
    write_overlays(session)
    assert summary(session)["method"] == "dlt"


def test_blocks_that_were_drawn_outlive_an_interrupt(session: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    undisturbed = [decoded(video) for video in write_overlays(session)]
    shutil.rmtree(session / "overlay")
    monkeypatch.setattr(pipelines.overlay, "_BLOCK", 5)
    with pytest.raises(KeyboardInterrupt):
        write_overlays(session, progress=Watcher(stop_after=13))  # 5 + 5 + 2 of drone1, 1 of drone2
    assert not (session / "overlay").exists()
    watcher = Watcher()
    videos = write_overlays(session, progress=watcher)
    assert watcher.steps == FRAMES
    assert [index_video(video).count for video in videos] == [FRAMES, FRAMES]
    for video, pictures in zip(videos, undisturbed, strict=True):
        for one, other in zip(decoded(video), pictures, strict=True):
            # Other key frames, other losses; a skeleton at another place would differ by over 30 at once.
            assert np.abs(one.astype(int) - other).mean() < 0.5
    assert not (session / ".partial").exists()


def test_refined_poses_take_the_place_of_the_logs(
    filmed: tuple[SyntheticFlight, Path], session: Path
) -> None:
    flight, _ = filmed
    poses = pd.read_parquet(session / "cameras" / "drone1" / "poses.parquet")
    poses["camera"] = "drone1"
    # A camera 0.4 m further right sees everything that many metres further left.
    poses[["x", "y", "z"]] += rotate(poses[["qx", "qy", "qz", "qw"]].to_numpy(), np.array([0.4, 0.0, 0.0]))
    poses.to_parquet(session / "reconstruct" / "cameras.parquet", index=False)
    as_if_written(session, "reconstruct/cameras.parquet", "reconstruct")
    picture = decoded(write_overlays(session, cameras=["drone1"])[0])[3]
    body = flight.position[3] - flight.camera_position[0, 3]
    depth = rotate(conjugate(flight.camera_quaternion[0, 3]), body)[:, 2]
    pixels = true_pixels(flight, "drone1")[3] - np.column_stack([0.4 * LENS.fx / depth, np.zeros_like(depth)])
    # Distortion changes by less than a pixel over so small a way.
    knees = [flight.joints.index(f"{side}_knee") for side in ("left", "right")]
    for joint, side in zip(knees, ("left", "right"), strict=True):
        assert is_near(picture, pixels[joint], SIDES[side])


def test_pictures_that_cannot_be_decoded_are_grey_and_counted(
    session: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read = VideoReader.read
    monkeypatch.setattr(
        VideoReader, "read", lambda self, number: None if number in {0, 4} else read(self, number)
    )
    watcher = Watcher()
    (video,) = write_overlays(session, cameras=["drone1"], progress=watcher)
    assert summary(session)["cameras"]["drone1"]["undecoded"] == 2
    assert any(re.match(rf"drone1: 2\b.*\b{FRAMES}\b", note) for note in watcher.notes)
    corner = [picture[-50:, -50:].mean() for picture in decoded(video)]
    blank = [level < (BLANK + GREY) / 2 for level in corner]
    assert blank == [number in {0, 4} for number in range(FRAMES)]


def test_odd_pictures_of_a_log(tmp_path: Path) -> None:
    flight = write_logged_flight(tmp_path, "ros2-mcap", picture_size=(1279, 719))
    videos = write_overlays(session_of(flight))
    for video in videos:
        drawn = index_video(video)
        assert (drawn.width, drawn.height, drawn.count) == (1280, 720, len(flight.t_ns))
        # The log's stamps, on the grid of the video.
        assert np.abs(drawn.pts_ns - (flight.t_ns - flight.t_ns[0])).max() <= 12_000


def test_a_video_that_is_gone_costs_its_own_overlay(session: Path) -> None:
    gone = session.parent / "drone1.mp4"
    gone.unlink()
    watcher = Watcher()
    assert [video.name for video in write_overlays(session, progress=watcher)] == ["drone2.mp4"]
    assert any(str(gone) in note for note in watcher.notes)
    again = Watcher()
    write_overlays(session, progress=again)
    assert again.total == 0
    with pytest.raises(DataError, match=r"pictures.*\bdrone1\b") as error:
        write_overlays(session, cameras=["drone1"])
    assert error.value.source == gone
    (session.parent / "drone2.mp4").unlink()
    shutil.rmtree(session / "overlay")
    with pytest.raises(DataError, match=r"drone1\.mp4"):
        write_overlays(session)
    assert not (session / "overlay").exists()


def test_videos_outlive_the_pictures_they_were_made_of(session: Path) -> None:
    videos = write_overlays(session)
    (session.parent / "drone1.mp4").unlink()
    assert write_overlays(session) == videos
    assert all(video.exists() for video in videos)


def test_a_damaged_video_is_named(session: Path) -> None:
    (session.parent / "drone1.mp4").write_bytes(b"no video at all")
    with pytest.raises(DataError, match=r"drone1\.mp4"):
        write_overlays(session)
    assert not (session / "overlay").exists()


def test_what_has_no_pictures_or_no_skeleton_says_so(tmp_path: Path) -> None:
    flight = write_flight(tmp_path, seconds=0.3)
    session = session_of(flight)
    with pytest.raises(DataError, match=r"\bvideo\b") as error:
        write_overlays(session)
    assert error.value.source == session
    with pytest.raises(DataError, match=r"\bvideo\b") as error:
        write_overlays(session, cameras=["drone1"])
    assert error.value.source == "drone1"
    with pytest.raises(DataError, match=r"\bdrone1, drone2\b") as error:
        write_overlays(session, cameras=["drone9"])
    assert error.value.source == "drone9"
    shutil.rmtree(session / "reconstruct")
    with pytest.raises(DataError, match="`mocap reconstruct`") as error:
        write_overlays(session)
    assert error.value.source == session


def test_the_command_refuses_before_it_reconstructs(session: Path, tmp_path: Path) -> None:
    flight = write_flight(tmp_path / "keypoints", seconds=0.3)
    succeeds("ingest", flight.manifest)
    unseen = flight.manifest.with_suffix(".session")
    assert re.search(
        rf"{unseen.name}: .*pictures.*flight\.yaml",
        refused("reconstruct", unseen, "--method", "robust", "--overlay"),
    )
    assert not (unseen / "reconstruct").exists()
    shutil.rmtree(session / "reconstruct")
    (session / "overlay").mkdir()
    assert re.search(
        r"\boverlay: .*--force", refused("reconstruct", session, "--method", "robust", "--overlay")
    )
    (session / "overlay").rmdir()
    for name in ("drone1", "drone2"):
        (session.parent / f"{name}.mp4").unlink()
    assert re.search(
        r"drone1\.mp4: .*pictures.*\bdrone1\b",
        refused("reconstruct", session, "--method", "robust", "--overlay"),
    )
    assert not (session / "reconstruct").exists()


def test_an_angle_is_written_beside_its_joint(filmed: tuple[SyntheticFlight, Path], session: Path) -> None:
    flight, _ = filmed
    bare = decoded(write_overlays(session, cameras=["drone1"])[0])
    shown = decoded(write_overlays(session, cameras=["drone1"], angles=["left_knee_flexion"])[0])
    knee = flight.joints.index("left_knee")
    for before, after, pixels in zip(bare, shown, true_pixels(flight, "drone1"), strict=True):
        rows, columns = np.nonzero(np.abs(before.astype(int) - after).max(axis=-1) > 60)
        assert len(rows) > 500
        assert abs(np.median(rows) - pixels[knee, 1]) < 15
        assert abs(np.median(columns) - pixels[knee, 0]) < 400


@pytest.mark.parametrize(
    ("given", "meant"),
    [
        (["--overlay", "SESSION"], ("",)),
        (["--overlay", "angle:left_knee", "SESSION", "--overlay"], ("left_knee_flexion", "")),
        (["SESSION", "--overlay=angle:right_shoulder"], ("right_shoulder_elevation",)),
        (["--", "SESSION"], ()),
    ],
)
def test_an_overlay_needs_no_value(tmp_path: Path, given: list[str], meant: tuple[str, ...]) -> None:
    arguments = [word.replace("SESSION", str(tmp_path)) for word in given]
    assert reconstruct_command.make_context("reconstruct", arguments).params["overlays"] == meant


def test_an_angle_that_is_none_is_a_usage_error(tmp_path: Path) -> None:
    with pytest.raises(click.BadParameter, match="left_knee_flexion"):
        reconstruct_command.make_context("reconstruct", [str(tmp_path), "--overlay", "angle:left_nose"])


def test_somebody_elses_folder_is_not_replaced(session: Path) -> None:
    (session / "overlay").mkdir()
    mine = session / "overlay" / "mine.txt"
    mine.write_text("mine")
    with pytest.raises(DataError, match="--force") as error:
        write_overlays(session)
    assert error.value.source == session / "overlay"
    assert mine.exists()
    write_overlays(session, force=True)
    assert not mine.exists()


def test_the_stages_of_a_session_do_not_mind_its_videos(session: Path) -> None:
    videos = write_overlays(session)
    before = [hashlib.sha256(video.read_bytes()).hexdigest() for video in videos]
    manifest = session.parent / "flight.yaml"
    assert ingest(manifest, session).skipped
    assert reconstruct(session, Settings(method="robust")).skipped
    report(session)
    ingest(manifest, session, force=True)
    reconstruct(session, Settings(method="robust"), force=True)
    assert not report(session, force=True).skipped
    assert [hashlib.sha256(video.read_bytes()).hexdigest() for video in videos] == before
    # The same skeleton from the same files: the videos are still its own.
    watcher = Watcher()
    write_overlays(session, progress=watcher)
    assert watcher.total == 0


def test_estimated_clocks_move_the_skeleton_along(
    filmed: tuple[SyntheticFlight, Path], session: Path
) -> None:
    flight, _ = filmed
    metrics = read_json(session / "reconstruct" / "metrics.json")
    # Picture k was taken at the time that picture k + 6 states.
    write_json(session / "reconstruct" / "metrics.json", {**metrics, "clock_offsets_s": {"drone1": 0.2}})
    as_if_written(session, "reconstruct/metrics.json", "reconstruct")
    picture = decoded(write_overlays(session, cameras=["drone1"])[0])[4]
    pixels = true_pixels(flight, "drone1")
    moved = np.linalg.norm(pixels[10] - pixels[4], axis=-1) > 8  # a dot and the search around it: 5
    there = [joint for joint in np.flatnonzero(moved).tolist() if alone(pixels[10], joint)]
    assert there
    assert all(is_near(picture, pixels[10, joint], side_colour(flight.joints[joint])) for joint in there)
