"""Maps in logs: the same map as in a file, in every container, and at its place in the world."""

import math
import re
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from pipelines.formats.logs import maps as log_maps
from pipelines.formats.logs.maps import cloud_points
from pipelines.formats.maps import octomap
from pipelines.formats.maps.voxel_grids import VoxelSet
from pipelines.session.errors import DataError
from pipelines.session.manifest import LogSource, Manifest, MapSource, Placement
from pipelines.session.records import Occupancy
from pipelines.session.registries import MapFormat
from pipelines.sources.logs import FlightLogs, maps_of_log
from tests.synthetic.logs import CONTAINERS, Container, Entry, write_log
from tests.synthetic.map_logs import (
    Pose,
    as_bt,
    cloud_entry,
    cloud_fields,
    grid_entry,
    octomap_entry,
    transform_entry,
)

READER: MapFormat = octomap.FORMAT
T0 = 1_700_000_000_000_000_000
SECOND = 10**9
ROOT_HALF = math.sqrt(0.5)

Cells = NDArray[np.int8]


class Read:
    """Maps and notes of a log's topic of maps."""

    def __init__(
        self,
        folder: Path,
        entries: Sequence[Entry],
        *,
        container: Container = "mcap-cdr",
        place: Placement | None = None,
        ned: bool = False,
        pose_topic: str | None = None,
        stamps: str = "header",
        **stated: Any,
    ) -> None:
        log = write_log(folder, f"log{len(list(folder.iterdir()))}", container, entries)
        self.notes: list[str] = []
        camera: dict[str, Any] = {"pose": {"file": "x"}, "intrinsics": "x", "keypoints": "y"}
        if pose_topic:
            camera["pose"] = {"file": "a", "topic": pose_topic}
        settings = LogSource(
            file=[log.name],
            stamps=stamps,
            axes="ned" if ned else "enu",
            world_from_source=place or Placement(),
        )
        flight = Manifest.model_validate({"schema": 1, "cameras": {"c": camera}, "logs": {"a": settings}})
        with FlightLogs(flight, folder, self.notes.append) as logs:
            found = maps_of_log(
                flight, MapSource(file="a", **stated), logs, max_gap_ns=SECOND, note=self.notes.append
            )
            self.maps = list(found.maps)
        self.dropped = found.dropped
        assert [one.from_ns for one in self.maps] == found.from_ns.tolist()

    @property
    def only(self) -> Occupancy:
        (one,) = self.maps
        return one


def same(a: Occupancy, b: Occupancy) -> None:
    np.testing.assert_array_equal(a.probability, b.probability)
    np.testing.assert_array_equal(a.origin, b.origin)
    assert a.resolution_m == b.resolution_m


def box(changed: float = 0.971) -> Occupancy:
    """Make a map without symmetry: an L of obstacles with free space beside it."""
    grid = np.full((6, 5, 4), np.nan, dtype=np.float32)
    grid[1:5, 3, 0:2], grid[1, 1:4, 2] = 0.971, 0.971
    grid[0, :, 3] = 0.1192
    grid[5, 0, 0] = changed
    return Occupancy(grid, np.array([-1.0, 0.4, 0.2]), 0.2)


@pytest.mark.parametrize("container", CONTAINERS)
def test_octomap_is_that_of_its_file(tmp_path: Path, container: Container) -> None:
    file = as_bt(box(), tmp_path / "site")
    found = Read(tmp_path, [octomap_entry(file, T0)], container=container)
    same(found.only, READER.read_map(tmp_path / "site" / "map.bt"))
    assert (found.only.from_ns, found.dropped) == (T0, {})


def test_maps_that_follow_each_other(tmp_path: Path) -> None:
    first, second = (as_bt(box(p), tmp_path / "site") for p in (0.971, 0.1192))
    files = [first, first, second, second, second, first]
    found = Read(tmp_path, [octomap_entry(file, T0 + k * SECOND) for k, file in enumerate(files)])
    assert [one.from_ns for one in found.maps] == [T0, T0 + 2 * SECOND, T0 + 5 * SECOND]
    assert [float(one.probability[5, 0, 0]) for one in found.maps] == [
        pytest.approx(0.971),
        pytest.approx(0.1192),
        pytest.approx(0.971),
    ]
    assert found.dropped == {}
    assert any(re.search(r"\b3 maps\b.*\b3\b", note) for note in found.notes)


def test_damaged_and_empty_maps_are_counted(tmp_path: Path) -> None:
    file = as_bt(box(), tmp_path / "site")
    entries = [
        octomap_entry(file.partition(b"data\n")[0] + b"data\n", T0),
        octomap_entry(file[:-2], T0 + 1),
        octomap_entry(file, T0 + 2),
        octomap_entry(file + b"\0\0", T0 + 3),
    ]
    found = Read(tmp_path, entries)
    assert found.only.from_ns == T0 + 2
    assert found.dropped == {log_maps.EMPTY: 1, log_maps.DAMAGED: 2}
    assert any(re.search(r"tree.*\(2 ", note) for note in found.notes)


def voxels_of(points: NDArray[np.float64]) -> Occupancy:
    voxels = VoxelSet("cloud", None)
    voxels.add(points)
    return voxels.occupancy()


def occupied_centres(one: Occupancy) -> NDArray[np.float64]:
    index = np.argwhere(one.probability >= 0.5)
    return one.origin + (index + 0.5) * one.resolution_m


def in_order(points: NDArray[np.float64]) -> NDArray[np.float64]:
    rounded = np.round(points, 6) + 0.0
    return rounded[np.lexsort(rounded.T)]


def test_transforms_of_the_log_place_a_map(tmp_path: Path) -> None:
    """Yaw odom against map by a right angle; poses are in map."""
    file = as_bt(box(), tmp_path / "site")
    turned: Pose = ((2.0, 0.0, 0.0), (0.0, 0.0, ROOT_HALF, ROOT_HALF))
    pose = {"header": {"stamp": T0, "frame_id": "/map"}, "pose": {"orientation": {"w": 1.0}}}
    entries = [
        Entry("/pose", "geometry_msgs/msg/PoseStamped", T0, pose),
        transform_entry("map", "site", turned, T0, topic="/tf_static"),
        octomap_entry(file, T0, frame="site"),
    ]
    found = Read(tmp_path, entries, pose_topic="/pose")
    true = occupied_centres(READER.read_map(tmp_path / "site" / "map.bt"))
    true = true[:, [1, 0, 2]] * [-1, 1, 1] + [2, 0, 0]
    np.testing.assert_allclose(in_order(occupied_centres(found.only)), in_order(true), rtol=0, atol=1e-5)
    assert any(re.search("'site'.*'map'", note) for note in found.notes)


def plan() -> Cells:
    cells = np.zeros((4, 3), np.int8)
    cells[1, 2], cells[3, 0], cells[0, 0] = 100, 60, -1
    return cells


@pytest.mark.parametrize("container", CONTAINERS)
def test_plan_is_raised_from_its_origin(tmp_path: Path, container: Container) -> None:
    origin: Pose = ((-3.0, 7.0, 1.25), (0.0, 0.0, 0.0, 0.0))  # a quaternion of zeros is common
    one = Read(tmp_path, [grid_entry(plan(), T0, origin=origin)], container=container, height_m=1.6).only
    cells = plan().astype(float)
    cells[cells < 0] = np.nan
    # 1.6 m are 3.2 layers of 0.5 m, so there are four.
    np.testing.assert_array_equal(
        one.probability, np.repeat((cells / 100)[:, :, None], 4, axis=2).astype("f4")
    )
    assert (one.origin.tolist(), one.resolution_m) == ([-3.0, 7.0, 1.25], 0.5)


POINTS = np.array(
    [[0.1, 0.1, 0.1], [0.15, 0.1, 0.1], [-3.7, 2.2, 5.01], [1.0, np.nan, 2.0], [4.3, -2.1, 0.3], [9, 9, 9]]
)


@pytest.mark.parametrize("container", CONTAINERS)
def test_cloud_is_that_of_a_file(tmp_path: Path, container: Container) -> None:
    found = Read(tmp_path, [cloud_entry(cloud_fields(POINTS), T0)], container=container)
    expected = voxels_of(POINTS.astype(np.float32).astype(np.float64))
    same(found.only, expected)
    assert list(found.dropped.values()) == [1]


@settings(deadline=None)
@given(
    points=arrays(
        np.float64,
        st.tuples(st.integers(1, 4).map(lambda rows: 2 * rows), st.just(3)),
        elements=st.floats(-1e3, 1e3, width=32) | st.just(math.nan) | st.just(math.inf),
    ),
    kind=st.sampled_from(["f4", "f8"]),
    big_endian=st.booleans(),
    rows=st.sampled_from([1, 2]),
    row_padding=st.integers(0, 5),
    order=st.permutations("xyz").map("".join),
)
def test_every_layout_gives_the_same_points(
    points: NDArray[np.float64], kind: str, big_endian: bool, rows: int, row_padding: int, order: str
) -> None:
    fields = cloud_fields(
        points, kind=kind, big_endian=big_endian, rows=rows, row_padding=row_padding, order=order
    )
    np.testing.assert_array_equal(cloud_points(_as_message(fields), "cloud"), points)


def _as_message(fields: dict[str, Any]) -> Any:
    described = [SimpleNamespace(**each) for each in fields["fields"]]
    return SimpleNamespace(**{**fields, "fields": described})


def test_clouds_add_up_and_nothing_is_known_before_it_was_seen(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(3)
    clouds = [rng.uniform(-4, 4, (50, 3)) for _ in range(7)]
    entries = [cloud_entry(cloud_fields(c, kind="f8"), T0 + k * SECOND) for k, c in enumerate(clouds)]
    found = Read(tmp_path, entries)
    assert [(one.from_ns - T0) // SECOND for one in found.maps] == list(range(7))
    whole = voxels_of(np.concatenate(clouds))
    same(found.maps[-1], whole)
    for k, one in enumerate(found.maps):
        index = np.floor((np.concatenate(clouds[: k + 1]) - one.origin) / 0.2 + 1e-9).astype(int)
        seen = np.full(whole.probability.shape, np.nan, np.float32)
        seen[*index.T] = 1
        np.testing.assert_array_equal(one.probability, seen)
    monkeypatch.setattr(log_maps, "MOST_CLOUD_MAPS", 3)
    few = Read(tmp_path, entries)
    assert [(one.from_ns - T0) // SECOND for one in few.maps] == [0, 3, 6]
    same(few.maps[1], found.maps[3])


def test_cloud_of_a_moving_sensor_is_placed_by_transforms(tmp_path: Path) -> None:
    """Observe one point from a sensor that moves along x and turns round between clouds."""
    wall = np.array([5.05, 1.05, 2.05])
    entries: list[Entry] = [
        transform_entry("base", "lidar", ((0.0, 0.0, -0.5), (0.0, 0.0, 0.0, 1.0)), T0, topic="/tf_static")
    ]
    for k in range(5):
        at_ns, x = T0 + k * SECOND // 10, 0.5 * k
        turned = k % 2 == 1
        quaternion = (0.0, 0.0, 1.0, 0.0) if turned else (0.0, 0.0, 0.0, 1.0)
        entries.append(transform_entry("world", "base", ((x, 0.0, 1.0), quaternion), at_ns))
        seen = wall - [x, 0.0, 0.5]
        seen = seen * [-1, -1, 1] if turned else seen
        entries.append(cloud_entry(cloud_fields(seen[None], kind="f8"), at_ns, frame="lidar"))
    late = cloud_entry(cloud_fields(wall[None]), T0 + 9 * SECOND, frame="lidar")
    found = Read(tmp_path, [*entries, late], resolution_m=0.1)
    assert found.only.probability.shape == (1, 1, 1)
    np.testing.assert_allclose(found.only.origin, wall - 0.05, rtol=0, atol=1e-9)
    assert found.dropped == {log_maps.PLACELESS: 1}


@pytest.mark.parametrize(
    "change",
    [
        {"width": 7},
        {"fields": []},
        {"point_step": 6},
        {"fields": [{"name": n, "datatype": 5} for n in "xyz"]},
        {"width": 0, "row_step": 0, "data": np.zeros(0, np.uint8)},
    ],
)
def test_unusable_clouds_are_one_clear_line(tmp_path: Path, change: dict[str, Any]) -> None:
    bad = cloud_entry({**cloud_fields(POINTS), **change}, T0)
    with pytest.raises(DataError):
        Read(tmp_path, [bad])
    if "width" not in change:
        found = Read(tmp_path, [bad, cloud_entry(cloud_fields(POINTS), T0 + 1)])
        assert found.only.from_ns == T0 + 1
        assert found.dropped[log_maps.DAMAGED] == 1
