"""Clocks by the backgrounds of pictures: cameras that turn and move in front of known points."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from pipelines.geometry.arrays import Float, Int64, Intrinsics
from pipelines.geometry.noise import Bias, Drift, White, pose_errors
from pipelines.geometry.poses import (
    matrix_from_quaternion,
    quaternion_from_matrix,
    quaternion_from_rotation_vector,
)
from pipelines.reconstruction.background import clocks_of_backgrounds, turned_aside, with_known_mount
from pipelines.reconstruction.background_tracks import Followed, Tracks
from pipelines.reconstruction.doubts.turning import Lateness, common_offset, lateness, turns_of
from pipelines.session.description import Interpolation
from pipelines.session.records import Trajectory

LENS = Intrinsics(width=1280, height=720, fx=800.0, fy=800.0, cx=640.0, cy=360.0)
BETWEEN = Interpolation(max_gap_s=0.2, max_extrapolation_s=0.1)
T_NS = (np.arange(0, 6, 1 / 30) * 1e9).astype(np.int64)
LOG = Trajectory(T_NS, np.zeros((len(T_NS), 3)), np.zeros((len(T_NS), 4)))


@dataclass(frozen=True)
class Turning:
    """A camera that nods and swings, each with periods of its own, and moves sideways."""

    phase: float
    frame_t_ns: Int64
    name: str = "drone"
    intrinsics: Intrinsics = LENS
    swings: bool = True
    drift_deg: float = 0.0  # of the log's attitudes, per sqrt(s)
    focal_px: float = LENS.fx
    loosened: None = None
    mount_deg: float = 0.0  # of the log, about the camera's y
    trajectory: Trajectory = LOG

    def poses_at(self, t_ns: Int64, _: Interpolation) -> tuple[Float, Float]:
        """Return position [N, 3] and world_from_camera [N, 3, 3], as the log has them."""
        t_s = t_ns / 1e9
        angle = np.zeros((len(t_s), 3))
        angle[:, 1] = 0.2 * self.swings * np.sin(1.9 * t_s + self.phase)
        angle[:, 0] = 0.1 * self.swings * np.sin(2.6 * t_s + 2 * self.phase)
        position = np.stack([0.5 * t_s, np.zeros_like(t_s), np.zeros_like(t_s)], axis=1)
        turned = matrix_from_quaternion(quaternion_from_rotation_vector(angle))
        at_s = np.arange(-2, 9, 0.01)
        steps = np.random.default_rng(7).normal(0, 0.1 * np.radians(self.drift_deg), (len(at_s), 3))
        walk = np.cumsum(steps, axis=0)
        error = np.stack([np.interp(t_s, at_s, column) for column in walk.T], axis=1)
        error[:, 1] += np.radians(self.mount_deg)
        return position, turned @ matrix_from_quaternion(quaternion_from_rotation_vector(error))

    def followed(self) -> Followed:
        """Follow points 8 to 30 m away, to 0.3 px, at the true times of the pictures."""
        rng = np.random.default_rng(int(10 * self.phase))
        points = np.column_stack(
            [rng.uniform(-12, 15, 200), rng.uniform(-6, 6, 200), rng.uniform(8, 30, 200)]
        )
        position, rotation = replace(self, drift_deg=0.0, mount_deg=0.0).poses_at(T_NS, BETWEEN)
        seen = np.einsum("tji,tkj->tki", rotation, points[None] - position[:, None])
        pixels = seen[..., :2] / seen[..., 2:] * LENS.fx + [LENS.cx, LENS.cy]
        pixels += rng.normal(0, 0.3, pixels.shape)
        inside = ((pixels > 0) & (pixels < [LENS.width, LENS.height])).all(axis=-1)
        picture, point = np.nonzero(inside)
        tracks = Tracks(picture, point, pixels[picture, point])
        return Followed(np.arange(len(T_NS)), np.array([0]), [lambda: tracks])


def found(cameras: list[Turning]) -> Lateness | None:
    team: list[Any] = list(cameras)
    turns = {index: turns_of(camera, camera.followed()) for index, camera in enumerate(team)}
    return next(iter(lateness(team, turns, BETWEEN, [int(each.frame_t_ns[0]) for each in team])), None)


def late(seconds: float, phase: float, slower: float = 1.0) -> Turning:
    """Return a camera whose clock says later times than are true, by seconds and a factor."""
    return Turning(phase, (T_NS * slower).astype(np.int64) + round(seconds * 1e9))


@pytest.mark.parametrize("swings", [True, False], ids=["right clocks", "cameras that do not turn"])
def test_right_clocks_and_cameras_that_do_not_turn_raise_no_doubt(swings: bool) -> None:
    still = Turning(0.1, T_NS + 500_000_000, swings=False)
    clock = found([late(0.0, 0.1), late(0.0, 1.3)] if swings else [still, still])
    assert clock is None or clock.gain < 5


@pytest.mark.parametrize("seconds", [(0.5, 0.5), (-0.3, -0.3), (0.0, 0.4)])
def test_a_delay_of_all_cameras_or_of_one_is_found(seconds: tuple[float, float]) -> None:
    clocks = found([late(seconds[0], 0.1), late(seconds[1], 1.3)])
    assert clocks is not None
    assert clocks.cameras == tuple(np.flatnonzero(seconds))
    assert clocks.gain > 50
    assert clocks.late_s == pytest.approx(-seconds[1], abs=0.03)  # of steps of 0.1 s, by a parabola


@pytest.mark.parametrize("slower", [1.2, 1.0])
def test_a_frame_rate_of_all_cameras_or_of_one_is_found(slower: float) -> None:
    rate = found([late(0.0, 0.1, slower), late(0.0, 1.3, 1.2)])
    assert rate is not None
    assert rate.cameras == ((0, 1) if slower > 1 else (1,))
    assert rate.slower == pytest.approx(25 / 30)


def test_a_frame_rate_counts_from_the_first_picture_of_the_flight() -> None:
    """Look at pictures from 2.4 s on, as `check` does, of cameras whose rate is stated wrongly."""
    whole: list[Any] = [late(0.0, phase, 1.2) for phase in (0.1, 1.3)]
    turns = {index: turns_of(camera, camera.followed()) for index, camera in enumerate(whole)}
    part = [replace(camera, frame_t_ns=camera.frame_t_ns[60:]) for camera in whole]
    starts = [int(camera.frame_t_ns[0]) for camera in part]
    first, *_ = lateness(part, turns, BETWEEN, [0, 0])
    assert first.slower == pytest.approx(25 / 30)
    assert first.gain > 50 + max(each.gain for each in lateness(part, turns, BETWEEN, starts))


@pytest.mark.parametrize("seconds", [0.53, -0.37])
def test_an_offset_of_all_clocks_is_found_to_a_third_of_a_picture(seconds: float) -> None:
    """Two cameras tell it, a third was not followed: 0.3 px of 800 px focal length over 0.4 rad a second."""
    team: list[Any] = [replace(late(seconds, phase), name=f"drone{phase}") for phase in (0.1, 1.3)]
    followed = {camera.name: camera.followed() for camera in team}
    team.append(replace(late(seconds, 0.7), name="third"))
    found = common_offset(team, followed, BETWEEN)
    assert found is not None
    assert found.cameras == (0, 1, 2)
    assert found.late_s == pytest.approx(-seconds, abs=0.01)
    assert 0 < found.sigma_s < 0.05


def test_clocks_that_nearly_fit_are_left_alone() -> None:
    team: list[Any] = [late(0.1, 0.1)]
    assert common_offset(team, {"drone": team[0].followed()}, BETWEEN) is None
    assert common_offset(team, {}, BETWEEN) is None


@pytest.mark.parametrize(("seconds", "stated"), [(0.06, False), (-0.11, True), (0.74, False)])
def test_each_camera_that_turns_has_its_clock_from_its_background(seconds: float, stated: bool) -> None:
    """A log that drifts: 0.1 deg in a second beside up to 22 deg a second."""
    names = ["drone0", "drone1"]
    team: list[Any] = [
        replace(late(seconds, 0.3 + 0.9 * k), name=name, drift_deg=0.1) for k, name in enumerate(names)
    ]
    followed: dict[str, Any] = {camera.name: camera.followed() for camera in team}
    errors = pose_errors([Drift(rotation_deg_per_sqrt_s=0.1)]) if stated else None
    offset_s, sigma_s = clocks_of_backgrounds(
        team, followed, [errors] * len(team), np.full(len(team), 0.5), between=BETWEEN
    )
    squares = np.square((offset_s + seconds) / sigma_s)
    assert (sigma_s < 0.01).all()
    assert squares.mean() < 9.2 / 2  # 99 % of chi-square with two degrees of freedom


@pytest.mark.parametrize("astray_s", [-2.4, 1.6])
def test_a_search_that_goes_astray_misleads_no_clock(
    monkeypatch: pytest.MonkeyPatch, astray_s: float
) -> None:
    """Turning repeats: from another period the adjustment finds a wrong offset, or none."""
    camera: Any = replace(late(0.06, 0.3), drift_deg=0.1)
    astray = Lateness((0,), astray_s, 1.0, 20.0, 0.02)
    monkeypatch.setattr("pipelines.reconstruction.background.common_offset", lambda *_: astray)
    followed: dict[str, Any] = {camera.name: camera.followed()}
    offset_s, _ = clocks_of_backgrounds([camera], followed, [None], np.array([0.5]), between=BETWEEN)
    assert offset_s == pytest.approx(-0.06, abs=0.03)


def test_no_clock_is_found_that_is_known_or_that_nothing_shows() -> None:
    team: list[Any] = [late(0.1, 0.1), late(0.1, 0.4), replace(late(0.1, 0.7), swings=False)]
    team = [replace(camera, name=f"drone{k}") for k, camera in enumerate(team)]
    followed: dict[str, Any] = {camera.name: camera.followed() for camera in team}
    followed["drone1"] = "its video cannot be read"
    offset_s, sigma_s = clocks_of_backgrounds(
        team, followed, [None] * 3, np.array([0.0, 0.2, 0.2]), between=BETWEEN
    )
    assert np.isnan(offset_s).all()
    assert np.isnan(sigma_s).all()


def test_a_clock_that_is_stated_well_hardly_moves() -> None:
    """Expect the mean of 0, stated to 2 ms, and the background's offset, weighted by both variances."""
    team: list[Any] = [replace(late(0.02, 0.3), drift_deg=0.3)]
    followed: dict[str, Any] = {"drone": team[0].followed()}
    wide, own_s = clocks_of_backgrounds(team, followed, [None], np.array([0.5]), between=BETWEEN)
    near, stated_s = clocks_of_backgrounds(team, followed, [None], np.array([0.002]), between=BETWEEN)
    share = 1 / (1 + (own_s / 0.002) ** 2)
    assert near == pytest.approx(share * wide, rel=0.01)
    assert stated_s < 0.002


@pytest.mark.parametrize("degrees", [0.0, 12.0])
def test_a_camera_that_looks_beside_its_log_is_found(degrees: float) -> None:
    """A log whose attitudes are turned across the path: as far off as usual ones, it tells nothing."""
    camera: Any = Turning(0.1, T_NS, mount_deg=degrees)
    aside = turned_aside(camera, camera.followed(), BETWEEN)
    assert (aside is not None) == (degrees > 0)
    assert aside is None or np.degrees(aside[0]) == pytest.approx(degrees, abs=1.0)
    (_, true), (at, turned) = (each.poses_at(T_NS, BETWEEN) for each in (Turning(0.1, T_NS), camera))
    logged = replace(camera, trajectory=Trajectory(T_NS, at, quaternion_from_matrix(turned)))
    errors = pose_errors([White(position_m=0.02, rotation_deg=0.2), Bias(rotation_deg=20)])
    mounted = with_known_mount(logged, camera.followed(), errors, BETWEEN)
    away = true.swapaxes(1, 2) @ matrix_from_quaternion(mounted.trajectory.quaternion_xyzw)
    assert np.degrees(np.arccos((np.trace(away, axis1=1, axis2=2) - 1) / 2)).max() < 1.0
