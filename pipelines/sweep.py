"""Stage `sweep`: an arm flown again from other ranges and tilts and with other numbers of drones.

Every combination is one replay, measured as in a comparison, with the same draws. The table and the figure
show what each costs; combinations that no other one beats in error, way and range are the trade-off.
All simulated.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.planning.comparison import capped_mm, mean_of_trials, measure_alone
from pipelines.planning.loading import load_flight
from pipelines.planning.scene import ReplanSettings, ReplayScene, build_scene
from pipelines.replan import (
    detector_errors,
    error_model,
    fly_and_measure,
    inputs_of,
    read_result,
    refuse_unknown,
    settings_by_name,
)
from pipelines.reporting.arm_figures import draw_tradeoff
from pipelines.reporting.plates import page_style, settled
from pipelines.session.errors import DataError
from pipelines.session.maps import load_maps
from pipelines.session.progress import Progress, Silent
from pipelines.session.stage_records import Stage, StageRecord
from pipelines.session.stages import locked
from pipelines.session.storage import jsonable, read_json, write_json

SWEEP_STAGE = Stage("sweep", revision=1)
MOST_CELLS = 500

_COLUMNS = (
    *("arm", "radius_m", "tilt_deg", "drones", "best", "tradeoff", "capped_mm", "low_mm", "high_mm"),
    *("mpjpe_mm", "pck150", "coverage", "range_m", "mean_tilt_deg", "hidden_share", "blind_s"),
    *("path_m", "energy_kj", "min_clearance_m", "min_separation_m", "min_actor_distance_m", "violations"),
)


@dataclass(frozen=True)
class Over:
    """Values to combine; empty ones keep the value of the settings."""

    radii_m: tuple[float, ...] = ()
    tilts_deg: tuple[float, ...] = ()
    drones: tuple[int, ...] = ()


@dataclass(frozen=True)
class Swept:
    """Result of a sweep."""

    folder: Path
    record: StageRecord
    metrics: dict[str, Any]
    skipped: bool  # True if nothing had changed


@dataclass(frozen=True)
class _Cell:
    arm: str
    radius_m: float
    tilt_deg: float
    drones: int

    @property
    def name(self) -> str:
        return f"{self.arm}-{self.radius_m:g}m-{self.tilt_deg:g}deg-{self.drones}"


def sweep(
    folder: Path,
    settings: ReplanSettings,
    over: Over,
    *,
    force: bool = False,
    progress: Progress | None = None,
) -> Swept:
    """Fly all combinations on a session; an interrupted sweep goes on where it stopped.

    Args:
        settings: of every replay; the arms default to `adaptive`.

    Raises:
        DataError: the session cannot be used, it has no skeleton, or a setting is wrong.
        BusyError: another process writes the session.
    """
    progress = progress or Silent()
    arms = settings.arms or ("adaptive",)
    with locked(folder) as session:
        description, reconstructed, inputs = inputs_of(session)
        refuse_unknown(arms, logged=False)
        stated = settings_by_name(settings) | {"arms": list(arms)} | asdict(over)
        run = session.begin(SWEEP_STAGE, settings=stated, inputs=inputs, force=force)
        if run.finished:
            return Swept(folder, run.record, read_json(folder / "sweep" / "metrics.json"), skipped=True)
        flight = load_flight(folder, description, reconstructed, pose_noise=settings.pose_noise)
        if flight.skeleton is None:
            raise DataError(
                folder,
                "has no skeleton to measure",
                "run `mocap reconstruct` first",
                code="nothing-reconstructed",
            )
        errors = detector_errors(session)
        maps = load_maps(folder) if description.map else []
        model = error_model(errors, flight.skeleton.joints)
        scene = build_scene(flight, maps, description, settings, errors=model)
        cells = _cells(scene, arms, over)
        progress.start("Replaying", len(cells))
        rows, capped = [], []
        for cell in cells:
            own = _scene_of(scene, cell)
            result = read_result(run.chunk(cell.name, partial(fly_and_measure, own, errors, cell.arm)))
            if result.error_m is None:
                raise DataError(
                    folder,
                    "has no skeleton to measure",
                    "run `mocap reconstruct` first",
                    code="nothing-reconstructed",
                )
            capped.append(capped_mm(result.error_m, result.joint_frames))
            rows.append(_row(own, cell, measure_alone(own, cell.arm, result), capped[-1]))
            progress.advance()
        best = _mark(rows, capped, settings.seed)
        metrics = jsonable(
            {
                "schema": 1,
                "simulated": True,
                "trials": settings.trials,
                "seed": settings.seed,
                "keypoints": f"modelled after {errors.detector}",
                "best": best,
                "cells": rows,
                "verdict": _verdict(rows, best),
                "warnings": list(flight.warnings),
            }
        )
        write_json(run.folder / "metrics.json", metrics)
        (run.folder / "table.csv").write_text(_as_csv(rows), encoding="utf-8", newline="\n")
        draw(run.folder, metrics)
        record = run.publish(counts={"replays": len(rows)}, warnings=metrics["warnings"])
    return Swept(folder, record, metrics, skipped=False)


def _cells(scene: ReplayScene, arms: Sequence[str], over: Over) -> list[_Cell]:
    config = scene.config
    cells = [
        _Cell(*values)
        for values in product(
            arms,
            dict.fromkeys(over.radii_m or (config.radius_m,)),
            dict.fromkeys(over.tilts_deg or (config.tilt_deg,)),
            dict.fromkeys(over.drones or (scene.drones,)),
        )
    ]
    if len(cells) > MOST_CELLS:
        raise DataError("replan-sweep", f"{len(cells)} combinations", f"ask for at most {MOST_CELLS}")
    return cells


def _scene_of(scene: ReplayScene, cell: _Cell) -> ReplayScene:
    planner = replace(scene.config, radius_m=cell.radius_m, tilt_deg=cell.tilt_deg)
    return replace(scene, drones=cell.drones, settings=replace(scene.settings, planner=planner))


def _row(
    scene: ReplayScene, cell: _Cell, scores: dict[str, Any], capped: np.ndarray[Any, Any]
) -> dict[str, Any]:
    """Return the figures of one combination; way and energy are those of all drones together."""
    errors = scores["reconstruction_error"]
    estimate = mean_of_trials(capped, scene.settings.seed)
    low, high = estimate.interval if estimate is not None and estimate.interval else (None, None)
    mpjpe, share, covered = (errors[key] for key in ("mpjpe_mm", "pck150", "coverage"))
    return {
        **asdict(cell),
        "best": False,
        "tradeoff": False,
        "capped_mm": None if estimate is None else estimate.mean,
        "low_mm": low,
        "high_mm": high,
        "mpjpe_mm": None if mpjpe is None else mpjpe["mean"],
        "pck150": None if share is None else share["mean"],
        "coverage": None if covered is None else covered["mean"],
        "range_m": scores["range_m"]["mean"],
        "mean_tilt_deg": scores["tilt_deg"]["mean"],
        "hidden_share": scores["occluded_share"],
        "blind_s": scores["blind_s"],
        "path_m": cell.drones * scores["path_m"],
        "energy_kj": cell.drones * scores["energy_kj"],
        "min_clearance_m": scores["min_clearance_m"],
        "min_separation_m": scores["min_separation_m"],
        "min_actor_distance_m": scores["min_actor_distance_m"],
        "violations": sum(scores["limit_violations"].values()),
    }


def _mark(rows: list[dict[str, Any]], capped: Sequence[Any], seed: int) -> dict[str, Any]:
    """Mark the best combination and the trade-off; return the best and those that noise does not tell apart.

    Combinations that violate a limit are left out, unless all do. The trade-off is between the error, the way
    of all drones and the range asked for: nothing on it is beaten or equalled in all three by another.
    """
    kept = [k for k, row in enumerate(rows) if not row["violations"]] or list(range(len(rows)))
    best = min(kept, key=lambda k: float(rows[k]["capped_mm"]))
    rows[best]["best"] = True

    def costs(k: int) -> tuple[float, float, float]:
        return rows[k]["capped_mm"], rows[k]["path_m"], -rows[k]["radius_m"]

    for k in kept:
        beaten = any(
            costs(j) != costs(k) and all(a <= b for a, b in zip(costs(j), costs(k), strict=True))
            for j in kept
        )
        rows[k]["tradeoff"] = not beaten
    alike = []
    for k in kept:
        found = mean_of_trials(capped[k] - capped[best], seed)
        if k != best and found is not None and found.interval and found.interval[0] <= 0.0:
            alike.append(k)
    return {"cell": best, "alike": alike}


def _verdict(rows: Sequence[dict[str, Any]], best: dict[str, Any]) -> str:
    own = rows[best["cell"]]
    words = [
        f"best is {_said(own)}: {own['capped_mm']:.1f} mm over all joints, {100 * own['pck150']:.1f} % within"
        f" 150 mm, {own['path_m']:.0f} m and {own['energy_kj']:.0f} kJ of all drones (simulated)"
    ]
    if best["alike"]:
        words.append(f"Noise does not tell apart {'; '.join(_said(rows[k]) for k in best['alike'])}")
    least = min((row for row in rows if row["tradeoff"]), key=lambda row: float(row["path_m"]))
    if least is not own:
        words.append(f"Shortest is {_said(least)}: {least['path_m']:.0f} m, {least['capped_mm']:.1f} mm")
    return ". ".join(words)


def _said(row: dict[str, Any]) -> str:
    return f"{row['arm']} from {row['radius_m']:g} m at {row['tilt_deg']:g} deg with {row['drones']} drones"


def _as_csv(rows: Sequence[dict[str, Any]]) -> str:
    text = io.StringIO()
    writer = csv.DictWriter(text, _COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


# --- the figure ----------------------------------------------------------------------------------------


def draw(folder: Path, metrics: Mapping[str, Any]) -> None:
    """Write the trade-off as `tradeoff.svg` and `tradeoff.png`; equal rows give equal bytes."""
    with page_style():
        figure = draw_tradeoff(metrics).figure
        with settled(figure):
            figure.savefig(folder / "tradeoff.svg", metadata={"Date": None, "Creator": None})
            figure.savefig(folder / "tradeoff.png", dpi=160, metadata={"Software": None})
