"""Virtual gimbals: the film shows a point where the true attitudes say, and figures have known values."""

from dataclasses import fields
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

from benchmarks import gimbals
from benchmarks.gimbals import Figures, Log, Shot, entries_of
from pipelines.formats.videos.video import VideoReader
from pipelines.geometry.arrays import Picture
from pipelines.geometry.cameras import Intrinsics, project
from pipelines.session.description import IntrinsicsEntry
from tests.synthetic.videos import even_ticks, write_video


def test_the_film_shows_a_point_where_the_true_attitudes_say(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lens = Intrinsics(1080, 1920, 1680.0, 1670.0, 533.0, 948.0, "radtan", (-0.03, 0.01, 0.001, -0.001))
    point = np.array([0.3, -0.5, 4.0])  # in the still camera
    x, y = project(point, lens)
    rows, columns = np.mgrid[:1920, :1080]
    seen = np.where(np.hypot(columns - x, rows - y) < 12, 255, 60).astype(np.uint8)
    picture: Picture = np.repeat(seen[..., None], 3, axis=2)
    (tmp_path / "videos").mkdir()
    write_video(tmp_path / "videos" / "cam01.mp4", even_ticks(3), draw=lambda _: picture)
    monkeypatch.setattr(gimbals, "REAL", tmp_path)
    world_from_camera = Rotation.from_rotvec([1.2, -0.4, 0.3]).as_matrix()
    angles = np.radians([[0.0, 0.0, 0.0], [2.0, -3.0, 4.0], [-3.0, 2.0, -5.0]])
    turned = world_from_camera @ Rotation.from_rotvec(angles).as_matrix()
    shot = Shot(IntrinsicsEntry.of(lens), np.zeros(3), world_from_camera)
    gimbals._film("cam01", shot, turned, tmp_path / "film.mp4")
    focal, _, cx, cy = gimbals._virtual_lens(shot)
    with VideoReader(tmp_path / "film.mp4") as film:
        for number, attitude in enumerate(turned):
            shown = film.read(number)
            assert shown is not None
            bright = np.argwhere(shown[..., 1] > 158)  # halfway
            away = attitude.T @ world_from_camera @ point
            expected = focal * away[:2] / away[2] + [cx, cy]
            # A disc of 19 px across, drawn and coded to a pixel along its edge of 60 px.
            np.testing.assert_allclose(bright.mean(axis=0)[::-1], expected, atol=1 / np.sqrt(60))


def test_entries_are_means_by_level_noise_and_method() -> None:
    one, other = (Figures(*(value,) * len(fields(Figures))) for value in (1.0, 3.0))
    found = {
        ("a", Log(0.5), True): {"robust": one},
        ("b", Log(0.5), True): {"robust": other},
        ("a", Log(0.0), False): {"robust": other},
    }
    entries = entries_of(found)
    assert [(entry["level_deg"], entry["noise_given"], entry["nees"]) for entry in entries] == [
        (0.0, False, 3.0),
        (0.5, True, 2.0),
    ]
    assert [entry["constant_error_deg"] for entry in entries] == [0.0, 1.0]


def test_errors_of_attitudes_part_into_a_constant_and_a_changing_one(tmp_path: Path) -> None:
    true = Rotation.from_rotvec(np.random.default_rng(0).normal(size=(100, 3)))
    constant = np.array([0.1, 0.2, 0.7])
    error = constant + np.tile([[0.3], [-0.3]], (50, 3))
    logged = true * Rotation.from_rotvec(error, degrees=True)
    (tmp_path / "cameras" / "cam01").mkdir(parents=True)
    table = pd.DataFrame(logged.as_quat(), columns=["qx", "qy", "qz", "qw"]).assign(t_ns=range(100))
    table.to_parquet(tmp_path / "cameras" / "cam01" / "poses.parquet")
    found = gimbals._attitude_errors_deg(tmp_path, {"cam01": true.as_matrix()})
    np.testing.assert_allclose(found, (0.3, np.sqrt(np.mean(constant**2)), 0.7), atol=1e-9)
