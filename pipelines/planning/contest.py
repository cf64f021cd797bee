"""The comparison of arms in metrics.json: scores of each, and differences between them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Bool, Float
from pipelines.planning.arm_flights import LOGGED, ArmFlight
from pipelines.planning.comparison import (
    LEVEL,
    STRETCH_S,
    Estimate,
    common_frames,
    coverage,
    mean_of_trials,
    mean_over_time,
    mpjpe_mm,
)
from pipelines.planning.formation import TILT, slot_of
from pipelines.planning.scene import Scene
from pipelines.planning.scores import score
from pipelines.planning.sight import visible
from pipelines.planning.verdict import broken_limits, verdict

Float32 = NDArray[np.float32]

REFERENCE = "fixed"
"""Arm that the others are compared with; the first arm where it is missing."""


@dataclass(frozen=True)
class Entrant:
    """One arm after its flight."""

    flown: ArmFlight
    error_m: Float32 | None  # [trials, P, J] NaN where not measured; None without a skeleton
    seen_share: float | None  # of joints and cameras
    joint_frames: int


def compare(scene: Scene, entrants: Mapping[str, Entrant]) -> dict[str, Any]:
    """Score every arm and the differences to the reference.

    Errors are compared on common joint-frames: those that all arms measured in a trial, for `mpjpe_mm` and
    for the differences alike. `coverage` is the share that the arm itself measured.
    """
    errors = {name: entrant.error_m for name, entrant in entrants.items() if entrant.error_m is not None}
    shared = common_frames(errors) if errors else None
    arms = {name: _scores(scene, name, entrant, shared) for name, entrant in entrants.items()}
    reference = REFERENCE if REFERENCE in entrants else next(iter(entrants))
    differences = [
        {"arm": name, "against": reference, **_difference(scene, entrant, entrants[reference], shared)}
        for name, entrant in entrants.items()
        if name != reference
    ]
    rules, flight = scene.rules, scene.flight
    broken = [line for name, arm in arms.items() if (line := broken_limits(name, arm, scene.config))]
    return {
        "schema": 1,
        "simulated": True,  # replays are, and every reconstruction error
        "mode": rules.mode,
        "drones": scene.drones,
        "yaw_deg": float(np.degrees(scene.yaw_rad)),
        "duration_s": float(scene.t_s[-1]),
        "actor": {"planned_with": flight.actor_source, "scored_against": scene.actor_source},
        "skeleton": flight.skeleton_source,
        "flown_poses": flight.poses_source,
        "pose_noise_from": flight.noise_source,
        "maps": len(scene.fields),
        "near_obstacle_share": float(scene.near.mean()),
        "trials": rules.trials,
        "seed": rules.seed,
        "intervals": {"level": LEVEL, "errors_over": "trials", "flights_over_stretches_of_s": STRETCH_S},
        "arms": arms,
        "differences": differences,
        "verdict": _verdict(arms, differences, broken),
        "notes": list(scene.notes),
        "warnings": [*broken, *scene.warnings, *_warnings(entrants)],
    }


def _scores(scene: Scene, name: str, entrant: Entrant, shared: Bool | None) -> dict[str, Any]:
    flown = entrant.flown
    found = score(scene.t_s, flown.position, scene.actor, scene.field, scene.config, near=scene.near)
    own, common, covered = _errors(scene, entrant, shared)
    return {
        **found,
        "mpjpe_mm": None if common is None else common.mean,
        "simulated": name not in LOGGED,
        "drones": len(flown.position),
        "local_plans": flown.separation or None,
        "safety": flown.safety or None,
        "reconstruction_error": {
            "simulated": True,
            "mpjpe_mm": _json(common),
            "mpjpe_of_all_it_measured_mm": _json(own),
            "coverage": _json(covered),
            "seen_share": entrant.seen_share,
            "joint_frames": entrant.joint_frames,
        },
    }


def _errors(
    scene: Scene, entrant: Entrant, shared: Bool | None
) -> tuple[Estimate | None, Estimate | None, Estimate | None]:
    """Return the mean error of all measured joint-frames and of the common ones, and the coverage."""
    error, seed = entrant.error_m, scene.rules.seed
    if error is None or shared is None:
        return None, None, None
    measured = np.isfinite(error)
    own, common = (mean_of_trials(mpjpe_mm(error, rows), seed) for rows in (measured, shared & measured))
    return own, common, mean_of_trials(coverage(error, entrant.joint_frames), seed)


def _difference(scene: Scene, one: Entrant, other: Entrant, shared: Bool | None) -> dict[str, Any]:
    """Compute one minus the other, with intervals.

    Both have the same seeds, moments and joint-frames as in the table.
    """
    tilt_deg, hidden = (
        [np.atleast_2d(of(scene, entrant.flown)).mean(axis=0) for entrant in (one, other)]
        for of in (_tilt_deg, _hidden)
    )
    always = np.ones(len(scene.t_ns), dtype=np.bool_)
    seed = scene.rules.seed
    error = cover = None
    if one.error_m is not None and other.error_m is not None and shared is not None:
        both = shared & np.isfinite(one.error_m) & np.isfinite(other.error_m)  # one may have measured none
        error = mean_of_trials(mpjpe_mm(one.error_m, both) - mpjpe_mm(other.error_m, both), seed)
        cover = mean_of_trials(
            coverage(one.error_m, one.joint_frames) - coverage(other.error_m, other.joint_frames), seed
        )
    return {
        "tilt_deg": _json(mean_over_time(tilt_deg[0] - tilt_deg[1], always, scene.stretch, seed)),
        "tilt_near_obstacle_deg": _json(
            mean_over_time(tilt_deg[0] - tilt_deg[1], scene.near, scene.stretch, seed)
        ),
        "occluded_share": _json(mean_over_time(hidden[0] - hidden[1], always, scene.stretch, seed)),
        "mpjpe_mm": _json(error),
        "coverage": _json(cover),
        "simulated": True,
    }


def _tilt_deg(scene: Scene, flown: ArmFlight) -> Float:
    tilt_deg: Float = np.degrees(slot_of(flown.position - scene.actor)[..., TILT])
    return tilt_deg


def _hidden(scene: Scene, flown: ArmFlight) -> Float:
    seen = visible(scene.field, flown.position, scene.actor, start_m=scene.config.sight_start_m)
    return np.where(seen, 0.0, 1.0)


def _verdict(
    arms: Mapping[str, Mapping[str, Any]], differences: Sequence[Mapping[str, Any]], broken: Sequence[str]
) -> str:
    """Name the violated limits, and then compare the arms."""
    if differences:
        wanted = next((each for each in differences if each["arm"] == "adaptive"), differences[0])
        said = verdict(wanted["arm"], wanted["against"], arms, wanted)
    else:
        said = f"{next(iter(arms))} flew alone: there is nothing to compare it with"
    return ". ".join([*broken, said])


def _warnings(entrants: Mapping[str, Entrant]) -> list[str]:
    said = []
    for name, entrant in entrants.items():
        gap_share = float(1.0 - entrant.flown.known.mean())
        if gap_share > 0:
            said.append(
                f"{name}: {100 * gap_share:.1f} % of its poses lie in gaps of the log: straight ways there,"
                " and no pictures"
            )
        if entrant.error_m is not None and not np.isfinite(entrant.error_m).any():
            said.append(f"{name}: not a single joint could be measured from its cameras")
    return said


def _json(estimate: Estimate | None) -> dict[str, object] | None:
    return None if estimate is None else estimate.as_json()
