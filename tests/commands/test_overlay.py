"""`mocap export --to overlay`: the skeleton is drawn where geometry predicts, on every picture."""

import json
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from numpy.typing import NDArray

from pipelines.export import export
from pipelines.formats.videos.video import FORMAT, VideoReader
from pipelines.formats.videos.video_writing import write_h264
from pipelines.geometry.poses import conjugate, rotate
from pipelines.ingest import ingest
from pipelines.reconstruct import ReconstructSettings, reconstruct
from pipelines.reporting.pictures import SIDES
from pipelines.session.errors import DataError
from pipelines.session.storage import read_json, write_json
from tests.commands.runner import as_if_written
from tests.synthetic.flights import LENS, START_NS, SyntheticFlight, film_at, write_flight

GREY = 150  # of the flight's own pictures
FRAMES = 12
STEPS_NS = np.array([0, 33, 67, 100, 133, 150, 217, 250, 283, 317, 350, 400]) * 1_000_000


class Notes:
    """Progress that keeps its notes."""

    def __init__(self) -> None:
        self.kept: list[str] = []

    def start(self, _: str, total: int) -> None: ...

    def advance(self, steps: int = 1) -> None: ...

    def note(self, message: str) -> None:
        self.kept.append(message)


def filmed_flight(folder: Path) -> SyntheticFlight:
    """Write a clean flight of 0.4 s with grey videos; drone2 has an uneven rate and other times."""
    flight = write_flight(folder, seconds=FRAMES / 30, clean=True)
    film_at(flight, "drone2", START_NS + STEPS_NS)
    for name, pts_ns in (("drone1", flight.t_ns - START_NS), ("drone2", STEPS_NS)):
        plain = np.full((LENS.height, LENS.width, 3), GREY, np.uint8)
        write_h264(folder / f"{name}.mp4", [plain] * FRAMES, pts_ns, width=LENS.width, height=LENS.height)
        flight.settings["cameras"][name] |= {
            "video": f"{name}.mp4",
            "frame_times": {"start": START_NS // 10**9},
        }
    flight.save()
    return flight


@pytest.fixture(scope="module")
def filmed(tmp_path_factory: pytest.TempPathFactory) -> tuple[SyntheticFlight, Path]:
    flight = filmed_flight(tmp_path_factory.mktemp("filmed"))
    return flight, session_of(flight)


def session_of(flight: SyntheticFlight) -> Path:
    session = flight.manifest.with_name("flight.session")
    ingest(flight.manifest, session)
    reconstruct(session, ReconstructSettings(method="robust"))
    return session


@pytest.fixture
def session(filmed: tuple[SyntheticFlight, Path], tmp_path: Path) -> Path:
    """Copy the session, with its videos beside it."""
    shutil.copytree(filmed[1].parent, tmp_path / "copy")
    return tmp_path / "copy" / "flight.session"


def drawn(session: Path, name: str, to: str = "overlay") -> list[NDArray[np.uint8]]:
    """Export the overlays and decode that of one camera."""
    result = export(session, [to], overwrite=True)
    videos = {path.name: path for path in (*result.written, *result.unchanged)}
    with VideoReader(videos[f"{name}.overlay.mp4"]) as reader:
        return [picture for _, picture in reader.frames()]


def true_pixels(flight: SyntheticFlight, name: str) -> NDArray[np.float64]:
    """Read the true pixels [F, J, 2] of the joints from the flight's clean keypoints."""
    people = json.loads((flight.manifest.parent / f"{name}.json").read_text(encoding="utf-8"))
    return np.array([person["keypoints"] for person in people]).reshape(FRAMES, -1, 3)[..., :2]


def is_near(picture: NDArray[np.uint8], pixel: NDArray[np.float64], joint: str) -> bool:
    """Test if a pixel within 2 px is nearer to the joint's colour than to any other one drawn."""
    x, y = np.round(pixel).astype(int)
    part = picture[y - 2 : y + 3, x - 2 : x + 3].reshape(-1, 3).astype(float)
    colour = SIDES[joint.partition("_")[0] if "_" in joint else ""]
    others = np.array([*SIDES.values(), (GREY,) * 3, (0, 0, 0)], float)
    nearest = others[np.linalg.norm(part[:, None] - others, axis=2).argmin(axis=1)]
    return bool((nearest == colour).all(axis=1).any())


def alone(pixels: NDArray[np.float64], joint: int) -> bool:
    """Test if no other joint's dot, of 3 px, can cover this one."""
    apart = np.linalg.norm(pixels - pixels[joint], axis=-1)
    return bool((np.delete(apart, joint) > 7).all())


def test_joints_are_drawn_where_they_are_seen_in_every_picture(
    filmed: tuple[SyntheticFlight, Path], session: Path
) -> None:
    flight, _ = filmed
    result = export(session, ["overlay"])
    assert [path.name for path in result.written] == ["drone1.overlay.mp4", "drone2.overlay.mp4"]
    for video, stamps in zip(result.written, (flight.t_ns - START_NS, STEPS_NS), strict=True):
        index = FORMAT.index(video)
        assert np.abs(index.pts_ns - stamps).max() <= 12_000  # a tick of 1/90000 s
        assert (index.width, index.height) == (LENS.width, LENS.height)
        name = video.name.partition(".")[0]
        with VideoReader(video) as reader:
            pictures = [picture for _, picture in reader.frames()]
        # The skeleton's last time is drone1's last picture; drone2's is later.
        last, checked = FRAMES if name == "drone1" else FRAMES - 1, 0
        for picture, pixels in zip(pictures[:last], true_pixels(flight, name)[:last], strict=True):
            for joint, word in enumerate(flight.joints):
                if alone(pixels, joint):
                    assert is_near(picture, pixels[joint], word)
                    checked += 1
            beside = np.ones(picture.shape[:2], bool)
            beside[:80] = False  # the caption
            left, upper, right, lower = np.round([*pixels.min(0) - 20, *pixels.max(0) + 20]).astype(int)
            beside[max(upper, 0) : lower, max(left, 0) : right] = False
            # Every mark differs from the ground by 79 levels at least in one colour; coding does by a few.
            assert np.abs(picture[beside].astype(int) - GREY).max() < 79 / 2
        assert checked > 8 * last


def test_refined_poses_and_estimated_clocks_move_the_skeleton(
    filmed: tuple[SyntheticFlight, Path], session: Path
) -> None:
    flight, _ = filmed
    poses = pd.read_parquet(session / "cameras" / "drone1" / "poses.parquet").assign(camera="drone1")
    # A camera 0.4 m further right sees everything that many metres further left.
    poses[["x", "y", "z"]] += rotate(poses[["qx", "qy", "qz", "qw"]].to_numpy(), np.array([0.4, 0.0, 0.0]))
    poses.to_parquet(session / "reconstruct" / "cameras.parquet", index=False)
    as_if_written(session, "reconstruct/cameras.parquet", "reconstruct")
    metrics = read_json(session / "reconstruct" / "metrics.json")
    # Pictures of drone2 were taken 0.2 s after their stamps.
    write_json(session / "reconstruct" / "metrics.json", {**metrics, "clock_offsets_s": {"drone2": 0.2}})
    as_if_written(session, "reconstruct/metrics.json", "reconstruct")
    picture = drawn(session, "drone1")[3]
    depth = rotate(
        conjugate(flight.camera_quaternion[0, 3]), flight.position[3] - flight.camera_position[0, 3]
    )
    left = np.column_stack([0.4 * LENS.fx / depth[:, 2], np.zeros(len(depth))])
    for side in ("left", "right"):
        # Distortion changes by less than a pixel over so small a way.
        joint = flight.joints.index(f"{side}_knee")
        assert is_near(picture, (true_pixels(flight, "drone1")[3] - left)[joint], f"{side}_knee")
    picture, pixels = drawn(session, "drone2")[4], true_pixels(flight, "drone2")
    between = pixels[9] + (333 - 317) / (350 - 317) * (pixels[10] - pixels[9])  # picture 4 is at 133 ms
    moved = np.linalg.norm(between - pixels[4], axis=-1) > 8  # a dot and the search around it: 5
    there = [joint for joint in np.flatnonzero(moved).tolist() if alone(between, joint)]
    assert there
    assert all(is_near(picture, between[joint], flight.joints[joint]) for joint in there)


def test_pictures_that_are_gone_or_others_and_no_skeleton(session: Path) -> None:
    run = json.loads((session / "run.json").read_text())
    (session / "run.json").write_text(json.dumps(run | {"folder": str(session)}))  # as if ingested here
    (session.parent / "drone1.mp4").unlink()
    notes = Notes()
    (video,) = export(session, ["overlay"], progress=notes).written
    assert video.name == "drone2.overlay.mp4"
    assert any("drone1.mp4" in note for note in notes.kept)
    (session.parent / "drone2.mp4").write_bytes(b"no video at all")
    with pytest.raises(DataError) as error:
        export(session, ["overlay"])
    assert Path(error.value.source).name == "drone2.mp4"
    (session.parent / "drone2.mp4").unlink()
    with pytest.raises(DataError, match=r"flight\.yaml"):
        export(session, ["overlay"])
    shutil.rmtree(session / "reconstruct")
    with pytest.raises(DataError, match="mocap reconstruct"):
        export(session, ["overlay"])
