"""Floor plans: map_server's rules on small pictures, turned plans, and the real ones."""

import math
import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from pipelines.formats.maps import ros_map
from pipelines.session.registries import MapFormat
from tests.raising import refused
from tests.real_data import facts, real_data

READER: MapFormat = ros_map.FORMAT

PICTURE = np.array([[0, 254, 205], [254, 254, 254]], dtype=np.uint8)
"""Two rows; the upper one has the higher y: occupied, free, and (at free_thresh 0.19) unknown."""


def pgm(values: NDArray[np.integer[Any]], most: int = 255, comment: str = "") -> bytes:
    height, width = values.shape
    kind = ">u2" if most > 255 else "u1"
    return f"P5\n{comment}{width} {height}\n{most}\n".encode() + values.astype(kind).tobytes()


def write(folder: Path, picture: bytes = pgm(PICTURE), *, name: str = "plan.pgm", **keys: object) -> Path:
    """Write a plan and its picture; a key that is None is left out."""
    values: dict[str, object] = {
        "image": name,
        "mode": "trinary",
        "resolution": 0.5,
        "origin": [1.0, 2.0, 0.0],
        "negate": 0,
        "occupied_thresh": 0.65,
        "free_thresh": 0.19,
        **keys,
    }
    (folder / name).write_bytes(picture)
    path = folder / "map.yaml"
    path.write_text("".join(f"{key}: {value}\n" for key, value in values.items() if value is not None))
    return path


def floor(path: Path, resolution_m: float | None = None) -> NDArray[np.float32]:
    """Return one level of the map, [x][y], after a check that all levels are equal."""
    probability = READER.read_map(path, resolution_m=resolution_m).probability
    np.testing.assert_array_equal(probability, probability[:, :, :1].repeat(probability.shape[2], axis=2))
    return probability[:, :, 0]


def test_a_plan_stands_on_its_lower_left_corner(tmp_path: Path) -> None:
    path = write(tmp_path)
    assert READER.recognises(path)
    occupancy = READER.read_map(path)
    assert occupancy.origin.tolist() == [1, 2, 0]
    assert occupancy.probability.shape == (3, 2, 5)  # 2.5 m high
    np.testing.assert_array_equal(floor(path), [[0, 1], [0, 0], [0, np.nan]])


@pytest.mark.parametrize(
    "picture",
    [
        pgm(PICTURE, comment="# CREATOR: map_saver 0.050 m/pix\n"),
        pgm(PICTURE.astype(np.uint16) * 257, most=65535),
        b"P2 # plain\n3 2\n255\n0 254 205\n254 254 254\n",
        cv2.imencode(".png", PICTURE)[1].tobytes(),
        cv2.imencode(".png", PICTURE.astype(np.uint16) * 257)[1].tobytes(),
        cv2.imencode(".png", cv2.cvtColor(PICTURE, cv2.COLOR_GRAY2BGRA))[1].tobytes(),
    ],
    ids=["commented", "16 bit", "plain", "png", "16 bit png", "coloured png"],
)
def test_every_kind_of_picture_gives_the_same_map(tmp_path: Path, picture: bytes) -> None:
    np.testing.assert_array_equal(floor(write(tmp_path, picture)), [[0, 1], [0, 0], [0, np.nan]])


@given(
    st.floats(-math.pi, math.pi),
    st.sampled_from([0.25, 0.5, 0.8, 1.0, 2.0]),
    st.sets(st.tuples(st.integers(0, 8), st.integers(0, 6)), min_size=1, max_size=8),
)
def test_turned_walls_are_neither_lost_nor_moved(
    tmp_path_factory: pytest.TempPathFactory, yaw: float, side: float, walls: set[tuple[int, int]]
) -> None:
    picture = np.full((7, 9), 254)
    for x, y in walls:
        picture[6 - y, x] = 0
    path = write(tmp_path_factory.mktemp("plan"), pgm(picture), origin=[3.0, -1.0, yaw])
    occupancy = READER.read_map(path, resolution_m=side)
    c, s = math.cos(yaw), math.sin(yaw)
    pixels = (np.array(sorted(walls)) + 0.5) * 0.5 @ np.array([[c, s], [-s, c]]) + [3.0, -1.0]
    voxels = np.argwhere(occupancy.probability[:, :, 0] >= 0.5) + 0.5
    voxels = voxels * side + occupancy.origin[:2]
    gaps = np.linalg.norm(pixels[:, None] - voxels[None], axis=2)
    # Each pixel shares a point with a voxel and vice versa, so centres are at most half of
    # both diagonals apart.
    reach = (0.5 + side) * math.sqrt(0.5) + 1e-9
    assert gaps.min(axis=1).max() <= reach
    assert gaps.min(axis=0).max() <= reach


def test_a_picture_outside_of_the_folder_is_named_in_full_or_not_at_all(tmp_path: Path) -> None:
    (tmp_path / "plan").mkdir()
    (tmp_path / "outside.pgm").write_bytes(pgm(PICTURE))
    path = write(tmp_path / "plan", image="../outside.pgm", name="plan.pgm")
    (tmp_path / "plan" / "plan.pgm").unlink()
    with refused("no-such-file", path, "../outside.pgm"):
        READER.read_map(path)
    path.write_text(path.read_text(encoding="utf-8").replace("../outside.pgm", f"{tmp_path}/outside.pgm"))
    assert ros_map.FORMAT.pictures(path) == [tmp_path / "outside.pgm"]


@pytest.mark.parametrize("name", ["nav2_depot", "nav2_testmap"])
def test_real_plans_hold_the_pixels_of_their_pictures(tmp_path: Path, name: str) -> None:
    told = facts(f"maps/{name}.pgm")
    path = real_data(f"maps/{name}.yaml")
    assert READER.recognises(path)
    plan = told["yaml"]
    unturned = re.sub(r"(?m)^(origin: .*),.*\]", r"\1, 0.0]", path.read_text(encoding="utf-8"))
    (tmp_path / "a.yaml").write_text(
        re.sub(r"(?m)^image: .*", f"image: {path.with_suffix('.pgm')}", unturned)
    )
    occupancy = READER.read_map(tmp_path / "a.yaml")
    assert occupancy.resolution_m == plan["resolution"]
    assert occupancy.origin[:2].tolist() == plan["origin"][:2]
    floor_of = occupancy.probability[:, :, 0]
    assert floor_of.shape == (told["width"], told["height"])
    states = {"occupied": floor_of >= 0.5, "free": floor_of < 0.5, "unknown": np.isnan(floor_of)}
    for state, pixels in states.items():
        assert np.count_nonzero(pixels) == told[f"trinary_{state}"]
