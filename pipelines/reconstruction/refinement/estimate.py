"""Estimate: Gauss-Newton on all unknowns together, with a prior learned from stretches of the flight."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipelines.geometry.arrays import Float
from pipelines.reconstruction.refinement.elimination import (
    Eliminated,
    eliminate,
    step,
)
from pipelines.reconstruction.refinement.levels import reestimated
from pipelines.reconstruction.refinement.memory import lasting, memory_of
from pipelines.reconstruction.refinement.problem import (
    Knowledge,
    Problem,
    State,
    lay_out,
)
from pipelines.reconstruction.refinement.system import System, misfit, prior_cost

BOUND = 3.5
"""Residual, in standard deviations, beyond which an image point's weight falls: one good view in 450."""

REMEMBERED = 1.5
"""Memory (correlation length) of keypoint errors above which it is taken into account."""

_CONVERGED_M = 2e-4
_BOUNDS = (20.0, 8.0, BOUND)
_MOST_GROWTH = 0.15  # of the body in a step: the linearisation in its size is not valid further
_LEAST = 0.01  # smallest share of a step that is tried; it is made even if it raises the cost
_SETTLED = 3  # rounds after which an estimate fits its prior
_WIDE = 4.0  # times the usual residual of the start, because poses are not corrected yet


def solve(
    problem: Problem,
    known: Knowledge,
    state: State,
    *,
    rounds: int,
    bounds: tuple[float, ...] = _BOUNDS,
    most_growth: float = np.inf,
) -> tuple[System, State, Eliminated]:
    """Solve by Gauss-Newton, with steps halved if the cost would rise and a robust bound that tightens.

    A step that would change the logarithm of the body's size by more than `most_growth` is shortened by the
    ratio. The equations returned are those of the last step, within a step of the state.
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
        growth = _growth(system, state, direction)
        whole = share = most_growth / growth if growth > most_growth else 1.0
        while share > _LEAST * whole and not cost(system, state.moved(direction, share)) <= most:
            share /= 2
        state = state.moved(direction, share)
        moved = float(np.sqrt(np.mean((share * direction.position) ** 2)))
        if done >= rounds or (moved < _CONVERGED_M and done >= len(bounds)):
            return system, state, at
        del at  # otherwise the factors of two rounds would be in memory together


def _growth(system: System, state: State, direction: State) -> float:
    """Compute the absolute change of the logarithm of the mean bone length by a step."""
    column = system.layout.bone_column
    lengths, changes = state.shared[column:], direction.shared[column:]
    if not len(lengths):
        return 0.0
    return abs(float(np.log(max(1.0 + changes.mean() / lengths.mean(), _LEAST))))


def cost(system: System, state: State) -> float:
    """Compute minus twice the logarithm of the posterior, up to a constant."""
    return misfit(system, state)[0] + prior_cost(system, state)


def learn(
    problem: Problem, known: Knowledge, state: State, *, poses: bool, rounds: int
) -> tuple[Knowledge, State]:
    """Learn the prior: alternate Gauss-Newton steps and estimates of its parameters.

    Halfway, when residuals contain few pose errors, the memory of keypoint errors is estimated. From then on
    keypoints count less by that factor against slow pose errors. If it exceeds `REMEMBERED`, motion and image
    noise, which vary quickly, are no longer estimated.

    New levels change an estimate little, except for the size of a nearly constant formation: two hovering
    cameras moved by metres in a step, and the misfit was estimated as correlated image noise. Therefore the
    size may change only a little in a step. More steps instead would let it diverge, because the data do not
    determine it there.

    Args:
        problem: stretches of the flight.
        known: initial parameters of the prior.
        state: initial estimate.
        poses: True to estimate the levels of pose errors too.
        rounds: number of rounds.
    """
    for index in range(rounds):
        if index == 0:
            system, state, at = solve(problem, known, state, rounds=len(_BOUNDS))
        else:
            system, state, at = solve(
                problem, known, state, rounds=1, bounds=(BOUND,), most_growth=_MOST_GROWTH
            )
        known = reestimated(system, state, at, poses=poses, motion=known.memory < REMEMBERED)
        if poses and index == rounds // 2:
            memory = memory_of(system, state)
            if memory > REMEMBERED:
                memory = lasting(memory, known.pixel_scale)
            known = replace(known, memory=memory)
    return known, state


def evidence(problem: Problem, known: Knowledge, state: State) -> float:
    """Compute the log evidence of a prior given the pictures, up to a constant of the pictures.

    Laplace's approximation around the estimate under the prior, at most three Gauss-Newton steps from
    `state`. The pictures count as if only one in `known.memory` existed.
    """
    system, state, _ = solve(problem, known, state, rounds=_SETTLED, bounds=(BOUND,))
    at = eliminate(system, state)
    grown = system.grown(state)
    times = len(problem.t_s)
    value = -0.5 * cost(system, state) - at.log_determinant
    value -= 2 * float(problem.pictures.trust.sum()) / known.memory * np.log(known.pixel_scale)
    # Motion and bones in units of the body's size, which has a flat prior.
    _, log_determinant = np.linalg.slogdet(known.acceleration / known.size_m**2)
    value -= 1.5 * (times - 2) * float(log_determinant)
    value -= times * float(np.log(known.bone_sigma_m / known.size_m).sum())
    value -= (state.position.size + len(problem.bones)) * float(np.log(known.size_m * grown))
    there = np.isfinite(system.white_precision[:, 0, 0])
    certainty = np.zeros(len(there))
    certainty[there] = np.linalg.slogdet(system.white_precision[there])[1]
    value += 0.5 * float(certainty[system.white_row].sum())
    for (_, process), (at_knots, column) in zip(system.layout.processes, system.layout.place, strict=True):
        value -= 3 * float(np.log(process.sigma0))
        if at_knots:
            value -= 0.5 * float(np.log(system.tie_variance[:, column : column + 3]).sum())
    return float(value)


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
        np.zeros((len(problem.knot_t_s), layout.knot_count)),
        shared,
        np.zeros((len(problem.pictures.first), 6)),
    )
