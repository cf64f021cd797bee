"""Joint angles and gait against a simulated body's: the corpus' flights, rendered, with a real detector.

    python -m benchmarks.angles --flights tuning                        # constants may be tuned on these
    python -m benchmarks.angles --flights kept --write                  # and docs/angles.md gets the tables
    python -m benchmarks.angles --opensim SESSION [--peer POSE2SIM.mot] # beside OpenSim's inverse kinematics

Each flight is reconstructed by `auto` from logs with errors, and from the true poses by `auto` and `robust`:
errors with true poses are the detector's alone. A bound that no method can reach knows the true distances
from the cameras, too. Each view puts a joint at its true depth, and the views used by `robust` are averaged.
Angles are compared with two truths:

- those of the true joints, COCO's points of the skin, which all errors of this project refer to;
- those of the bones: the centres of the joints about which the simulated body turns, and its soles.

With `--folder` each flight's angles are kept there, and an interrupted run goes on.
"""

from __future__ import annotations

import argparse
import io
import shlex
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any
from unittest.mock import patch

import cv2
import numpy as np
import pandas as pd

from benchmarks.accuracy import METHODS, chosen_flights
from benchmarks.corpus.drawn import DrawnFlight, kept_in_place_of_pictures
from benchmarks.corpus.stored import DETECTORS, Flight, flights
from benchmarks.results_page import markdown_table
from pipelines.detect import detect
from pipelines.export import export
from pipelines.follow import Following
from pipelines.geometry.arrays import Float
from pipelines.geometry.gait import gait_events, summary
from pipelines.geometry.joint_angles import ANGLES, joint_angles
from pipelines.geometry.triangulation import Triangulation, Views
from pipelines.reconstruct import Settings, reconstruct
from pipelines.reconstruction.observations import Observations
from pipelines.reconstruction.results import angles_parts
from pipelines.session.description import read_description
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
BOUND, FLOOR = "auto with true poses", "robust with true poses"
DEPTHS = "true poses and depths"
EXACT = "white:position_m=0.001,rotation_deg=0.01"  # what BOUND is told of its poses
FLEXIONS = ("hip_flexion", "knee_flexion", "elbow_flexion")
AIM_DEG = 5.0


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
    parser.add_argument("--folder", type=Path, help="keep the angles of each flight here")
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
        each = partial(measured, detector=arguments.detector, kept_in=arguments.folder)
        done = pool.imap(each, names, chunksize=1)
        for name, both in zip(names, done, strict=True):
            found[name] = both
            print(f"{name} after {time.perf_counter() - began_s:.0f} s", file=sys.stderr, flush=True)
    options = [] if arguments.folder is None else ["--folder", str(arguments.folder)]
    said = [word for word in sys.argv[1:] if word not in options]
    command = shlex.join(["python", "-m", "benchmarks.angles", *said])
    lines = [f"    {command}", "", *angles_tables(found), "", *flexions_table(found), *gait_table(found)]
    print("\n".join(lines))
    if arguments.write:
        text = PAGE.read_text(encoding="utf-8")
        before, rest = text.split(BEGIN)
        after = rest.split(END, 1)[1]
        written = "\n".join([BEGIN, "", *lines])
        PAGE.write_text(f"{before}{written}{END}{after}", encoding="utf-8")


# --- measuring -----------------------------------------------------------------------------------------


def measured(name: str, detector: str, kept_in: Path | None = None) -> dict[str, Measured]:
    """Reconstruct a flight by `auto`, and from true poses; the results by `auto`, BOUND, FLOOR and DEPTHS."""
    cv2.setNumThreads(1)
    flight = next(each for each in flights() if each.name == name)
    with tempfile.TemporaryDirectory(prefix="angles-") as folder:
        drawn = DrawnFlight(flight, Path(folder) / "shared")
        drawn.write_shared()
        found = {}
        for method in ("auto", BOUND, FLOOR, DEPTHS):
            file = None if kept_in is None else kept_in / f"{name}, {detector}, {method}.npz"
            if file is None or not file.is_file():
                one = _measured(drawn, flight, detector, method, folder)
                if file is not None:
                    file.parent.mkdir(parents=True, exist_ok=True)
                    parts = {part: [] if value is None else value for part, value in asdict(one).items()}
                    np.savez(file, **parts)
            else:
                with np.load(file) as stored:
                    of: dict[str, Any] = dict(stored)
                gaits = {part: of[part].tolist() or None for part in ("gait", "true_gait")}
                one = Measured(**of | gaits)
            found[method] = one
    return found


def _measured(drawn: DrawnFlight, flight: Flight, detector: str, method: str, folder: str) -> Measured:
    poses: Any = "logged" if method == "auto" else "true"
    session = drawn.session(Path(folder) / method, 0, "model", detector, poses=poses)
    with (
        kept_in_place_of_pictures(flight, detector),
        patch("pipelines.attempt.doubts_of", lambda *_, **__: []),
        patch("pipelines.attempt.angles_parts", wraps=angles_parts) as written,
    ):
        with locked(session) as writable:
            detect(writable, detector=detector)
            if flight.with_pictures and method == "auto":
                Following(writable).finish()
        chosen = METHODS["robust" if method in (FLOOR, DEPTHS) else "auto"]
        if method == BOUND:
            chosen = chosen | {"pose_noise": EXACT}
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
    value = table["value_deg"].to_numpy(np.float64).reshape(-1, len(ANGLES))
    if method == DEPTHS:
        observations, views, result = written.call_args.args
        seen = at_true_depths(views, result, observations, joints, at_times[:, 0])
        value = joint_angles(observations.joints, seen[:, None]).value_deg[:, 0]
    return Measured(
        value,
        table["sigma_deg"].to_numpy(np.float64).reshape(-1, len(ANGLES)),
        joint_angles(joints, at_times).value_deg[:, 0],
        joint_angles(tuple(bones), by_bones[:, None]).value_deg[:, 0],
        _gait_figures(metrics["gait"]["0"]),
        None if walked is None else _gait_figures(summary(walked, t_ns, tuple(bones))),
    )


def at_true_depths(
    views: Views,
    result: Triangulation,
    observations: Observations,
    joints: Sequence[str],
    true: Float,
) -> Float:
    """Compute joints [T, J, 3] m of person 0 from their keypoints at the true distances from the cameras.

    Views are averaged by their weights. NaN where no view was used, or the truth does not have the joint.

    Args:
        views: of all joint-frames, with true poses.
        result: their triangulation; its inliers are used.
        observations: of which they are.
        joints: of the truth.
        true: [T, joints, 3] m.
    """
    times, people, own = observations.confidence.shape[:3]
    place = np.full((times, own, 3), np.nan)
    for j, name in enumerate(observations.joints):
        if name in joints:
            place[:, j] = true[:, list(joints).index(name)]
    first = np.arange(times * people * own).reshape(times, people, own)[:, 0]
    index = views.pose_index[first]
    rotation = views.rotation[index]
    away = np.einsum("tjcki,tjck->tjci", rotation, place[:, :, None] - views.position[index])
    aside = (views.rays[first] - away[..., :2] / away[..., 2:]) * away[..., 2:]
    error = np.einsum("tjcik,tjck->tjci", rotation[..., :2], aside)
    used = result.inlier[first] & np.isfinite(error).all(axis=-1)
    weight = np.where(used, views.weight[first], 0.0)
    with np.errstate(invalid="ignore"):
        mean = (
            np.einsum("tjc,tjci->tji", weight, np.where(used[..., None], error, 0.0))
            / weight.sum(-1)[..., None]
        )
    return np.asarray(place + mean)


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
        auto, bound, floor, depths = (
            [each[method] for each in found.values()] for method in ("auto", BOUND, FLOOR, DEPTHS)
        )
        shares = [float(np.isfinite(one.value[:, columns]).mean()) for one in auto]
        if not sum(shares):
            continue

        def rms(
            group: Sequence[Measured], truth: str, *, varying: bool = False, columns: list[int] = columns
        ) -> str:
            errors = [_errors(one, truth, columns) for one in group]
            return _rms([_varying(error) for error in errors] if varying else errors)

        rows.append(
            [
                part,
                f"{100 * np.mean(shares):.0f}",
                rms(auto, "by_joints"),
                rms(auto, "by_joints", varying=True),
                rms(bound, "by_joints"),
                rms(bound, "by_joints", varying=True),
                rms(floor, "by_joints"),
                rms(depths, "by_joints"),
                rms(auto, "by_bones"),
                rms(auto, "by_bones", varying=True),
                _percent([_inside(one, columns) for one in auto]),
            ]
        )
    header = [
        "angle",
        "determined %",
        "RMSE deg against the true joints",
        "without each flight's mean",
        BOUND,
        "without each flight's mean",
        FLOOR,
        DEPTHS,
        "against the bones",
        "without each flight's mean",
        "inside 2 sigma % (true joints; ankle: bones)",
    ]
    return [f"{len(found)} flights, one draw of the logs' errors each.", "", *markdown_table(header, rows)]


def flexions_table(found: Mapping[str, Mapping[str, Measured]]) -> list[str]:
    """Write a line for each flight: the RMSE of flexions by `auto`, BOUND, FLOOR and DEPTHS."""
    rows, missed = [], dict.fromkeys(FLEXIONS, 0)
    for name, each in found.items():
        cells = [name]
        for part in FLEXIONS:
            columns = [list(ANGLES).index(f"{side}_{part}") for side in SIDES]
            written = [
                _rms([_errors(each[method], "by_joints", columns)]) or "-"
                for method in ("auto", BOUND, FLOOR, DEPTHS)
            ]
            missed[part] += written[0] != "-" and float(written[0]) > AIM_DEG
            cells += [" / ".join(written), _percent([_inside(each["auto"], columns)]).partition(" ")[0]]
        rows.append(cells)
    header = ["flight"]
    for part in FLEXIONS:
        header += [part, "inside 2 sigma %"]
    counts = ", ".join(f"{part} in {count}" for part, count in missed.items())
    return [
        f"By flight, RMSE deg against the true joints: `auto` / {BOUND} / {FLOOR} / {DEPTHS}. `auto` is above"
        f" {AIM_DEG:g} deg for {counts} of {len(found)} flights.",
        "",
        *markdown_table(header, rows),
        "",
    ]


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
    """Compare angles with OpenSim's of the same session, a peer's of the same times, and the truth."""
    with tempfile.TemporaryDirectory(prefix="angles-") as folder:
        written = {path.name: path for path in export(session, ["osim", "angles"], Path(folder)).written}
        solved = next(_storage(path) for name, path in written.items() if name.endswith(".mot"))
        errors = next(_storage(path) for name, path in written.items() if name.endswith("_errors.sto"))
        own = next(_storage(path) for name, path in written.items() if name.endswith("_angles.sto"))
    both = None if peer is None else _storage(peer)
    row = np.searchsorted(own["time"], solved["time"])
    rms_mm = 1e3 * float(np.sqrt((errors["marker_error_RMS"] ** 2).mean()))
    true = _true_angles(session)
    rows = []
    for name, coordinate in _COORDINATES.items():
        for side in SIDES:
            column = f"{coordinate}_{side[0]}"
            ours, theirs = own[f"{side}_{name}"].to_numpy()[row], solved[column].to_numpy()
            pair = ""
            if both is not None:
                peers = np.interp(solved["time"], both["time"], both[column], left=np.nan, right=np.nan)
                pair = f"{np.nanmedian(np.abs(theirs - peers)):.1f}"
            cells = [
                f"{side}_{name}",
                f"{np.nanmedian(np.abs(ours - theirs)):.1f}",
                *_apart(ours - theirs),
                f"{np.nanmedian(own[f'{side}_{name}_sigma'].to_numpy()[row]):.1f}",
                pair,
            ]
            if true is not None:
                truth = true[row, list(ANGLES).index(f"{side}_{name}")]
                cells += [*_apart(ours - truth), *_apart(theirs - truth)]
            rows.append(cells)
    offset = ("constant offset (median)", "median without it")
    sigma = "our standard deviation, median"
    header = ["angle", "ours from OpenSim's, median deg", *offset, sigma, "OpenSim's from the peer's"]
    if true is not None:
        header += [
            f"{whose} from the true joints, {each}" for whose in ("ours", "OpenSim's") for each in offset
        ]
    return [
        f"{len(solved)} times; markers are {rms_mm:.1f} mm (RMS) off the model's.",
        "",
        *markdown_table(header, rows),
    ]


def _apart(difference: Float) -> list[str]:
    """Write the median of differences [T], and that of what is left without it; empty if none is known."""
    if not np.isfinite(difference).any():
        return ["", ""]
    offset = np.nanmedian(difference)
    return [f"{offset:.1f}", f"{np.nanmedian(np.abs(difference - offset)):.1f}"]


def _true_angles(session: Path) -> Float | None:
    """Compute the angles [T, A] of person 0's true joints at the skeleton's times; None without truth."""
    if not read_description(session).has_true_joints:
        return None
    table = read_table(session / "reconstruct" / "angles.parquet", ANGLES_TABLE)
    true = read_table(session / "truth.parquet", TRUTH)
    joints = tuple(dict.fromkeys(true["joint"]))
    at_times = true_joints_at(motion_from(true, joints), np.unique(table["t_ns"].to_numpy(np.int64)))
    return joint_angles(joints, at_times[:, :1]).value_deg[:, 0]


def _storage(path: Path) -> pd.DataFrame:
    """Read OpenSim's storage."""
    text = path.read_text(encoding="utf-8").split("endheader\n", 1)[1]
    return pd.read_csv(io.StringIO(text), sep=r"\s+")


if __name__ == "__main__":
    main()
