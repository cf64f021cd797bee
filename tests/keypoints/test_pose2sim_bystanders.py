"""Real recording: four static cameras, one person of interest, bystanders in two of the views."""

import json
import tomllib
from pathlib import Path

import numpy as np

from pipelines.geometry.arrays import Float
from pipelines.keypoints.association import Surroundings, associate
from tests.real_data import real_data

CAMERAS = ("cam01", "cam02", "cam03", "cam04")
FRAMES = 100
JOINTS = 25
MOST_PEOPLE = 3
NOISE_PX = 10.0  # the published result reprojects at 10.7 px (median over all views)


def people(folder: Path, camera: str, frame: int) -> list[Float]:
    """Read x, y, confidence [J, 3] of all people in one picture; skip entries without keypoints."""
    found = json.loads((folder / f"{camera}_json" / f"{camera}.{frame:04d}.json").read_text())["people"]
    return [np.array(one["pose_keypoints_2d"]).reshape(JOINTS, 3) for one in found if one]


def test_the_person_of_interest_is_the_one_the_peer_associated() -> None:
    """Compare with Pose2Sim's own association, which tries all combinations of detections.

    It names a person in 399 of the 400 camera-frames and we choose that detection in 398. The other
    one is frame 37 of cam01, where the detector took the person for two: the peer keeps the upper body with
    11 joints, we keep the 14 joints below. In the camera-frame it leaves empty (cam03, 52) we find the
    person.
    """
    import cv2

    recording = real_data("pose2sim_single")
    calibration = tomllib.loads((recording / "calibration" / "Calib_qualisys.toml").read_text())
    shape = (FRAMES, len(CAMERAS))
    xy = np.full((*shape, MOST_PEOPLE, JOINTS, 2), np.nan)
    confidence = np.zeros((*shape, MOST_PEOPLE, JOINTS))
    fields: list[Float] = []
    position, rotation, sigma = np.empty((*shape, 3)), np.empty((*shape, 3, 3)), np.empty(shape)
    for c, camera in enumerate(CAMERAS):
        one = calibration[camera]
        matrix, distortion = np.array(one["matrix"]), np.array(one["distortions"])
        corners = np.array([[[0.0, 0.0]], [[float(x) for x in one["size"]]]])
        fields.append(cv2.undistortPoints(corners, matrix, distortion).ravel())
        world_from_camera = cv2.Rodrigues(np.array(one["rotation"]))[0].T
        rotation[:, c] = world_from_camera
        position[:, c] = -world_from_camera @ np.array(one["translation"])
        sigma[:, c] = NOISE_PX / matrix[0, 0]
        for t in range(FRAMES):
            for d, body in enumerate(people(recording / "pose", camera, t)):
                xy[t, c, d] = cv2.undistortPoints(body[:, None, :2].copy(), matrix, distortion)[:, 0]
                confidence[t, c, d] = body[:, 2]

    seen = (np.arange(FRAMES) / 60.0, xy, confidence, position, rotation, sigma)
    result = associate(*seen)

    agreed = named = 0
    for c, camera in enumerate(CAMERAS):
        for t in range(FRAMES):
            theirs = people(recording / "pose-associated", camera, t)
            chosen = result.choice[t, c, 0]
            named += len(theirs)
            if theirs and chosen >= 0:
                agreed += np.array_equal(people(recording / "pose", camera, t)[chosen], theirs[0])
    assert named == 399
    assert agreed >= 398
    assert result.views[0] == 400
    assert np.all(result.people == 2)  # one bystander stands in the view of two cameras
    everybody = associate(*seen, people=None, scene=Surroundings(None, np.array(fields)))
    assert np.array_equal(everybody.choice, result.choice)  # and is behind the other two: no second person
    assert everybody.phantoms == {"bystander": 1}
