"""The arms that are compared: ways to choose the slots of the cameras.

All share forecast, local planner and tracking. An arm is one object with a name that starts a
`FormationPlanner` for a flight; a package adds one by an entry point in `mocap.planner_arms`.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from pipelines.geometry.arrays import Float
from pipelines.planning.config import PlannerConfig
from pipelines.planning.distance_field import DistanceField
from pipelines.planning.forecast import Forecast
from pipelines.planning.formation import (
    YAW,
    FormationPath,
    formation_slots,
    slot_offsets,
    yaw_set,
)
from pipelines.planning.information import log_determinant, ray_information
from pipelines.planning.search import (
    Formations,
    Lattice,
    SlotCosts,
    best_sequence,
    cheapest_slots,
    cost_map,
    costs_in_frame,
    costs_of_slots,
    error_map,
    lattice,
    slot_weights,
    turn_the_shorter_way,
)
from pipelines.session.registries import Registry

_TOO_NEAR = 100.0  # cost of a slot within the separation of another drone's: more than any gain


class FormationPlanner(Protocol):
    """Planner that chooses the slots of the cameras during one flight."""

    def plan(self, t_s: float, commanded: Float, actor: Forecast, field: DistanceField) -> FormationPath:
        """Plan anew.

        All yaws, those of the path as well, count from `actor.heading_rad`: 0, which is east, unless
        `yaw_frame` is `heading`. A planner that samples the field must add it; others can ignore it.

        Args:
            commanded: [n, 3] the slots that are commanded now (yaw rad, tilt rad, range m).
            actor: forecast at the knots t_s + knot_s, t_s + 2 knot_s, ...
        """


class Arm(Protocol):
    """A way to plan formations."""

    @property
    def name(self) -> str:
        """Name that the user writes after `--arms`."""

    @property
    def title(self) -> str:
        """Name in reports."""

    def start(self, config: PlannerConfig, *, drones: int, yaw_rad: float) -> FormationPlanner:
        """Return a planner for a flight whose first camera starts at that yaw."""


@dataclass(frozen=True)
class _FixedArm:
    name: str = "fixed"
    title: str = "fixed yaw"

    def start(self, config: PlannerConfig, *, drones: int, yaw_rad: float) -> FormationPlanner:
        return _Fixed(config, drones, yaw_rad)


@dataclass(frozen=True)
class _SearchingArm:
    name: str
    title: str
    predicts_error: bool = False

    def start(self, config: PlannerConfig, *, drones: int, yaw_rad: float) -> FormationPlanner:
        return _Formation(config, drones, yaw_rad, predicts_error=self.predicts_error)


@dataclass(frozen=True)
class _GreedyArm:
    name: str = "greedy"
    title: str = "each drone on its own, most information first"

    def start(self, config: PlannerConfig, *, drones: int, yaw_rad: float) -> FormationPlanner:
        return _Greedy(config, drones, yaw_rad)


PLANNER_ARMS: Registry[Arm] = Registry("mocap.planner_arms", "planner arm")
FIXED: Arm = _FixedArm()
ADAPTIVE: Arm = _SearchingArm("adaptive", "adaptive formation")
COVARIANCE: Arm = _SearchingArm("covariance", "adaptive formation, predicted error", predicts_error=True)
GREEDY: Arm = _GreedyArm()


class _Fixed:
    """Planner that keeps the yaw of the start; only the local planner gives way."""

    def __init__(self, config: PlannerConfig, drones: int, yaw_rad: float) -> None:
        self._slots = formation_slots(
            np.array([yaw_rad]), drones, tilt_rad=config.tilt_rad, range_m=config.radius_m
        )
        self._rates = np.array(config.slot_rates)

    def plan(self, t_s: float, commanded: Float, actor: Forecast, field: DistanceField) -> FormationPath:  # noqa: ARG002
        return FormationPath(np.array([t_s]), self._slots, self._rates)


class _Formation:
    """Planner with the whole formation as one state.

    The state is the yaw (Ho et al.), or yaw, tilt and range to predict errors.
    """

    def __init__(self, config: PlannerConfig, drones: int, yaw_rad: float, *, predicts_error: bool) -> None:
        tilts = np.radians(config.tilts_deg) if predicts_error else np.array([config.tilt_rad])
        ranges = np.array(config.ranges_m) if predicts_error else np.array([config.radius_m])
        yaws = config.lattice_yaws if predicts_error else config.yaws
        self._every = config.lattice_knots if predicts_error else 1
        states = _all_states(yaw_set(yaws, yaw_rad), tilts, ranges)
        self._lattice = lattice(
            states,
            rates=np.array(config.slot_rates),
            knot_s=self._every * config.knot_s,
            w_turn=config.w_turn,
        )
        first = formation_slots(np.zeros(len(states)), drones, tilt_rad=0.0, range_m=0.0)
        self._slots = states[:, None] + first  # [S, n, 3]
        self._offsets = slot_offsets(self._slots)
        self._config, self._predicts_error = config, predicts_error
        self._formations = Formations(self._lattice, self._slots, self._offsets)
        self._weights = slot_weights(config)
        self._rates = np.array(config.slot_rates)

    def plan(self, t_s: float, commanded: Float, actor: Forecast, field: DistanceField) -> FormationPath:
        config = self._config
        if self._predicts_error or config.yaw_frame == "heading":
            costs = _look(field, actor.each(self._every), self._slots, self._offsets, config)
            cost = cost_map(costs, config)
            if self._predicts_error:  # the error does not depend on the zero of yaws
                # Its logarithm: a gain is worth the same, however large the errors of the session are.
                cost += config.w_error * np.log(error_map(costs, self._offsets, config))
            sequence, _ = best_sequence(cost, self._lattice, commanded[0])
            through = _through(commanded, self._slots[sequence])
        else:  # the same in one call: calls between small parts took most of the time
            position = np.ascontiguousarray(actor.position)
            through = cheapest_slots(
                field.grid, field.sight, position, self._formations, self._weights, commanded
            )
        return FormationPath(_knots(t_s, through, self._lattice), through, self._rates)


class _Greedy:
    """Planner for one drone after the other, each on its own lattice, by its gain over those before.

    Bucker et al. 2020 (arXiv 2011.05437), solved sequentially, with the marginal log-det of the ray model's
    information in place of their diversity of views.
    """

    def __init__(self, config: PlannerConfig, drones: int, yaw_rad: float) -> None:
        start = formation_slots(np.array(yaw_rad), drones, tilt_rad=config.tilt_rad, range_m=config.radius_m)
        tilts, ranges = np.radians(config.tilts_deg), np.array(config.ranges_m)
        self._lattices = [
            lattice(
                _all_states(yaw_set(config.lattice_yaws, slot[YAW]), tilts, ranges),
                rates=np.array(config.slot_rates),
                knot_s=config.lattice_knots * config.knot_s,
                w_turn=config.w_turn,
            )
            for slot in start
        ]
        self._offsets = [slot_offsets(each.states) for each in self._lattices]
        self._information = [ray_information(offsets, config.errors) for offsets in self._offsets]
        self._config, self._rates = config, np.array(config.slot_rates)

    def plan(self, t_s: float, commanded: Float, actor: Forecast, field: DistanceField) -> FormationPath:
        config = self._config
        actor = actor.each(config.lattice_knots)
        knots = len(actor.position)
        known = np.zeros((knots, 1, 3, 3)) + np.eye(3) / config.prior_sigma_m**2
        taken: list[Float] = []
        slots = np.empty((knots, len(self._lattices), 3))
        for i, (grid, offsets, information) in enumerate(
            zip(self._lattices, self._offsets, self._information, strict=True)
        ):
            costs = _look(field, actor, grid.states[:, None], offsets[:, None], config)
            free = (costs.occluded == 0.0)[..., None]  # [T, S, 1, 1] once more below
            gained = free[..., None].reshape(*free.shape[:2], 1, 1) * information
            gain = log_determinant(known + gained) - log_determinant(known)
            cost = cost_map(costs, config) - config.w_error * gain
            for other in taken:
                apart = np.linalg.norm(offsets - other[:, None], axis=-1)
                cost += np.where(apart < config.soft_separation_m, _TOO_NEAR, 0.0)
            sequence, _ = best_sequence(cost, grid, commanded[i])
            at = np.arange(knots)
            known = known + gained[at, sequence][:, None]
            taken.append(offsets[sequence])
            slots[:, i] = grid.states[sequence]
        through = _through(commanded, slots)
        return FormationPath(_knots(t_s, through, self._lattices[0]), through, self._rates)


def _all_states(yaws: Float, tilts: Float, ranges: Float) -> Float:
    """Return every combination, [S, 3]."""
    return np.stack(np.meshgrid(yaws, tilts, ranges, indexing="ij"), axis=-1).reshape(-1, 3)


def _look(
    field: DistanceField, actor: Forecast, slots: Float, offsets: Float, config: PlannerConfig
) -> SlotCosts:
    """Compute the costs of slots [S, n, 3]; `offsets` [S, n, 3] are valid if yaws count from east."""
    if config.yaw_frame == "heading":
        return costs_in_frame(field, actor, slots, config)
    return costs_of_slots(field, actor.position, offsets, config)


def _through(commanded: Float, slots: Float) -> Float:
    """Return the commanded slots [n, 3], then slots [T, n, 3], each turn the shorter way round."""
    through = np.concatenate([commanded[None], slots])
    turn_the_shorter_way(through)
    return through


def _knots(t_s: float, through: Float, grid: Lattice) -> Float:
    return t_s + grid.knot_s * np.arange(len(through), dtype=np.float64)
