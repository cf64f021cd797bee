"""Keypoints of a person who is alone in the pictures, for studies and replays."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipelines.geometry.arrays import Float, Picture
from pipelines.keypoints.hints import Hint
from pipelines.keypoints.tracking import PeopleTracker
from pipelines.session.registries import KeypointNetworks


class FollowedAlone:
    """Tracker of the only person in the pictures of one camera, built on `PeopleTracker`.

    Args:
        networks: the detector, loaded.
        joints: the J whose keypoints are wanted; those that the detector does not have are never found.
    """

    def __init__(self, networks: KeypointNetworks, joints: Sequence[str]) -> None:
        self._tracker = PeopleTracker(networks, only_one=True)
        self._column = [networks.joints.index(name) if name in networks.joints else None for name in joints]

    def step(self, picture: Picture, *, hint: Hint | None) -> tuple[Float, Float]:
        """Return the keypoints of the person with the highest presence in the next picture.

        Args:
            picture: [H, W, 3] BGR.
            hint: place of the person by the log, None if unknown.

        Returns:
            Positions [J, 2] px, NaN for joints not found, and confidences [J], 0 for joints not found.
        """
        xy, confidence = np.full((len(self._column), 2), np.nan), np.zeros(len(self._column))
        people = self._tracker.step(picture, hint=hint)
        if people:
            person = max(people, key=lambda seen: seen.person.presence).person
            for j, k in enumerate(self._column):
                if k is not None:
                    xy[j], confidence[j] = person.xy[k], person.confidence[k]
        confidence[np.isnan(xy).any(axis=-1)] = 0.0
        return xy, confidence
