"""The estimate: Gauss-Newton on everything at once, its prior found from stretches of the flight."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipelines.reconstruction.refinement.elimination import (
    System,
    Visit,
    misfit,
    posterior,
    prior_cost,
    step,
)
from pipelines.reconstruction.refinement.levels import reestimated
from pipelines.reconstruction.refinement.problem import (
    Knowledge,
    Problem,
    State,
    lay_out,
)

Float = NDArray[np.float64]

BOUND = 3.5
"""Standard deviations of an image point beyond which its weight falls: one good view in 450."""

_CONVERGED_M = 2e-4
_BOUNDS = (20.0, 8.0, BOUND)
_WIDE = 4.0  # times the usual residual of the start: poses are not corrected yet


def solve(
    problem: Problem, known: Knowledge, state: State, *, rounds: int, bounds: tuple[float, ...] = _BOUNDS
) -> tuple[System, State, int]:
    """Gauss-Newton with halved steps where the cost would rise; the robust bound tightens as it goes."""
    layout = lay_out(known.poses, known.clock_sigma_s, len(problem.bones), problem.knot_t_s)
    done = 0
    for done in range(1, rounds + 1):
        bound = bounds[min(done, len(bounds)) - 1]
        if done < len(bounds):
            _, squared, _ = misfit(System(problem, known, layout, bound**2), state)
            bound = max(bound, _WIDE * float(np.sqrt(np.nanmedian(squared))))
        system = System(problem, known, layout, bound**2)
        direction, _ = step(system, state)
        cost = _cost(system, state)
        share = 1.0
        while share > 0.01 and not _cost(system, state.moved(direction, share)) <= cost * (1 + 1e-9):
            share /= 2
        state = state.moved(direction, share)
        moved = float(np.sqrt(np.mean((share * direction.position) ** 2)))
        if moved < _CONVERGED_M and done >= len(bounds):
            break
    return System(problem, known, layout, bounds[-1] ** 2), state, done


def _cost(system: System, state: State) -> float:
    return misfit(system, state)[0] + prior_cost(system, state)


def covariances(system: System, state: State) -> Float:
    """Posterior covariance [T, J, 3, 3] of every joint at every time."""
    joints = system.problem.joints
    n = 3 * joints
    result = np.empty((len(system.problem.t_s), joints, 3, 3))
    last = len(result) - 3
    pick = 3 * np.arange(joints)[:, None] + np.arange(3)

    def see(visit: Visit) -> None:
        for offset in range(3) if visit.time == last else (0,):
            place = pick + offset * n
            result[visit.time + offset] = visit.covariance[place[:, :, None], place[:, None, :]]

    posterior(system, state, see)
    return result


def learn(
    problem: Problem, known: Knowledge, state: State, *, poses: bool, rounds: int
) -> tuple[Knowledge, State]:
    """Alternate Gauss-Newton steps and reestimates of the prior's parameters."""
    for index in range(rounds):
        bounds = _BOUNDS if index == 0 else (BOUND,)
        system, state, _ = solve(problem, known, state, rounds=3 if index == 0 else 1, bounds=bounds)
        known = reestimated(system, state, poses=poses)
    return known, state


def initial_state(problem: Problem, known: Knowledge, position: Float) -> State:
    """No corrections, bones as long as in the median picture."""
    layout = lay_out(known.poses, known.clock_sigma_s, len(problem.bones), problem.knot_t_s)
    shared = np.zeros(layout.shared_count)
    if len(problem.bones):
        ends = position[:, problem.bones]
        lengths = np.linalg.norm(ends[:, :, 1] - ends[:, :, 0], axis=-1)
        shared[layout.bone_column :] = np.median(lengths, axis=0)
    return State(
        position,
        np.zeros((len(problem.knot_t_s), layout.knot_count)),
        shared,
        np.zeros((len(problem.pictures.first), 6)),
    )
