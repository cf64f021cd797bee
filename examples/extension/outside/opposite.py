"""Fly on the other side of the actor than a fixed formation would."""

import numpy as np

from pipelines.planning.formation import FormationPath, formation_slots


class Opposite:
    name, title = "opposite", "fixed yaw, on the other side"

    def start(self, config, *, drones, yaw_rad):
        return _Planner(config, drones, yaw_rad + np.pi)


class _Planner:
    def __init__(self, config, drones, yaw_rad):
        self.config = config
        self.slots = formation_slots(
            np.array([yaw_rad]), drones, tilt_rad=config.tilt_rad, range_m=config.radius_m
        )

    def plan(self, t_s, commanded, actor, field):
        return FormationPath(np.array([t_s]), self.slots, np.array(self.config.slot_rates))


ARM = Opposite()
