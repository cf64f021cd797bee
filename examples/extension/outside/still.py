"""A detector for tests of rigs: it sees one person in the middle of every picture, who never moves."""

import numpy as np

from pipelines.session.registries import Person, Region


class Still:
    name, title = "still", "one person who never moves"

    def models(self):
        return {}

    def fetch(self, source=None):
        pass

    def load(self, *, threads):
        return _Networks()


class _Networks:
    joints = ("left_hip", "right_hip")

    def find_people(self, picture):
        height, width = picture.shape[:2]
        return [(Region((width / 2, height / 2), height / 2), 1.0)]

    def locate(self, picture, regions):
        height, width = picture.shape[:2]
        return [
            Person(
                xy=np.array([[width / 2 + 10, height / 2], [width / 2 - 10, height / 2]]),
                confidence=np.ones(2),
                presence=1.0,
                region=region,
            )
            for region in regions
        ]


DETECTOR = Still()
