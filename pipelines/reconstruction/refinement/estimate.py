"""Estimate: Gauss-Newton on all unknowns together, with a prior learned from stretches of the flight.

The prior's levels (standard deviations of errors and motion) are learned from the data. A variance becomes
the sum of the estimates' squares over the number of them that the data determine, sum of 1 - posterior /
prior variance (MacKay, "Bayesian interpolation", 1992). All levels are estimated together: fitting a constant
error alone to a drifting log was measured to be ten times worse than trusting the log.

Keypoint errors have a memory. A detector is wrong for the same reasons in neighbouring pictures, so they
carry less information than independent pictures: the mean of a stationary error falls as if only one in tau =
1 + 2 sum of its autocorrelations had been taken. A pose error moves all joints of a camera together. The
memory is therefore measured on each joint's residual relative to the other joints. Residuals show only a part
of the error, see `memory_of_whole_error`.
"""

from dataclasses import replace

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from pipelines.geometry.arrays import Float
from pipelines.geometry.noise import ROTATION, PoseErrors, Process
from pipelines.reconstruction.refinement.elimination import Eliminated, Moments, eliminate, moments, step
from pipelines.reconstruction.refinement.kernels import State
from pipelines.reconstruction.refinement.system import (
    REMEMBERED,
    Knowledge,
    Problem,
    System,
    lay_out,
    loss,
    misfit,
    prior_cost,
)

BOUND = 3.5
"""Residual, in standard deviations, beyond which an image point's weight falls: one good view in 450."""


# A step that moves joints by less than this changes no figure.
_CONVERGED_M = 5e-4
BOUNDS = (20.0, 8.0, BOUND)
# Of a step, no smaller share is tried; that is made even if it raises the cost.
_LEAST = 0.01
# The first bounds are so many times the usual residual of the start, because poses are not corrected yet.
_WIDE = 4.0


def solve(
    problem: Problem,
    known: Knowledge,
    state: State,
    *,
    rounds: int,
    bounds: tuple[float, ...] = BOUNDS,
) -> tuple[System, State, Eliminated]:
    """Solve by Gauss-Newton, with steps halved if the cost would rise and a robust bound that tightens.

    The equations returned are those of the last step, within a step of the state.
    """
    layout = lay_out(known.poses, known.clock_sigma_s, len(problem.bones), problem.knot_t_s)
    done = 0
    while True:
        done += 1
        bound = bounds[min(done, len(bounds)) - 1]
        if done < len(bounds):
            _, residual, _ = misfit(System(problem, known, layout, bound**2), state)
            bound = max(bound, _WIDE * float(np.sqrt(np.nanmedian((residual**2).sum(axis=-1)))))
        # With noisy poses the start jumps from picture to picture. The motion prior scales with the body, so
        # the body would grow to explain these jumps: bone lengths are held at first.
        system = System(problem, known, layout, bound**2, held=done < len(bounds))
        at = eliminate(system, state)
        direction = step(system, at)
        most = cost(system, state) * (1 + 1e-9)
        share = 1.0
        while share > _LEAST and not cost(system, state.moved(direction, share)) <= most:
            share /= 2
        state = state.moved(direction, share)
        moved = float(np.sqrt(np.mean((share * direction.position) ** 2)))
        if done >= rounds or (moved < _CONVERGED_M and done >= len(bounds)):
            return system, state, at
        del at  # otherwise the factors of two rounds would be in memory together


def cost(system: System, state: State) -> float:
    """Compute minus twice the logarithm of the posterior, up to a constant."""
    return loss(system, state) + prior_cost(system, state)


def learn(
    problem: Problem, known: Knowledge, state: State, *, poses: bool, memory: bool, rounds: int
) -> tuple[Knowledge, State]:
    """Learn the prior: alternate Gauss-Newton steps and estimates of its parameters.

    Halfway, when residuals contain few pose errors, the memory of keypoint errors is estimated. From then on
    keypoints count less by that factor against slow pose errors. If it exceeds `REMEMBERED`, motion and image
    noise, which vary quickly, are no longer estimated.

    `poses` and `memory` are True to estimate the levels of pose errors, and the memory of keypoints.
    """
    for index in range(rounds):
        if index == 0:
            system, state, at = solve(problem, known, state, rounds=len(BOUNDS))
        else:
            system, state, at = solve(problem, known, state, rounds=1, bounds=(BOUND,))
        known = reestimated(system, state, at, poses=poses, motion=known.memory < REMEMBERED)
        del at  # as in `solve`
        if memory and index == rounds // 2:
            tau = memory_of(system, state)
            if tau > REMEMBERED:
                tau = memory_of_whole_error(tau, known.pixel_scale)
            known = replace(known, memory=tau)
            if not poses and tau > REMEMBERED:
                break  # nothing is left to be learned
    return known, state


def initial_state(problem: Problem, known: Knowledge, position: Float) -> State:
    """Build the initial state: no corrections, and each bone's length its median over the times."""
    layout = lay_out(known.poses, known.clock_sigma_s, len(problem.bones), problem.knot_t_s)
    shared = np.zeros(layout.shared_count)
    if len(problem.bones):
        ends = position[:, problem.bones]
        lengths = np.linalg.norm(ends[:, :, 1] - ends[:, :, 0], axis=-1)
        shared[layout.bone_column :] = np.median(lengths, axis=0)
    return State(
        np.ascontiguousarray(position),  # of one layout: everything is compiled for that
        np.zeros((len(problem.knot_t_s), layout.entries.knot_count)),
        shared,
        np.zeros((len(problem.pictures.first), 6)),
    )


# --- levels --------------------------------------------------------------------------------------------

# Pictures of every third time are enough to estimate image noise and white errors.
_EVERY = 3
_BODY_ACCELERATION, _BODY_COUNT = 1.5, 3.0  # m/s^2, weight of this prior; the simulated walk's is 1.1
# No combination of joints accelerates by less (m/s^2); smaller priors make the equations singular.
_LEAST_ACCELERATION = 0.1
# Bones of a detector vary by more than this.
_LEAST_BONE_M = 0.001
# Levels move this much farther than the goal of a round, on a logarithmic scale, to save rounds.
_STRIDE = 1.5
# A level of which data determine a smaller share stays unchanged.
_LEAST_DETERMINED = 0.03
_CHANGES = (0.04, 6.0)  # bounds of the change of a variance in one round
_MOST_OF_CONSTANT = 1.6
"""Upper bound for constant errors: they are only a few numbers, and can diverge with the scale."""
_LEAST_WHITE = (1e-4, 1e-5)  # m, rad
_LEAST_CONSTANT = (1e-3, 1e-4)
_LEAST_RATE = (1e-4, 1e-5)


def reestimated(system: System, state: State, at: Eliminated, *, poses: bool, motion: bool) -> Knowledge:
    """Estimate the prior's parameters again from the posterior: of `poses`, pooled, and of `motion`."""
    known = system.knowledge
    found = moments(system, state, at, every=_EVERY)
    if poses:
        known = replace(known, poses=_poses(system, found))
    if not motion:
        return known
    grown = system.grown(state)
    before = known.bone_sigma_m * grown
    bones = before * (np.sqrt(found.bones / found.times) / before) ** _STRIDE
    squares, determined = found.image.sum(axis=0)
    scale = known.pixel_scale * float(np.sqrt(squares / max(determined, 1.0)))
    return replace(
        known,
        acceleration=_acceleration(known.acceleration * grown**2, found, _bodies(system.problem)),
        bone_sigma_m=np.maximum(bones, _LEAST_BONE_M),
        size_m=known.size_m * grown,
        pixel_scale=scale,
    )


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
    known = np.maximum(shares, _LEAST_DETERMINED)
    estimate = axes.T @ (squares - variance) @ axes + np.diag(known - shares)
    for body in bodies.T:
        along = axes.T @ inverse @ body
        precision = float(along @ along)
        shared = np.outer(along, along) / precision * _BODY_COUNT / found.times
        estimate = estimate + shared * _BODY_ACCELERATION**2 * precision
        known = known + np.diagonal(shared)
    goal = estimate / np.sqrt(known[:, None] * known)
    changes, turned = np.linalg.eigh((goal + goal.T) / 2)
    changes = np.clip(np.maximum(changes, _CHANGES[0]) ** _STRIDE, *_CHANGES)
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


def _change(squares: float, determined: float, count: float) -> float:
    """Compute the factor on a variance from the mean square of estimates and the share the data determine."""
    known = max(determined / count, _LEAST_DETERMINED)
    goal = (squares / count + known - determined / count) / known
    return float(np.clip(max(goal, 1e-9) ** _STRIDE, *_CHANGES))


def _poses(system: System, found: Moments) -> tuple[PoseErrors, ...]:
    """Estimate the levels of pose errors, the same for all cameras."""
    known, layout = system.knowledge, system.layout
    knot_s = float(layout.knot_t_s[1] - layout.knot_t_s[0])
    before = known.poses[0].white_with_stray(knot_s)
    stray2 = before**2 - np.square(known.poses[0].white)
    white = []
    for part in range(2):
        squares, count, determined = found.white[part]
        if count == 0:
            white.append(0.0)
            continue
        variance = before[part] ** 2
        estimates = squares / variance - (count - determined)
        wanted = variance * _change(estimates, determined, count) - stray2[part]
        white.append(max(float(np.sqrt(max(wanted, 0.0))), _LEAST_WHITE[part]))
    by_place: dict[int, list[tuple[bool, int]]] = {}
    for (camera, process), place in zip(layout.processes, layout.place, strict=True):
        by_place.setdefault(known.poses[camera].processes.index(process), []).append(place)
    processes = [
        _process(process, by_place[index], found, layout.entries.knot_count)
        for index, process in enumerate(known.poses[0].processes)
    ]
    return (PoseErrors((white[0], white[1]), tuple(processes)),) * len(known.poses)


def _process(process: Process, places: list[tuple[bool, int]], found: Moments, knot_count: int) -> Process:
    part = 1 if process.number == ROTATION else 0
    columns = np.concatenate([np.arange(3) + column for _, column in places])
    at_knots = places[0][0]
    starting = found.starting[columns if at_knots else columns + knot_count]
    variance = process.sigma0**2
    determined = float(np.sum(1 - starting[:, 1] / variance))
    estimates = float(np.sum(starting[:, 0] - starting[:, 1])) / variance
    sigma0 = process.sigma0 * np.sqrt(min(_change(estimates, determined, len(columns)), _MOST_OF_CONSTANT))
    rate = 0.0
    if process.rate > 0:
        squares, count, spread = found.walked[columns].sum(axis=0)
        determined = count - spread / process.rate**2
        estimates = (squares - spread) / process.rate**2
        rate = max(process.rate * float(np.sqrt(_change(estimates, determined, count))), _LEAST_RATE[part])
    return replace(process, sigma0=max(float(sigma0), _LEAST_CONSTANT[part]), rate=rate)


# --- memory of keypoint errors -------------------------------------------------------------------------

# Correlations of keypoint errors over longer times cannot be told from motion.
_LONGEST_S = 2.0
# A smaller autocorrelation is chance, and the sum stops there.
_STOPS = 0.02
# A longer memory cannot be measured in stretches of sixty times.
_MOST = 30.0


def memory_of(system: System, state: State) -> float:
    """Estimate tau, the number of neighbouring residuals that count as one independent one, from 1 to 30."""
    problem = system.problem
    pictures = problem.pictures
    _, residual, _ = misfit(system, state)
    far = (residual**2).sum(axis=-1) > system.bound2
    residual = np.where(far[..., None], np.nan, residual)
    cameras = np.unique(pictures.camera)
    # A picture without any inlier joint contributes nothing.
    own = residual - np.nansum(residual, axis=1, keepdims=True) / np.maximum(
        np.sum(~np.isnan(residual), axis=1, keepdims=True), 1
    )
    lags = max(int(_LONGEST_S / system.usual_step_s), 1)
    products, counts = np.zeros(lags + 1), np.zeros(lags + 1)
    for camera in cameras:
        (mine,) = np.nonzero(pictures.camera == camera)
        order = mine[np.argsort(pictures.when_s[mine], kind="stable")]
        step_s = float(np.median(np.diff(pictures.when_s[order]))) if len(order) > 1 else 1.0
        place = np.round((pictures.when_s[order] - pictures.when_s[order[0]]) / step_s).astype(np.int64)
        values = np.full((int(place[-1]) + 1, *own.shape[1:]), np.nan)
        values[place] = own[order]
        for lag in range(min(lags, len(values) - 1) + 1):
            product = values[: len(values) - lag] * values[lag:]
            products[lag] += np.nansum(product)
            counts[lag] += np.isfinite(product).sum()
    if counts[0] == 0:
        return 1.0
    # Of the 2 C numbers that C cameras see of a slow error, the joint's position absorbs three.
    shown = (2 * len(cameras) - 3) / (2 * len(cameras))
    correlation = products / np.maximum(counts, 1) / (products[0] / counts[0])
    tau = 1.0
    for value in correlation[1:]:
        if value < _STOPS:
            break
        tau += 2 * float(value) / shown
    return min(tau, _MOST)


def memory_of_whole_error(memory: float, pixel_scale: float) -> float:
    """Compute the memory of image points if part of their error does not show in residuals.

    The error of a single point is known beforehand: for a detector, the measured one. Residuals show only
    the share s = `pixel_scale` of it if the rest lasts, and joints and cameras follow it. The mean of N
    points has (s^2 + (1 - s^2) tau) / N times the stated variance, where s^2 / N was counted.
    """
    return max(memory, 1.0 + (pixel_scale**-2 - 1.0) * memory)
