"""Stage `background`: what it keeps, what it depends on, and the binding of its blocks."""

from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pytest

from pipelines import detect
from pipelines.detect import follow
from pipelines.geometry.arrays import Picture
from pipelines.reconstruction.background_tracks import load_stills, load_tracks
from pipelines.reconstruction.loading import load_cameras
from pipelines.session.description import read_description
from pipelines.session.stages import locked
from tests.commands.runner import succeeds
from tests.synthetic.flights import LENS, write_flight
from tests.synthetic.videos import even_ticks, write_video

FRAMES, MOVED_PX = 40, (3, 1)


def textured(number: int) -> Picture:
    """Cut the picture of a frame out of a texture that moves by (3, 1) px."""
    noise = np.random.default_rng(1).integers(0, 256, (LENS.height + 80, LENS.width + 160), dtype=np.uint8)
    texture = cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 4), np.empty_like(noise), 0, 255, cv2.NORM_MINMAX)
    right, down = 140 - MOVED_PX[0] * number, 60 - MOVED_PX[1] * number
    return np.repeat(texture[down : down + LENS.height, right : right + LENS.width, None], 3, axis=2)


@pytest.fixture
def session(tmp_path: Path) -> Path:
    """Ingest a flight with keypoints, whose first camera has a video too."""
    made = write_flight(tmp_path, seconds=FRAMES / 30)
    write_video(tmp_path / "drone1.mp4", even_ticks(FRAMES), draw=textured)
    made.settings["cameras"]["drone1"]["video"] = "drone1.mp4"
    made.settings["cameras"]["drone1"]["frame_times"] = {
        "start": made.settings["cameras"]["drone1"]["frame_times"]["start"]
    }
    made.save()
    folder = tmp_path / "flight.session"
    succeeds("ingest", made.manifest, "-o", folder)
    return folder


def test_tracks_and_stills_are_kept_for_other_methods_and_poses(session: Path) -> None:
    succeeds("reconstruct", session)
    tracks = session / "background" / "drone1" / "tracks.parquet"
    assert not (session / "background" / "drone2").exists()
    written = tracks.stat().st_ino
    (session.parent / "drone1.mp4").unlink()  # so that nothing can be decoded again
    succeeds("reconstruct", session, "--method", "auto", "--smooth", "butterworth")
    assert tracks.stat().st_ino == written
    description = read_description(session)
    (camera, _), _ = load_cameras(session, description, None, min_confidence=0.3, pose_noise=None)
    stills = load_stills(session, camera)
    assert stills is not None
    np.testing.assert_array_equal(stills.rows[[0, -1]], [0, FRAMES - 1])
    # JPEG of quality 85, and before it H.264, change smooth grey values by some steps.
    assert np.abs(stills.picture(1).astype(float) - textured(int(stills.rows[1]))[..., 0]).mean() < 5
    found = load_tracks(session, camera)
    assert found is not None
    pictures = np.concatenate([part.picture for part in found.between(0, FRAMES)])
    assert set(pictures.tolist()) == set(range(FRAMES))


def test_blocks_share_a_picture_and_no_points(session: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Follow in blocks of 15 pictures: points move as the texture does, to some tenths of a pixel."""
    monkeypatch.setattr(detect, "BLOCK", 15)
    with locked(session) as writable:
        record = follow(writable, workers=2)
    assert record.counts["cameras"]["drone1"]["pictures"] == FRAMES
    tracks = pd.read_parquet(session / "background" / "drone1" / "tracks.parquet")
    spans = tracks.groupby("point")["frame"].agg(["min", "max"])
    assert {int(first) for first in spans["min"]} >= {0, 14, 29}
    for first, stop in ((0, 14), (14, 29), (29, FRAMES - 1)):
        inside = (spans["min"] >= first) & (spans["max"] <= stop)
        assert inside.sum() > 50
        spans = spans[~inside]
    assert spans.empty
    ends = tracks.groupby("point").agg(["first", "last"])
    lived = (ends["frame"]["last"] - ends["frame"]["first"]).to_numpy()
    for axis, moved in zip("xy", MOVED_PX, strict=True):
        away = (ends[axis]["last"] - ends[axis]["first"]).to_numpy()
        assert np.median(np.abs(away - moved * lived)) < 0.3
