"""Share of a flight in which a wall hides the actor, against similar triangles."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipelines.geometry.cameras import Intrinsics
from pipelines.planning.loading import LoggedFlight, SessionCamera
from pipelines.planning.scene import hidden_shares
from pipelines.session.description import Description
from pipelines.session.records import Occupancy, Trajectory

START_NS = 1_700_000_000_000_000_000
WALK_S = 20
EAST_M = 20.0  # of the way, along north = 0


def _flight(*positions: tuple[float, float, float]) -> LoggedFlight:
    """Return the flight of an actor who walks 20 m east in 20 s; cameras stand still."""
    t_ns = START_NS + np.arange(WALK_S + 1) * 1_000_000_000
    actor = np.stack(
        [np.linspace(0, EAST_M, WALK_S + 1), *np.zeros((1, WALK_S + 1)), np.ones(WALK_S + 1)], axis=-1
    )
    lens = Intrinsics(640, 480, 500.0, 500.0, 319.5, 239.5, "none", (), 0.0)
    cameras = tuple(
        SessionCamera(
            f"c{k}", lens, Trajectory(t_ns[:1], np.array([place]), np.array([[0.0, 0.0, 0.0, 1.0]])), True, ()
        )
        for k, place in enumerate(positions)
    )
    return LoggedFlight(
        actor_t_ns=t_ns,
        actor=actor[:, None],
        actor_source="log",
        hips=None,
        skeleton=None,
        skeleton_source=None,
        cameras=cameras,
        poses_source="log",
        noise_source="nobody",
        planned={},
        warnings=(),
    )


CAMERA = {
    "intrinsics": {
        "width": 640,
        "height": 480,
        "fx": 1,
        "fy": 1,
        "cx": 0,
        "cy": 0,
        "model": "none",
        "distortion": [],
        "readout_s": 0,
    },
    "frames": {"count": 1, "first_t_ns": START_NS, "last_t_ns": START_NS, "rate_hz": None},
    "poses": {
        "source": "",
        "static": False,
        "count": 1,
        "rate_hz": None,
        "gaps_ns": [],
        "frames_without_pose": 0,
        "dropped": {},
    },
    "keypoints": None,
    "clock": {"offset_s": 0, "sigma_s": 0},
    "pose_noise": None,
    "media": None,
}
DESCRIPTION = Description.model_validate(
    {
        "schema": 1,
        "flight": "",
        "clock_reference": "c0",
        "pose_interpolation": {"max_gap_s": 0.5, "max_extrapolation_s": 0.1},
        "cameras": {"c0": CAMERA},
        "truth": None,
        "sources": {},
        "warnings": [],
    }
)


def _wall() -> Occupancy:
    """Make a wall from 8 to 12 m east, 9 to 10 m north, 6 m high, in voxels of 0.25 m.

    All voxels north of it are unknown.
    """
    probability = np.full((80, 80, 40), 0.1, dtype=np.float32)
    probability[32:48, 36:40, :24] = 0.9
    probability[:, 40:] = np.nan
    return Occupancy(probability, np.zeros(3), 0.25)


def test_a_wall_hides_what_similar_triangles_say() -> None:
    # From 20 m north of the middle: the wall's near edges, 10 m away, hide 4 m to each side of the middle.
    shares = hidden_shares(_flight((10, 20, 1), (10, -15, 1), (10, 20, 20)), DESCRIPTION, [_wall()])
    assert shares["c0"] == pytest.approx(8 / EAST_M, abs=2 / 200)
    assert shares["c1"] == 0.0  # the wall stands on the other side
    # From 20 m up the sight line passes the wall's far edge at 9.55 m and its near edge at 10.5 m.
    assert shares["c2"] == 0.0


def test_a_map_counts_from_its_own_time_on() -> None:
    flight, wall = _flight((10, 20, 1)), _wall()
    gone = replace(wall, probability=np.full((4, 4, 4), 0.1, np.float32), from_ns=START_NS + 10_000_000_000)
    # The wall is gone when the actor is half way, which is in the middle of what it hides.
    assert hidden_shares(flight, DESCRIPTION, [gone, wall])["c0"] == pytest.approx(4 / EAST_M, abs=2 / 200)
    late = replace(wall, from_ns=START_NS + 10_000_000_000)
    assert hidden_shares(flight, DESCRIPTION, [late])["c0"] == pytest.approx(4 / EAST_M, abs=2 / 200)
