"""Messages that the recorder on board of a simulated drone receives: poses, gimbal, lens, the actor's place.

Messages are those of ROS 2, their fields plain numbers by name; a stamp is nanoseconds since the epoch, and
fields that are zero may be left out. Axes are the world's, east-north-up.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from pipelines.geometry.poses import conjugate, pose_covariance_in_body
from pipelines.simulation.flight import SimulatedDrone, SimulatedFlight, SimulatedPerson

_RECEIVED_NS = 2_000_000  # after a message's own stamp, by the recorder on board
_CAMERA_INFO_NS = 1_000_000_000


class LoggedMessage(NamedTuple):
    """One message, as received."""

    received_ns: int
    topic: str
    type: str
    fields: dict[str, Any]


def logged_messages(flight: SimulatedFlight, drone: SimulatedDrone) -> Iterator[LoggedMessage]:
    """The messages of one drone in the order of receipt; the first drone hears of the actors, too."""
    messages = [*_odometry(flight, drone), *_gimbal(flight, drone), *_camera_infos(flight, drone)]
    if drone is flight.drones[0]:
        for person in flight.people:
            messages += _actor(flight, person)
    for stamp_ns, topic, type_, fields in sorted(messages, key=lambda message: message[:2]):
        yield LoggedMessage(stamp_ns + _RECEIVED_NS, topic, type_, fields)


_Stamped = tuple[int, str, str, dict[str, Any]]


def _odometry(flight: SimulatedFlight, drone: SimulatedDrone) -> Iterator[_Stamped]:
    body = drone.log.body
    covariance = np.zeros((len(body.t_ns), 6, 6))
    if body.covariance is not None:  # ROS turns about fixed axes
        covariance = pose_covariance_in_body(body.covariance, conjugate(body.quaternion_xyzw))
    for k, stamp_ns in enumerate((body.t_ns + flight.scenario.start_ns).tolist()):
        pose = {"position": _xyz(body.position[k]), "orientation": _xyzw(body.quaternion_xyzw[k])}
        fields = {
            "header": {"stamp": stamp_ns, "frame_id": "world"},
            "child_frame_id": f"{drone.name}/body",
            "pose": {"pose": pose, "covariance": covariance[k]},
        }
        yield stamp_ns, f"/{drone.name}/odometry", "nav_msgs/msg/Odometry", fields


def _gimbal(flight: SimulatedFlight, drone: SimulatedDrone) -> Iterator[_Stamped]:
    stamps = (drone.log.body.t_ns + flight.scenario.start_ns).tolist()
    for stamp_ns, attitude in zip(stamps, drone.log.gimbal_xyzw, strict=True):
        header = {"stamp": stamp_ns, "frame_id": "world"}
        fields = {"header": header, "quaternion": _xyzw(attitude)}
        yield stamp_ns, f"/{drone.name}/gimbal", "geometry_msgs/msg/QuaternionStamped", fields


def _camera_infos(flight: SimulatedFlight, drone: SimulatedDrone) -> Iterator[_Stamped]:
    lens = drone.intrinsics
    fields = {
        "width": lens.width,
        "height": lens.height,
        "distortion_model": "rational_polynomial" if len(lens.distortion) > 5 else "plumb_bob",
        "d": [*lens.distortion, *[0.0] * (5 - len(lens.distortion))],
        "k": [lens.fx, 0.0, lens.cx, 0.0, lens.fy, lens.cy, 0.0, 0.0, 1.0],
        "r": np.eye(3),
        "p": [lens.fx, 0.0, lens.cx, 0.0, 0.0, lens.fy, lens.cy, 0.0, 0.0, 0.0, 1.0, 0.0],
    }
    first, last = drone.log.body.t_ns[[0, -1]] + flight.scenario.start_ns
    for stamp_ns in range(int(first), int(last), _CAMERA_INFO_NS):
        header = {"stamp": stamp_ns, "frame_id": f"{drone.name}/camera"}
        yield (
            stamp_ns,
            f"/{drone.name}/camera/camera_info",
            "sensor_msgs/msg/CameraInfo",
            {"header": header, **fields},
        )


def _actor(flight: SimulatedFlight, person: SimulatedPerson) -> Iterator[_Stamped]:
    sigma = person.look.estimate_sigma_m
    covariance = np.diag([sigma**2] * 3 + [0.0] * 3)
    for stamp_ns, place in zip(
        (person.estimate_ns + flight.scenario.start_ns).tolist(), person.estimate, strict=True
    ):
        pose = {"position": _xyz(place), "orientation": {"w": 1.0}}
        fields = {
            "header": {"stamp": stamp_ns, "frame_id": "world"},
            "pose": {"pose": pose, "covariance": covariance},
        }
        yield stamp_ns, person.topic, "geometry_msgs/msg/PoseWithCovarianceStamped", fields


def _xyz(vector: np.ndarray[Any, Any]) -> dict[str, float]:
    return dict(zip("xyz", vector.tolist(), strict=True))


def _xyzw(quaternion: np.ndarray[Any, Any]) -> dict[str, float]:
    return dict(zip("xyzw", quaternion.tolist(), strict=True))
