"""A person's motion between the moments of pictures, which a rolling shutter needs."""

import numpy as np

from pipelines.simulation.flight import fly_scenario
from pipelines.simulation.scenario import Scenario


def test_a_moment_alone_is_as_in_the_whole_flight() -> None:
    """A repeated script depends on how far it is planned: always to the flight's last moment.

    Planned only to the moment asked for, the hip is up to 1.4 mm beside the truth.
    """
    steps = {"steps": [{"walk": {"distance_m": 1.5, "turn_deg": 90}}], "repeat": True}
    flight = fly_scenario(
        Scenario.model_validate({"schema": 1, "duration_s": 4, "actor": {"motion": steps}}), []
    )
    (person,) = flight.people
    for row in range(0, len(flight.t_ns), 8):
        alone = person.moving(flight.t_ns[[row]] / 1e9)
        np.testing.assert_array_equal(alone.root[0], person.motion.root[row])
        np.testing.assert_array_equal(alone.rotation[0], person.motion.rotation[row])
