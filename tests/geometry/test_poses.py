"""Rotations against scipy, transforms by their algebra, interpolation by closed-form motion."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.spatial.transform import Rotation

from pipelines.geometry.arrays import Float, Int64, Place
from pipelines.geometry.geodesy import ecef_from_geodetic, enu_from_enu, enu_from_geodetic, geodetic_from_ecef
from pipelines.geometry.metrics import align_each
from pipelines.geometry.poses import (
    Link,
    chain,
    compose,
    conjugate,
    find_route,
    gaps,
    interpolate_points,
    interpolate_poses,
    invert,
    matrix_from_quaternion,
    multiply,
    quaternion_from_matrix,
    quaternion_from_rotation_vector,
    rotate,
    rotation_vector_from_quaternion,
    transform,
    velocities,
)

EPOCH = 1_700_000_000_123_456_789
MS = 1_000_000
rotation_vectors = hnp.arrays(np.float64, (3,), elements=st.floats(-1.8, 1.8))
vectors = hnp.arrays(np.float64, (3,), elements=st.floats(-100, 100))


def random_quaternions(count: int, seed: int = 0) -> Float:
    return np.asarray(Rotation.random(count, rng=np.random.default_rng(seed)).as_quat(), dtype=np.float64)


def same_rotation(a: Float, b: Float, atol: float = 1e-12) -> None:
    signs = np.where(np.sum(a * b, axis=-1, keepdims=True) < 0, -1.0, 1.0)
    np.testing.assert_allclose(a * signs, b, rtol=0, atol=atol)


def turning(t_s: Float) -> tuple[Float, Float]:
    """Move with velocity (1, -2, 0.5) m/s and rotate at a constant 0.8 rad/s about a slanted axis."""
    axis = np.array([2.0, -1.0, 2.0]) / 3
    start = np.array([0.1, 0.2, -0.3])
    quaternion = multiply(
        quaternion_from_rotation_vector(start), quaternion_from_rotation_vector(0.8 * t_s[:, None] * axis)
    )
    return np.array([5.0, 6.0, 7.0]) + t_s[:, None] * [1.0, -2.0, 0.5], quaternion


def log_at(t_ns: Int64) -> tuple[Float, Float]:
    return turning((t_ns - EPOCH) / 1e9)


# --- rotations -----------------------------------------------------------------------------------------
def test_matrices_are_scipy_s() -> None:
    quaternions = random_quaternions(50)
    expected = Rotation.from_quat(quaternions).as_matrix()
    np.testing.assert_allclose(matrix_from_quaternion(quaternions), expected, rtol=0, atol=1e-14)
    same_rotation(quaternion_from_matrix(expected), quaternions)


@given(rotation_vectors)
def test_rotation_vectors_are_scipy_s_and_come_back(vector: Float) -> None:
    quaternion = quaternion_from_rotation_vector(vector)
    same_rotation(quaternion, np.asarray(Rotation.from_rotvec(vector).as_quat()))
    # |v| <= 1.8 sqrt(3) < pi, so the shortest rotation is the vector itself.
    np.testing.assert_allclose(rotation_vector_from_quaternion(-quaternion), vector, rtol=0, atol=1e-12)


@given(rotation_vectors, rotation_vectors, vectors)
def test_multiplying_applies_the_right_one_first(a: Float, b: Float, vector: Float) -> None:
    qa, qb = quaternion_from_rotation_vector(a), quaternion_from_rotation_vector(b)
    np.testing.assert_allclose(
        rotate(multiply(qa, qb), vector),
        matrix_from_quaternion(qa) @ matrix_from_quaternion(qb) @ vector,
        rtol=0,
        atol=1e-12 * 200,
    )


# --- chains --------------------------------------------------------------------------------------------
@given(vectors, rotation_vectors, vectors, rotation_vectors, vectors)
def test_chains_of_transforms(p: Float, r: Float, q: Float, s: Float, point: Float) -> None:
    world_from_a = (p, quaternion_from_rotation_vector(r))
    a_from_b = (q, quaternion_from_rotation_vector(s))
    world_from_b = compose(world_from_a, a_from_b)
    np.testing.assert_allclose(
        transform(world_from_b, point),
        transform(world_from_a, transform(a_from_b, point)),
        rtol=0,
        atol=1e-11,
    )
    np.testing.assert_allclose(
        transform(invert(*world_from_b), transform(world_from_b, point)), point, rtol=0, atol=1e-11
    )


# --- time ----------------------------------------------------------------------------------------------
def test_constant_motion_is_interpolated_exactly() -> None:
    t_ns = EPOCH + np.array([0, 90, 200, 310, 400], dtype=np.int64) * MS
    position, quaternion = log_at(t_ns)
    quaternion[[1, 4]] *= -1  # a log may flip signs at will
    at_ns = EPOCH + np.arange(0, 401, dtype=np.int64)[::-1] * MS
    got_position, got_quaternion = interpolate_poses(
        t_ns, position, quaternion, at_ns, max_gap_ns=200 * MS, max_extrapolation_ns=0
    )
    position_true, quaternion_true = log_at(at_ns)
    np.testing.assert_allclose(got_position, position_true, rtol=0, atol=1e-13)
    # The same hemisphere all along, not only the same rotations.
    np.testing.assert_allclose(got_quaternion, quaternion_true, rtol=0, atol=1e-14)


def test_a_nanosecond_is_not_lost_on_the_epoch() -> None:
    t_ns = np.array([EPOCH, EPOCH + 8], dtype=np.int64)
    values = np.array([[0.0], [8.0]])
    at_ns = EPOCH + np.arange(9, dtype=np.int64)
    got = interpolate_points(t_ns, values, at_ns, max_gap_ns=8)
    np.testing.assert_array_equal(got[:, 0], np.arange(9))


def test_no_pose_inside_a_gap() -> None:
    t_ns = EPOCH + np.array([0, 100, 400, 500], dtype=np.int64) * MS
    at_ns = EPOCH + np.array([50, 100, 101, 399, 400, 450], dtype=np.int64) * MS
    got = interpolate_poses(t_ns, *log_at(t_ns), at_ns, max_gap_ns=100 * MS, max_extrapolation_ns=0)
    assert [np.isfinite(part).all(axis=1).tolist() for part in got] == [
        [True, True, False, False, True, True]
    ] * 2
    assert gaps(t_ns, 100 * MS) == [(EPOCH + 100 * MS, EPOCH + 400 * MS)]
    assert gaps(t_ns[:1], 0) == []


def test_outside_the_log_the_nearest_pose_is_held_within_the_tolerance() -> None:
    t_ns = EPOCH + np.array([0, 100], dtype=np.int64) * MS
    position, quaternion = log_at(t_ns)
    at_ns = EPOCH + np.array([-21, -20, 120, 121], dtype=np.int64) * MS
    got = interpolate_poses(
        t_ns, position, quaternion, at_ns, max_gap_ns=100 * MS, max_extrapolation_ns=20 * MS
    )
    np.testing.assert_array_equal(got[0][1:3], position)
    np.testing.assert_array_equal(got[1][1:3], quaternion)
    assert np.isnan(got[0][[0, 3]]).all()
    assert np.isnan(got[1][[0, 3]]).all()


@pytest.mark.parametrize("stamps", [[0, 5, 5], [0, 5, 4]])
def test_stamps_that_do_not_increase_are_refused(stamps: list[int]) -> None:
    t_ns = np.array(stamps, dtype=np.int64)
    with pytest.raises(ValueError, match="stamps"):
        interpolate_points(t_ns, np.zeros((3, 1)), t_ns, max_gap_ns=10)


def test_points_are_never_made_from_a_missing_neighbour() -> None:
    t_ns = np.array([0, 10, 20, 30], dtype=np.int64)
    values = np.zeros((4, 2, 3))
    values[:, 0, 0] = [0, 1, np.nan, 3]
    values[:, 1, 0] = [0, 1, 2, 3]
    at_ns = np.array([-1, 5, 10, 15, 20, 25, 30, 31], dtype=np.int64)
    got = interpolate_points(t_ns, values, at_ns, max_gap_ns=10)
    n = np.nan
    np.testing.assert_array_equal(got[:, 0, 0], [n, 0.5, 1, n, n, n, 3, n])
    np.testing.assert_array_equal(got[:, 1, 0], [n, 0.5, 1, 1.5, 2, 2.5, 3, n])


@given(data=st.data())
def test_interpolated_rotations_turn_steadily_between_their_neighbours(data: st.DataObject) -> None:
    ends = np.array([quaternion_from_rotation_vector(data.draw(rotation_vectors)) for _ in range(2)])
    fraction = data.draw(st.integers(0, 1000))
    t_ns = np.array([0, 1000], dtype=np.int64)
    at_ns = np.array([fraction], dtype=np.int64)
    _, got = interpolate_poses(t_ns, np.zeros((2, 3)), ends, at_ns, max_gap_ns=1000, max_extrapolation_ns=0)
    np.testing.assert_allclose(np.linalg.norm(got), 1, rtol=0, atol=1e-14)

    def angle(a: Float, b: Float) -> float:
        return float(np.linalg.norm(rotation_vector_from_quaternion(multiply(conjugate(a), b))))

    assert angle(ends[0], got[0]) == pytest.approx(fraction / 1000 * angle(*ends), abs=1e-12)


def test_velocities_are_those_to_the_samples_before_and_after() -> None:
    """A parabola's secants, by hand; a break, a missing sample and one out of order have none."""
    t_s = np.array([[0.0], [0.1], [0.3], [0.4], [0.35]])
    values = t_s[..., None] ** 2 * [1.0, -2.0]
    before, after = velocities(t_s, values, np.array([[True], [True], [False], [True]]))
    secants = np.array([0.1, 0.4])  # (b^2 - a^2) / (b - a) = a + b
    np.testing.assert_allclose(after[:2, 0, 0], secants)
    np.testing.assert_allclose(before[1:3, 0, 1], -2 * secants)
    assert np.isnan(before[[0, 3, 4]]).all()
    assert np.isnan(after[2:]).all()
    values[1] = np.nan
    before, after = velocities(t_s, values, np.ones((4, 1), bool))
    assert np.isnan(after[:2]).all()
    assert np.isnan(before[1:3]).all()
    lone, _ = velocities(np.zeros(1), np.ones((1, 2)), np.empty(0, bool))
    assert np.isnan(lone).all()


def cloud(count: int = 17, seed: int = 0) -> Float:
    return np.random.default_rng(seed).normal(size=(count, 3)) * [0.3, 0.2, 0.6] + [4.0, -3.0, 1.0]


def rotation_of(vector: tuple[float, float, float]) -> Float:
    return np.asarray(Rotation.from_rotvec(vector).as_matrix(), dtype=np.float64)


@given(
    seed=st.integers(0, 1000),
    vector=st.tuples(*[st.floats(-3, 3)] * 3),
    scale=st.floats(0.05, 20),
    shift=st.tuples(*[st.floats(-1000, 1000)] * 3),
    count=st.integers(3, 20),
)
def test_a_known_similarity_is_found(
    seed: int, vector: tuple[float, float, float], scale: float, shift: tuple[float, float, float], count: int
) -> None:
    source = cloud(count, seed)
    rotation = rotation_of(vector)
    target = scale * source @ rotation.T + shift
    found = align_each(source, target, with_scale=True)
    # Coordinates of 1e3 carry 1e-13 of rounding; narrow triangles multiply it by at most some 1e4.
    np.testing.assert_allclose(found.apply(source), target, rtol=0, atol=1e-9 * scale + 1e-9)
    np.testing.assert_allclose(found.scale, scale, rtol=1e-7)
    assert np.linalg.det(found.rotation) == pytest.approx(1)


def test_a_rigid_alignment_keeps_the_size() -> None:
    source = cloud()
    rotation = rotation_of((0.3, -1.0, 2.0))
    found = align_each(source, source @ rotation.T + [1, 2, 3], with_scale=False)
    assert found.scale == 1
    np.testing.assert_allclose(found.rotation, rotation, atol=1e-12)
    doubled = align_each(source, 2 * source, with_scale=False)
    # The mean goes onto the mean, whatever the size.
    np.testing.assert_allclose(doubled.apply(source).mean(axis=0), 2 * source.mean(axis=0), atol=1e-12)


def test_a_mirror_image_is_not_matched_by_a_reflection() -> None:
    source = cloud()
    found = align_each(source, source * [-1, 1, 1], with_scale=True)
    assert np.linalg.det(found.rotation) == pytest.approx(1)
    assert np.abs(found.apply(source) - source * [-1, 1, 1]).max() > 0.05


def test_points_missing_on_either_side_are_left_out() -> None:
    source = cloud()
    target = 0.7 * source @ rotation_of((1.0, 0.2, 0.3)).T - 5
    source[3] = np.nan
    target[8, 1] = np.nan
    found = align_each(source, target, with_scale=True)
    assert found.scale == pytest.approx(0.7)
    moved = found.apply(source)
    assert np.isnan(moved[3]).all()
    np.testing.assert_allclose(moved[[0, 16]], target[[0, 16]], atol=1e-12)


def test_a_batch_is_its_members_and_nan_where_there_is_no_answer() -> None:
    rng = np.random.default_rng(2)
    source = rng.normal(size=(2, 3, 6, 3))
    target = rng.normal(size=(2, 3, 6, 3))
    source[0, 1, 2:] = np.nan  # two points
    target[1, 2] = np.linspace(0, 1, 6)[:, None] * [1.0, 2, 3]  # a line
    target[0, 0, 4, 0] = np.nan
    batch = align_each(source, target, with_scale=True)
    for i, j in np.ndindex(2, 3):
        if (i, j) in {(0, 1), (1, 2)}:
            assert np.isnan(batch.rotation[i, j]).all()
            assert np.isnan(batch.apply(source)[i, j]).all()
        else:
            one = align_each(source[i, j], target[i, j], with_scale=True)
            np.testing.assert_allclose(batch.apply(source)[i, j], one.apply(source[i, j]), atol=1e-12)


# IOGP Guidance Note 7-2, method 9837: the topocentric origin of the worked example.
NORTH_SEA = Place(55.0, 5.0, 200.0)


def _deg(degrees: float, minutes: float, seconds: float) -> float:
    return degrees + minutes / 60 + seconds / 3600


def test_geocentric_coordinates_of_the_published_example() -> None:
    # IOGP Guidance Note 7-2, method 9602; printed to the millimetre, its angles to 0.001" (0.03 m).
    point = ecef_from_geodetic(np.array(_deg(53, 48, 33.820)), np.array(_deg(2, 7, 46.380)), np.array(73.0))
    np.testing.assert_allclose(point, [3771793.968, 140253.342, 5124304.349], atol=0.02)


def test_topocentric_coordinates_of_the_published_example() -> None:
    # Method 9837: the point of method 9602 seen from the North Sea, printed to the millimetre.
    enu = enu_from_geodetic(
        np.array(_deg(53, 48, 33.82)), np.array(_deg(2, 7, 46.38)), np.array(73.0), NORTH_SEA
    )
    np.testing.assert_allclose(enu, [-189013.869, -128642.040, -4220.171], atol=0.02)


def test_the_inverse_gives_the_degrees_back_anywhere() -> None:
    rng = np.random.default_rng(5)
    latitude, longitude = rng.uniform(-90, 90, 500), rng.uniform(-180, 180, 500)
    altitude = rng.uniform(-400, 9000, 500)
    latitude[:2], latitude[2] = (90, -90), 0
    back = geodetic_from_ecef(ecef_from_geodetic(latitude, longitude, altitude))
    np.testing.assert_allclose(back[0], latitude, atol=1e-11)  # 1 micrometre
    np.testing.assert_allclose(back[2], altitude, atol=1e-6)
    inland = np.abs(latitude) < 89
    np.testing.assert_allclose(back[1][inland], longitude[inland], atol=1e-9)


def test_from_one_place_to_another_is_the_same_as_directly() -> None:
    here, there = Place(47.0, 8.0, 400.0), Place(47.02, 8.03, 450.0)
    latitude, longitude, altitude = (
        np.array([47.021, 47.019]),
        np.array([8.031, 8.029]),
        np.array([460.0, 470.0]),
    )
    rotation, position = enu_from_enu(there, here)
    by_way = enu_from_geodetic(latitude, longitude, altitude, there) @ rotation.T + position
    # Earth-centred coordinates have 7 digits before the point: doubles leave 1e-9 m of them.
    np.testing.assert_allclose(by_way, enu_from_geodetic(latitude, longitude, altitude, here), atol=1e-7)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)


S = 1_000_000_000
EPOCH_NS = 1_700_000_000 * S


def stamps(rate_hz: float, seconds: float = 2.0, start_s: float = 0.0) -> Int64:
    return EPOCH_NS + np.round((start_s + np.arange(round(seconds * rate_hz) + 1) / rate_hz) * S).astype(
        np.int64
    )


def about_z(turned_deg: Float) -> Rotation:
    return Rotation.from_rotvec(np.radians(turned_deg)[:, None] * [0.0, 0.0, 1.0])


def gliding(t_ns: Int64, velocity: tuple[float, float, float], turn_deg_s: float = 0.0) -> Link:
    """Make a link with constant velocity and turn rate about z, which interpolation reproduces exactly."""
    seconds = (t_ns - EPOCH_NS) / S
    turned = about_z(turn_deg_s * seconds)
    return Link(t_ns, seconds[:, None] * np.array(velocity), turned.as_quat())


def still(position: tuple[float, float, float], yaw_deg: float = 0.0) -> Link:
    turned = about_z(np.array([yaw_deg])).as_quat()
    return Link(np.array([0]), np.array([position], dtype=np.float64), turned, static=True)


def a_drone() -> dict[tuple[str, str], Link]:
    return {
        ("map", "odom"): gliding(stamps(5), (0, 1, 0)),
        ("odom", "base"): gliding(stamps(50, start_s=0.1, seconds=1.5), (10, 0, 0), turn_deg_s=90),
        ("base", "camera"): still((0.5, 0, 0), yaw_deg=90),
        ("world", "map"): still((100, 0, 0)),
    }


def test_a_chain_of_moving_and_static_links_at_the_stamps_of_the_fastest() -> None:
    found = chain(a_drone(), "world", "camera", max_gap_ns=S)
    np.testing.assert_array_equal(found.t_ns, stamps(50, start_s=0.1, seconds=1.5))
    seconds = (found.t_ns - EPOCH_NS) / S
    heading = np.radians(90) * seconds
    expected = np.stack(
        [100 + 10 * seconds + 0.5 * np.cos(heading), seconds + 0.5 * np.sin(heading), 0 * seconds], axis=1
    )
    np.testing.assert_allclose(found.position, expected, rtol=0, atol=1e-9)
    camera = about_z(np.degrees(heading) + 90).as_matrix()
    np.testing.assert_allclose(matrix_from_quaternion(found.quaternion_xyzw), camera, rtol=0, atol=1e-9)


@given(st.lists(st.booleans(), min_size=1, max_size=6), st.integers(0, 2**31))
def test_links_may_be_stated_either_way_round(flipped: list[bool], seed: int) -> None:
    """Use a chain of random static links; each is put into the tree as it is or inverted."""
    generator = np.random.default_rng(seed)
    links: dict[tuple[str, str], Link] = {}
    expected: tuple[Float, Float] = (np.zeros((1, 3)), np.array([[0.0, 0, 0, 1]]))
    for k, flip in enumerate(flipped):
        pose = (generator.normal(size=(1, 3)), Rotation.random(1, rng=generator).as_quat())
        expected = compose(expected, pose)
        edge = (f"f{k + 1}", f"f{k}") if flip else (f"f{k}", f"f{k + 1}")
        links[edge] = Link(np.array([0]), *(invert(*pose) if flip else pose), static=True)
    found = chain(links, "f0", f"f{len(flipped)}", max_gap_ns=S)
    np.testing.assert_allclose(found.position, expected[0], rtol=0, atol=1e-12)
    np.testing.assert_allclose(
        matrix_from_quaternion(found.quaternion_xyzw), matrix_from_quaternion(expected[1]), rtol=0, atol=1e-12
    )


def test_a_gap_in_one_link_is_a_gap_of_the_chain() -> None:
    links = a_drone()
    t_ns, position, quaternion, _ = links["map", "odom"]
    kept = (t_ns <= EPOCH_NS + S) | (t_ns >= EPOCH_NS + 3 * S // 2)  # 5 Hz: nothing between 1.0 and 1.6 s
    links["map", "odom"] = Link(t_ns[kept], position[kept], quaternion[kept])
    found = chain(links, "world", "camera", max_gap_ns=S // 2)
    unknown = (found.t_ns > EPOCH_NS + S) & (found.t_ns < EPOCH_NS + 8 * S // 5)
    np.testing.assert_array_equal(np.isnan(found.position[:, 0]), unknown)
    np.testing.assert_array_equal(np.isnan(found.quaternion_xyzw[:, 0]), unknown)
    assert not np.isnan(chain(links, "world", "camera", max_gap_ns=S).position).any()


def test_the_shortest_way_is_taken() -> None:
    links = {
        ("world", "base"): still((1, 0, 0)),
        ("world", "odom"): still((5, 0, 0)),
        ("odom", "base"): still((5, 0, 0)),
    }
    assert find_route(links, "world", "base").frames == ("world", "base")


@pytest.mark.parametrize(
    ("parent", "child", "named"),
    [
        ("world", "camra", r"no frame 'camra' \(nearest: camera"),
        ("xyzzy", "camera", r"no frame 'xyzzy' \(there are base, camera, island, map"),
        ("world", "island", "no transforms connect 'world' with 'island' .'world' has base, camera"),
        ("base", "base", "both 'base'"),
    ],
)
def test_wrong_frames_are_named_with_those_there_are(parent: str, child: str, named: str) -> None:
    links = a_drone() | {("sea", "island"): still((0, 0, 0))}
    with pytest.raises(ValueError, match=named):
        chain(links, parent, child, max_gap_ns=S)
