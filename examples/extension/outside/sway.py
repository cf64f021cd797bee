"""A drone that sways on its tether: its log misses a sine of unknown phase along every axis."""

from dataclasses import dataclass

import numpy as np

from pipelines.geometry.noise import NoiseModel


@dataclass(frozen=True, kw_only=True)
class Sway(NoiseModel):
    position_m: float  # standard deviation
    period_s: float = 4.0

    def marginal_sigma(self, elapsed_s, speed_mps, turn_rate_radps):
        return np.tile([self.position_m, 0.0], (len(elapsed_s), 1))

    def errors(self, t_ns, position, quaternion_xyzw, rng):
        phase = rng.uniform(0, 2 * np.pi, 3)
        angle = 2 * np.pi * ((t_ns - t_ns[:1]) / 1e9)[:, None] / self.period_s + phase
        sway = np.sqrt(2.0) * self.position_m * np.sin(angle)  # a sine's mean square is a half
        return np.concatenate([sway, np.zeros_like(sway)], axis=1)
