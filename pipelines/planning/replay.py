"""Offline replay of an arm, with the logged actor and the maps that were known at each time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Bool, Float
from pipelines.geometry.poses import look_at
from pipelines.planning.arms import Arm
from pipelines.planning.config import PlannerConfig
from pipelines.planning.distance_field import DistanceField, open_space
from pipelines.planning.formation import YAW, slot_of
from pipelines.planning.guard import Flown, Guard
from pipelines.planning.local import Separation
from pipelines.planning.pilot import Pilot, PlanningTimes
from pipelines.planning.sight import visible

Int64 = NDArray[np.int64]
Mode = Literal["plan-only", "closed-loop"]


@dataclass(frozen=True)
class ReplayResult:
    """A replayed flight of N cameras at T times, one per tracking step."""

    arm: str
    t_ns: Int64  # [T] on the clock of the actor's log
    position: Float  # [N, T, 3] metres, world
    velocity: Float  # [N, T, 3] m/s
    quaternion_xyzw: Float  # [N, T, 4] world_from_camera, aimed at the estimate
    slots: Float  # [N, T, 3] commanded: yaw (rad from east, continuous), tilt (rad), range (m)
    tilt_rad: Float  # [N, T] flown, above the logged actor
    visible: Bool  # [N, T] True where nothing is between camera and logged actor, by the last map
    actor: Float  # [T, 3] the log, interpolated
    estimate: Float  # [T, 3] the planner's estimate of the actor
    separation: dict[str, int]  # local plans by `Separation`
    safety: dict[str, int]  # local plannings by `guard.Flown`
    times: PlanningTimes  # measured, different from run to run

    @property
    def t_s(self) -> Float:
        """Seconds [T] since the start."""
        seconds: Float = (self.t_ns - self.t_ns[0]) / 1e9
        return seconds

    @property
    def formation_yaw_rad(self) -> Float:
        """Yaw [T] of the first camera's slot, continuous."""
        return self.slots[0, :, YAW]


def replay(
    arm: Arm,
    actor_t_ns: Int64,
    actor: Float,
    fields: Sequence[DistanceField],
    *,
    config: PlannerConfig,
    drones: int,
    yaw_rad: float = 0.0,
    heading_rad: float = 0.0,
    mode: Mode = "closed-loop",
    seed: int = 0,
    clock: Callable[[], float] = perf_counter,
) -> ReplayResult:
    """Fly an arm against a log. Equal arguments give equal results, but for the measured times.

    The drones start in their slots, at rest, and fly what `guard.Guard` admits. The actor is measured as
    logged, with `actor_noise_m` added from the seed; no measurement or map is used before its time.

    Args:
        arm: the planner of the cameras' slots.
        actor_t_ns: [A] stamps of the log, ascending, at least two.
        actor: [A, 3] metres, world, the middle of the hips; rows with NaN were not measured.
        fields: the maps by the time from which they hold; before the first one nothing is known.
        config: weights and rates, the same for all arms of a comparison.
        drones: number of cameras.
        yaw_rad: of the first camera at the start, counterclockwise from east.
        heading_rad: the actor's heading before walking, from east, if `yaw_frame` is `heading`.
        mode: `closed-loop` flies point masses with limited acceleration; `plan-only` puts the drones exactly
            on their local plans.
        seed: of the noise.
        clock: seconds, to measure planning times.

    Raises:
        ValueError: times that do not ascend, or fewer than two measurements.
    """
    t_ns, measured = _checked(actor_t_ns, actor)
    log_s = (t_ns - t_ns[0]) / 1e9
    noise = np.random.default_rng(seed).normal(size=measured.shape)
    noisy = measured + config.actor_noise_m * noise
    maps = sorted(fields, key=lambda field: field.from_ns)
    replay_ns = replay_times(t_ns, config)
    map_at = np.searchsorted([field.from_ns for field in maps], replay_ns, side="right")
    known = [open_space(), *maps]
    taken_in = np.searchsorted(t_ns, replay_ns, side="right")

    pilot = Pilot(arm, config, drones=drones, yaw_rad=yaw_rad, heading_rad=heading_rad, clock=clock)
    pilot.measure(0.0, noisy[0])
    start = pilot.slots_now(0.0)[1]
    guard = pilot.guard = Guard(start, config, exactly=mode == "plan-only")
    shape = (drones, len(replay_ns), 3)
    position, velocity, slots, estimate = (np.empty(s) for s in (shape, shape, shape, shape[1:]))
    done = 1
    for k, now_ns in enumerate(replay_ns):
        t_s = float((now_ns - t_ns[0]) / 1e9)
        for row in range(done, taken_in[k]):
            pilot.measure(log_s[row], noisy[row])
        done = max(done, int(taken_in[k]))
        position[:, k], velocity[:, k] = guard.position, guard.velocity
        pilot.replan(t_s, position[:, k], velocity[:, k], known[map_at[k]])
        slots[:, k], estimate[k] = pilot.wanted(t_s)
        guard.advance()

    truth = np.stack([np.interp(replay_ns, t_ns, measured[:, axis]) for axis in range(3)], axis=-1)
    return ReplayResult(
        arm=arm.name,
        t_ns=replay_ns,
        position=position,
        velocity=velocity,
        quaternion_xyzw=look_at(position, estimate),
        slots=slots,
        tilt_rad=slot_of(position - truth)[..., 1],
        visible=visible(known[-1], position, truth, start_m=config.sight_start_m),
        actor=truth,
        estimate=estimate,
        separation={kind.value: pilot.separation[kind] for kind in Separation},
        safety={kind.value: guard.counts[kind] for kind in Flown},
        times=pilot.times,
    )


def replay_times(actor_t_ns: Int64, config: PlannerConfig) -> Int64:
    """Return the times [T] of a replay: every tracking step from the first measurement to the last."""
    first_ns, last_ns = int(actor_t_ns[0]), int(actor_t_ns[-1])
    period_ns = round(1e9 / config.tracking_hz)
    return first_ns + period_ns * np.arange((last_ns - first_ns) // period_ns + 1, dtype=np.int64)


def _checked(t_ns: Int64, actor: Float) -> tuple[Int64, Float]:
    """Return the rows that were measured."""
    rows = np.isfinite(actor).all(axis=1)
    t_ns, actor = t_ns[rows], actor[rows]
    if len(t_ns) < 2 or (np.diff(t_ns) <= 0).any():
        raise ValueError("a replay needs two measurements of the actor or more, their stamps ascending")
    return t_ns, actor
