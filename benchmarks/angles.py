"""Joint angles and gait against a simulated body's: the corpus' flights, rendered, with a real detector.

    python -m benchmarks.angles --flights tuning                        # constants may be tuned on these
    python -m benchmarks.angles --flights kept --write                  # and docs/angles.md gets the tables
    python -m benchmarks.angles --opensim SESSION [--peer POSE2SIM.mot] # beside OpenSim's inverse kinematics

Each flight is reconstructed by `auto` from logs with errors, and by `robust` from the true poses (the floor:
what the detector alone leaves). Angles are compared with two truths:

- those of the true joints, COCO's points of the skin, which all errors of this project refer to;
- those of the bones: the centres of the joints about which the simulated body turns, and its soles.
"""

from __future__ import annotations

import argparse
import io
import shlex
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any
from unittest.mock import patch

import cv2
import numpy as np
import pandas as pd

from benchmarks.accuracy import FLOOR, METHODS, chosen_flights
from benchmarks.corpus.drawn import DrawnFlight, kept_in_place_of_pictures
from benchmarks.corpus.stored import DETECTORS, Flight, flights
from benchmarks.results_page import markdown_table
from pipelines.detect import detect
from pipelines.export import export
from pipelines.follow import Following
from pipelines.geometry.arrays import Float
from pipelines.geometry.gait import gait_events, summary
from pipelines.geometry.joint_angles import ANGLES, joint_angles
from pipelines.reconstruct import Settings, reconstruct
from pipelines.session.people import true_joints_at
from pipelines.session.stages import locked
from pipelines.session.tables import ANGLES as ANGLES_TABLE
from pipelines.session.tables import TRUTH, motion_from, read_table
from pipelines.simulation.rig import BONE, SIDES, joint_centres, sole_points

PAGE = Path(__file__).parents[1] / "docs" / "angles.md"
BEGIN, END = "<!-- python -m benchmarks.angles --write -->", "<!-- end -->"
_BONE_OF = {
    "hip": "thigh",
    "knee": "shank",
    "ankle": "foot",
    "shoulder": "upper_arm",
    "elbow": "forearm",
    "wrist": "hand",
}
_PARTS = {name.removeprefix("left_").removeprefix("right_"): None for name in ANGLES}
_GAIT = ("cadence_per_min", "step_m", "speed_mps")


@dataclass(frozen=True)
class Measured:
    """Angles of person 0 of one reconstruction, [T, A] in degrees, and three figures of the gait."""

    value: Float
    sigma: Float
    by_joints: Float  # the true angles, by the true joints
    by_bones: Float
    gait: list[float] | None  # of _GAIT
    true_gait: list[float] | None  # by the bones


def main() -> None:
    """Measure and print the tables; write the page if asked."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--flights", nargs="+", default=["kept"], help="tuning, kept, all, or names")
    parser.add_argument("--detector", choices=DETECTORS, default=DETECTORS[1])
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--write", action="store_true", help="write the tables of docs/angles.md")
    parser.add_argument("--opensim", type=Path, help="compare a session's angles with OpenSim's instead")
    parser.add_argument("--peer", type=Path, help="a motion of the same times by Pose2Sim's own chain")
    arguments = parser.parse_args()
    if arguments.opensim:
        print("\n".join(beside_opensim(arguments.opensim, arguments.peer)))
        return
    chosen = chosen_flights(arguments.flights, arguments.detector)
    found: dict[str, dict[str, Measured]] = {}
    began_s = time.perf_counter()
    with get_context("spawn").Pool(arguments.processes) as pool:
        names = [flight.name for flight in chosen]
        done = pool.imap(partial(measured, detector=arguments.detector), names, chunksize=1)
        for name, both in zip(names, done, strict=True):
            found[name] = both
            print(f"{name} after {time.perf_counter() - began_s:.0f} s", file=sys.stderr, flush=True)
    command = shlex.join(["python", "-m", "benchmarks.angles", *sys.argv[1:]])
    lines = [f"    {command}", "", *angles_tables(found), *gait_table(found)]
    print("\n".join(lines))
    if arguments.write:
        text = PAGE.read_text(encoding="utf-8")
        before, rest = text.split(BEGIN)
        after = rest.split(END, 1)[1]
        written = "\n".join([BEGIN, "", *lines])
        PAGE.write_text(f"{before}{written}{END}{after}", encoding="utf-8")


# --- measuring -----------------------------------------------------------------------------------------


def measured(name: str, detector: str) -> dict[str, Measured]:
    """Reconstruct a flight by `auto`, and from true poses; the results by `auto` and FLOOR."""
    cv2.setNumThreads(1)
    flight = next(each for each in flights() if each.name == name)
    with tempfile.TemporaryDirectory(prefix="angles-") as folder:
        drawn = DrawnFlight(flight, Path(folder) / "shared")
        drawn.write_shared()
        return {method: _measured(drawn, flight, detector, method, folder) for method in ("auto", FLOOR)}


def _measured(drawn: DrawnFlight, flight: Flight, detector: str, method: str, folder: str) -> Measured:
    poses: Any = "true" if method == FLOOR else "logged"
    session = drawn.session(Path(folder) / method, 0, "model", detector, poses=poses)
    with (
        kept_in_place_of_pictures(flight, detector),
        patch("pipelines.reconstruct.doubts_of", lambda *_, **__: []),
    ):
        with locked(session) as writable:
            detect(writable, detector=detector)
            if flight.with_pictures and method != FLOOR:
                Following(writable).finish()
        chosen = METHODS["robust" if method == FLOOR else method]
        metrics = reconstruct(session, Settings(**chosen, detector=detector)).metrics
    table = read_table(session / "reconstruct" / "angles.parquet", ANGLES_TABLE)
    table = table[table["person"] == 0]
    t_ns = table["t_ns"].to_numpy(np.int64).reshape(-1, len(ANGLES))[:, 0]
    person = drawn.simulated.people[0]
    moved = person.moving((t_ns - drawn.simulated.scenario.start_ns) / 1e9)
    centres, soles = joint_centres(person.person.rig, moved), sole_points(person.person.rig, moved)
    bones = {f"{s}_{j}": centres[:, BONE[f"{s}_{bone}"]] for s in SIDES for j, bone in _BONE_OF.items()}
    for index, side in enumerate(SIDES):
        bones[f"{side}_heel"], bones[f"{side}_big_toe"] = soles[:, index, 0], soles[:, index, 2]
    true = read_table(session / "truth.parquet", TRUTH)
    joints = tuple(dict.fromkeys(true["joint"]))
    at_times = true_joints_at(motion_from(true, joints), t_ns)[:, :1]
    by_bones = np.stack(list(bones.values()), axis=1)
    walked = gait_events(tuple(bones), t_ns, by_bones)
    return Measured(
        table["value_deg"].to_numpy(np.float64).reshape(-1, len(ANGLES)),
        table["sigma_deg"].to_numpy(np.float64).reshape(-1, len(ANGLES)),
        joint_angles(joints, at_times).value_deg[:, 0],
        joint_angles(tuple(bones), by_bones[:, None]).value_deg[:, 0],
        _gait_figures(metrics["gait"]["0"]),
        None if walked is None else _gait_figures(summary(walked, t_ns, tuple(bones))),
    )


def _gait_figures(figures: Mapping[str, Any] | None) -> list[float] | None:
    if figures is None:
        return None
    return [figures[name]["mean"] if isinstance(figures[name], dict) else figures[name] for name in _GAIT]


# --- the tables ----------------------------------------------------------------------------------------


def angles_tables(found: Mapping[str, Mapping[str, Measured]]) -> list[str]:
    """Write a line for each angle, both sides together."""
    rows = []
    for part in _PARTS:
        columns = [
            index for index, name in enumerate(ANGLES) if name in (part, f"left_{part}", f"right_{part}")
        ]
        auto, floor = ([both[method] for both in found.values()] for method in ("auto", FLOOR))
        shares = [float(np.isfinite(one.value[:, columns]).mean()) for one in auto]
        if not sum(shares):
            continue
        inside = [_inside(one, columns) for one in auto]
        rows.append(
            [
                part,
                f"{100 * np.mean(shares):.0f}",
                *(
                    _rms([_errors(one, truth, columns) for one in group])
                    for truth in ("by_joints", "by_bones")
                    for group in (auto, floor)
                ),
                _rms([_varying(_errors(one, "by_bones", columns)) for one in auto]),
                _percent(inside),
            ]
        )
    header = [
        "angle",
        "determined %",
        "RMSE deg against the true joints",
        "floor",
        "against the bones",
        "floor",
        "the same without each flight's mean",
        "inside 2 sigma % (true joints; ankle: bones)",
    ]
    return [f"{len(found)} flights, one draw of the logs' errors each.", "", *markdown_table(header, rows)]


def _errors(one: Measured, truth: str, columns: Sequence[int]) -> Float:
    error = (one.value - getattr(one, truth))[:, list(columns)]
    return np.asarray((error + 180) % 360 - 180)


def _varying(error: Float) -> Float:
    """Subtract from each column [T, A] its mean, as a measurement of the neutral pose would."""
    known = np.isfinite(error)
    mean = np.where(known, error, 0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
    return np.asarray(error - mean)


def _rms(errors: Sequence[Float]) -> str:
    """Return the root of the mean over flights of the mean squared error."""
    squared = [float(np.nanmean(error**2)) for error in errors if np.isfinite(error).any()]
    return f"{np.sqrt(np.mean(squared)):.1f}" if squared else ""


def _inside(one: Measured, columns: Sequence[int]) -> float | None:
    """Return the share of the errors within two standard deviations."""
    error = _errors(one, "by_joints", columns)
    if not np.isfinite(error).any():
        error = _errors(one, "by_bones", columns)
    known = np.isfinite(error)
    sigma = one.sigma[:, list(columns)]
    return float((np.abs(error[known]) <= 2 * sigma[known]).mean()) if known.any() else None


def _percent(shares: Sequence[float | None]) -> str:
    known = [share for share in shares if share is not None]
    return f"{100 * np.mean(known):.0f} ({100 * min(known):.0f} to {100 * max(known):.0f})" if known else ""


def gait_table(found: Mapping[str, Mapping[str, Measured]]) -> list[str]:
    """Write a line for each flight in which the bones or the reconstruction walk."""
    rows = []
    for name, both in found.items():
        one = both["auto"]
        if one.gait is None and one.true_gait is None:
            continue
        unknown: list[float | None] = [None] * len(_GAIT)
        pairs = zip(one.gait or unknown, one.true_gait or unknown, strict=True)
        digits = (0, 2, 2)
        rows.append(
            [
                name,
                *(
                    " / ".join("-" if value is None else f"{value:.{places}f}" for value in pair)
                    for pair, places in zip(pairs, digits, strict=True)
                ),
            ]
        )
    if not rows:
        return []
    header = ["flight", "cadence per min, measured / true", "step m", "speed m/s"]
    return [
        "Gait by `auto`; the truth is the same method on the bones and soles.",
        "",
        *markdown_table(header, rows),
    ]


# --- beside OpenSim ------------------------------------------------------------------------------------

_COORDINATES = {
    "hip_flexion": "hip_flexion",
    "hip_adduction": "hip_adduction",
    "knee_flexion": "knee_angle",
    "ankle_dorsiflexion": "ankle_angle",
    "elbow_flexion": "elbow_flex",
}
"""Our angles, and the coordinates of Pose2Sim's model with the same sign."""


def beside_opensim(session: Path, peer: Path | None) -> list[str]:
    """Compare angles with OpenSim's of the same session, and those with another motion of the same times."""
    with tempfile.TemporaryDirectory(prefix="angles-") as folder:
        written = {path.name: path for path in export(session, ["osim", "angles"], Path(folder)).written}
        solved = next(_storage(path) for name, path in written.items() if name.endswith(".mot"))
        errors = next(_storage(path) for name, path in written.items() if name.endswith("_errors.sto"))
        own = next(_storage(path) for name, path in written.items() if name.endswith("_angles.sto"))
    both = None if peer is None else _storage(peer)
    row = np.searchsorted(own["time"], solved["time"])
    rms_mm = 1e3 * float(np.sqrt((errors["marker_error_RMS"] ** 2).mean()))
    rows = []
    for name, coordinate in _COORDINATES.items():
        for side in SIDES:
            column = f"{coordinate}_{side[0]}"
            apart = own[f"{side}_{name}"].to_numpy()[row] - solved[column]
            pair = "" if both is None else f"{(solved[column] - both[column]).abs().median():.1f}"
            offset = apart.median()
            left = (apart - offset).abs().median()
            rows.append(
                [f"{side}_{name}", f"{apart.abs().median():.1f}", f"{offset:.1f}", f"{left:.1f}", pair]
            )
    header = [
        "angle",
        "ours from OpenSim's, median deg",
        "constant offset (median)",
        "median without it",
        "OpenSim's from the peer's",
    ]
    return [
        f"{len(solved)} times; markers are {rms_mm:.1f} mm (RMS) off the model's.",
        "",
        *markdown_table(header, rows),
    ]


def _storage(path: Path) -> pd.DataFrame:
    """Read OpenSim's storage."""
    text = path.read_text(encoding="utf-8").split("endheader\n", 1)[1]
    return pd.read_csv(io.StringIO(text), sep=r"\s+")


if __name__ == "__main__":
    main()
