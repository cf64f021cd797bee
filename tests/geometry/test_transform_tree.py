"""Chains through a tree of transforms: closed-form motion, both directions, gaps, wrong names."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from pipelines.geometry.arrays import Float, Int64
from pipelines.geometry.poses import Link, chain, compose, find_route, invert, matrix_from_quaternion

S = 1_000_000_000
EPOCH = 1_700_000_000 * S


def stamps(rate_hz: float, seconds: float = 2.0, start_s: float = 0.0) -> Int64:
    return EPOCH + np.round((start_s + np.arange(round(seconds * rate_hz) + 1) / rate_hz) * S).astype(
        np.int64
    )


def about_z(turned_deg: Float) -> Rotation:
    return Rotation.from_rotvec(np.radians(turned_deg)[:, None] * [0.0, 0.0, 1.0])


def gliding(t_ns: Int64, velocity: tuple[float, float, float], turn_deg_s: float = 0.0) -> Link:
    """Make a link with constant velocity and turn rate about z, which interpolation reproduces exactly."""
    seconds = (t_ns - EPOCH) / S
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
    seconds = (found.t_ns - EPOCH) / S
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
    kept = (t_ns <= EPOCH + S) | (t_ns >= EPOCH + 3 * S // 2)  # 5 Hz: nothing between 1.0 and 1.6 s
    links["map", "odom"] = Link(t_ns[kept], position[kept], quaternion[kept])
    found = chain(links, "world", "camera", max_gap_ns=S // 2)
    unknown = (found.t_ns > EPOCH + S) & (found.t_ns < EPOCH + 8 * S // 5)
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
