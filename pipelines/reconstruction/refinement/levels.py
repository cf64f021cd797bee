"""Estimates of the prior's parameters from the data: levels (standard deviations) of errors and motion.

A variance becomes the sum of the estimates' squares over the number of them that the data determine,
sum of 1 - posterior / prior variance (MacKay, "Bayesian interpolation", 1992). Its fixed points are those
of expectation maximisation (Dempster, Laird & Rubin 1977), which was measured to be too slow here: if
pictures carry little information on a level, eight rounds left it near its start. All levels are estimated
together: fitting a constant error alone to a drifting log was measured to be ten times worse than trusting
the log.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from pipelines.geometry.arrays import Float
from pipelines.reconstruction.refinement.elimination import Eliminated, Moments, moments
from pipelines.reconstruction.refinement.problem import (
    ROTATION,
    Knowledge,
    PoseErrors,
    Problem,
    Process,
    State,
)
from pipelines.reconstruction.refinement.system import System

_GAP = 3.0  # usual steps: between stretches of a flight
_EVERY = 3  # pictures of every third time are enough to estimate image noise and white errors
_BODY_ACCELERATION, _BODY_COUNT = 1.5, 3.0  # m/s^2, weight of this prior; the simulated walk's is 1.1
_LEAST_ACCELERATION = 0.1  # m/s^2, along any combination of joints
_LEAST_BONE_M = 0.001
_STRIDE = 1.5  # overshoot of a step over its goal, on a logarithmic scale
_LEAST_TOLD = 0.03  # least share of a level determined by data: levels without data stay unchanged
_BOUNDS = (0.04, 6.0)  # of the change of a variance in one round
_MOST_OF_CONSTANT = 1.6
"""Upper bound for constant errors: they are only a few numbers, and can diverge with the scale."""
_LEAST_WHITE = (1e-4, 1e-5)  # m, rad
_LEAST_CONSTANT = (1e-3, 1e-4)
_LEAST_RATE = (1e-4, 1e-5)


def reestimated(system: System, state: State, at: Eliminated, *, poses: bool, motion: bool) -> Knowledge:
    """Estimate the prior's parameters again from the posterior at `state`.

    Args:
        system: the problem with the parameters so far.
        state: the estimate with them.
        at: the equations that it solves.
        poses: True to estimate the levels of pose errors, pooled over the cameras.
        motion: True to estimate those of motion, bones and keypoints.
    """
    known = system.knowledge
    found = moments(system, state, at, every=_EVERY)
    if poses:
        known = replace(known, poses=_poses(system, found))
    if not motion:
        return known
    grown = system.grown(state)
    before = known.bone_sigma_m * grown
    bones = before * (np.sqrt(found.bones / found.times) / before) ** _STRIDE
    squares, told = found.image.sum(axis=0)
    scale = known.pixel_scale * float(np.sqrt(squares / max(told, 1.0)))
    return replace(
        known,
        acceleration=_acceleration(known.acceleration * grown**2, found, _bodies(system.problem)),
        bone_sigma_m=np.maximum(bones, _LEAST_BONE_M),
        size_m=known.size_m * grown,
        pixel_scale=scale,
    )


def shrunk(acceleration: Float, t_s: Float, position: Float) -> Float:
    """Shrink the correlations of a covariance of accelerations [J, J] according to the flight's length.

    Limbs repeat their motion, so a short flight has few independent accelerations, and some combination of
    joints seems to stay at rest by chance. With that prior, posterior covariances were a third
    too small. Correlations are multiplied by 1 - sum var(r) / sum r^2 (Schafer & Strimmer, "A shrinkage
    approach to large-scale covariance matrix estimation", 2005), where var(r) is (1 - r^2)^2 / (N - 1) and N
    the number of accelerations over 1 + 2 sum rho^2 of their autocorrelation (Bartlett 1946).

    Args:
        acceleration: [J, J] (m/s^2)^2, as estimated.
        t_s: [T] times (s).
        position: [T, J, 3] m, the estimate from which it was computed.
    """
    joints = len(acceleration)
    if joints < 2:
        return acceleration
    steps = np.diff(t_s)
    velocity = np.diff(position, axis=0) / steps[:, None, None]
    whole = np.maximum(steps[1:], steps[:-1]) < _GAP * np.median(steps)
    change = (np.diff(velocity, axis=0) / (0.5 * (steps[1:] + steps[:-1]))[:, None, None])[whole]
    unit = change / np.sqrt(np.maximum(np.mean(change**2, axis=(0, 2)), 1e-12))[:, None]
    lags = range(1, len(unit) // 4)
    repeated = 1 + 2 * sum(float(np.mean(unit[lag:] * unit[:-lag])) ** 2 for lag in lags)
    independent = 3 * len(unit) / repeated
    deviation = np.sqrt(np.diagonal(acceleration))
    correlation2 = (acceleration / np.outer(deviation, deviation))[~np.eye(joints, dtype=bool)] ** 2
    chance = float(np.sum((1 - correlation2) ** 2)) / max(independent - 1, 1.0)
    share = min(chance / max(float(correlation2.sum()), 1e-12), 1.0)
    return (1 - share) * acceleration + share * np.diag(deviation**2)


def limber(acceleration: Float, spread: float) -> Float:
    """Enlarge accelerations relative to the body's for the estimate of joints, if views are imprecise.

    The accelerations of limbs repeat in a gait and are not white as in the prior. With imprecise views,
    joints are averaged over longer times, and more of their swings would be lost. Standard deviations
    relative to the body grow with those of triangulated points. The body is the best-determined mean under
    A: that of all joints with weights A^-1 1, whose variance stays 1 / (1' A^-1 1).

    Args:
        acceleration: [J, J] (m/s^2)^2, A, as estimated.
        spread: standard deviation of a triangulated point over that of its rays; no change below 1.
    """
    body = np.full_like(acceleration, 1 / np.linalg.inv(acceleration).sum())
    return body + max(spread, 1.0) ** 2 * (acceleration - body)


def _acceleration(before: Float, found: Moments, bodies: Float) -> Float:
    """Estimate the covariance of accelerations, in coordinates where the previous one is the identity.

    With noisy poses, a flight of 2 s determines less than one acceleration of a body as a whole (`bodies`
    [J, P], 1 for its joints). The acceleration of walking bodies is added as a prior with the weight of
    `_BODY_COUNT` accelerations.
    """
    values, vectors = np.linalg.eigh(before)
    root, inverse = (vectors * values**power @ vectors.T for power in (0.5, -0.5))
    squares, variance = (inverse @ part @ inverse / found.times for part in found.acceleration)
    shares, axes = np.linalg.eigh(np.eye(len(before)) - (variance + variance.T) / 2)
    known = np.maximum(shares, _LEAST_TOLD)
    estimate = axes.T @ (squares - variance) @ axes + np.diag(known - shares)
    for body in bodies.T:
        along = axes.T @ inverse @ body
        precision = float(along @ along)
        shared = np.outer(along, along) / precision * _BODY_COUNT / found.times
        estimate = estimate + shared * _BODY_ACCELERATION**2 * precision
        known = known + np.diagonal(shared)
    goal = estimate / np.sqrt(known[:, None] * known)
    changes, turned = np.linalg.eigh((goal + goal.T) / 2)
    changes = np.clip(np.maximum(changes, _BOUNDS[0]) ** _STRIDE, *_BOUNDS)
    turned = axes @ turned
    further = root @ (turned * changes @ turned.T) @ root
    values, vectors = np.linalg.eigh((further + further.T) / 2)
    floored: Float = vectors * np.maximum(values, _LEAST_ACCELERATION**2) @ vectors.T
    return floored


def _bodies(problem: Problem) -> Float:
    """Mark the joints of each body, the joints that bones connect: [J, P], 1 for its joints."""
    joints = problem.joints
    ends = problem.bones
    graph = coo_array((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(joints, joints))
    count, label = connected_components(graph, directed=False)
    return np.eye(count)[label]


def _change(squares: float, told: float, count: float) -> float:
    """Compute the factor on a variance from the mean square of estimates and the share the data determine."""
    known = max(told / count, _LEAST_TOLD)
    goal = (squares / count + known - told / count) / known
    return float(np.clip(max(goal, 1e-9) ** _STRIDE, *_BOUNDS))


def _poses(system: System, found: Moments) -> tuple[PoseErrors, ...]:
    """Estimate the levels of pose errors, the same for all cameras."""
    known, layout = system.knowledge, system.layout
    knot_s = float(layout.knot_t_s[1] - layout.knot_t_s[0])
    before = known.poses[0].white_with_stray(knot_s)
    stray2 = before**2 - np.square(known.poses[0].white)
    white = []
    for part in range(2):
        squares, count, told = found.white[part]
        if count == 0:
            white.append(0.0)
            continue
        variance = before[part] ** 2
        estimates = squares / variance - (count - told)
        wanted = variance * _change(estimates, told, count) - stray2[part]
        white.append(max(float(np.sqrt(max(wanted, 0.0))), _LEAST_WHITE[part]))
    by_place: dict[int, list[tuple[bool, int]]] = {}
    for (camera, process), place in zip(layout.processes, layout.place, strict=True):
        by_place.setdefault(known.poses[camera].processes.index(process), []).append(place)
    processes = [
        _process(process, by_place[index], found, layout.knot_count)
        for index, process in enumerate(known.poses[0].processes)
    ]
    return (PoseErrors((white[0], white[1]), tuple(processes)),) * len(known.poses)


def _process(process: Process, places: list[tuple[bool, int]], found: Moments, knot_count: int) -> Process:
    part = 1 if process.number == ROTATION else 0
    columns = np.concatenate([np.arange(3) + column for _, column in places])
    at_knots = places[0][0]
    starting = found.starting[columns if at_knots else columns + knot_count]
    variance = process.sigma0**2
    told = float(np.sum(1 - starting[:, 1] / variance))
    estimates = float(np.sum(starting[:, 0] - starting[:, 1])) / variance
    sigma0 = process.sigma0 * np.sqrt(min(_change(estimates, told, len(columns)), _MOST_OF_CONSTANT))
    rate = 0.0
    if process.rate > 0:
        squares, count, spread = found.walked[columns].sum(axis=0)
        told = count - spread / process.rate**2
        estimates = (squares - spread) / process.rate**2
        rate = max(process.rate * float(np.sqrt(_change(estimates, told, count))), _LEAST_RATE[part])
    return replace(process, sigma0=max(float(sigma0), _LEAST_CONSTANT[part]), rate=rate)
