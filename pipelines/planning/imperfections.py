"""Imperfections of a flight that a replay leaves out unless they are set (`config.Imperfections`)."""

import numpy as np

from pipelines.geometry.arrays import Bool, Float
from pipelines.geometry.poses import look_at
from pipelines.planning.config import Imperfections, PlannerConfig
from pipelines.planning.formation import wrapped

# A link that breaks comes back within seconds.
OUTAGE_S = 2.0
# Gusts at the height of drones last for seconds.
GUST_S = 2.0
# Outages and gusts are the same for every arm: they are drawn by the comparison's seed and these numbers.
OUTAGE_STREAM, GUST_STREAM = 1, 2
# Gusts blow half as strongly upwards as along level axes.
GUST_SHARES = (1.0, 1.0, 0.5)
# Rotors of small drones drag by 0.2 to 0.5 of the air's speed a second (Faessler et al. 2018).
DRAG_PER_S = 0.3


def outages(t_s: Float, imperfections: Imperfections, seed: int) -> Bool:
    """Mark the times [T], ascending, at which drones hear nobody: stretches of 2 s, by chance."""
    blocks = np.asarray((t_s - t_s[0]) // OUTAGE_S, dtype=np.int64)
    lost = np.random.default_rng([seed, OUTAGE_STREAM]).random(blocks[-1] + 1) < imperfections.outage_share
    lost[0] = False
    found: Bool = lost[blocks]
    return found


def blown(position: Float, t_s: Float, config: PlannerConfig, seed: int) -> Float:
    """Add the way to which Gauss-Markov gusts push drones at [N, T, 3] m off their tracks, as they track."""
    gust_mps = config.imperfections.gust_mps
    if not gust_mps:
        return position
    rng, tuning = np.random.default_rng([seed, GUST_STREAM]), config.tuning
    off, rate, total = (np.zeros((len(position), 3)) for _ in range(3))
    sigma_mps = gust_mps * np.array(GUST_SHARES)
    gust = sigma_mps * rng.standard_normal(off.shape)
    pushed = np.zeros_like(position)
    for k, step_s in enumerate(np.diff(t_s), start=1):
        kept = np.exp(-step_s / GUST_S)
        gust = kept * gust + np.sqrt(1 - kept**2) * sigma_mps * rng.standard_normal(off.shape)
        total = total + off * step_s
        feedback = tuning.k_position * off + tuning.k_velocity * rate + tuning.k_integral * total
        rate = rate + (DRAG_PER_S * gust - feedback) * step_s
        off = off + rate * step_s
        pushed[:, k] = off
    return position + pushed


def aimed(position: Float, target: Float, t_s: Float, imperfections: Imperfections) -> Float:
    """Return world_from_camera [N, T, 4] of gimbals that follow targets [N, T, 3] within their limits."""
    low, high = np.radians(imperfections.gimbal_pitch_deg)
    way = target - position
    level = np.hypot(way[..., 0], way[..., 1])
    yaw, pitch = np.arctan2(way[..., 1], way[..., 0]), np.arctan2(way[..., 2], level)
    inside = np.clip(pitch, low, high)
    if imperfections.gimbal_deg_per_s is not None:
        most = np.radians(imperfections.gimbal_deg_per_s) * np.diff(t_s)
        for k, step in enumerate(most, start=1):
            yaw[:, k] = yaw[:, k - 1] + np.clip(wrapped(yaw[:, k] - yaw[:, k - 1]), -step, step)
            inside[:, k] = inside[:, k - 1] + np.clip(inside[:, k] - inside[:, k - 1], -step, step)
    elif (inside == pitch).all():
        return look_at(position, target)
    axis = np.stack([np.cos(inside) * np.cos(yaw), np.cos(inside) * np.sin(yaw), np.sin(inside)], axis=-1)
    return look_at(position, position + axis)
