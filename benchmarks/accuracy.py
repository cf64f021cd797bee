"""Accuracy of the estimate: `python -m benchmarks.accuracy SUBJECT [--write]`.

SUBJECT is `corpus`, or films, gimbals, bodies, people, attitudes or detectors, each described in the
module of its name. corpus: all methods on 24 rendered flights and the sample, with the real detectors
(`benchmarks/corpus/README.md`), errors of the logs drawn anew for each draw. flight.yaml gives their true
model, or neither it nor the logs give anything. Every method gets the same sessions by the same call as
`mocap reconstruct`. "True poses" is `robust` with them; "shared error" has them moved and turned together by
the error that all cameras of a draw share: no picture shows that error, so no method can remove it.

To save time, methods share the clocks that the first of them found by keypoints, and mistakes are not sought.
"""

import argparse
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Final
from unittest.mock import patch

import cv2
import numpy as np
import pandas as pd

from benchmarks import attitudes, bodies, detectors, gimbals, people
from benchmarks.corpus import making
from benchmarks.corpus.drawn import FAULTS, DrawnFlight, Given, Poses, kept_in_place_of_pictures
from benchmarks.corpus.stored import DETECTORS, HALVES, SAMPLE, Flight, flights
from benchmarks.results import fixed, markdown_table, show
from pipelines.detect import detect, follow
from pipelines.geometry.arrays import Bool, Float
from pipelines.geometry.joint_angles import ANGLES, joint_angles
from pipelines.geometry.metrics import measure
from pipelines.reconstruct import RECONSTRUCT, ReconstructSettings, reconstruct
from pipelines.reconstruction.clocks import FoundClocks
from pipelines.reconstruction.refining import RobustFlight, find_clocks
from pipelines.session.errors import DataError
from pipelines.session.people import true_joints_at
from pipelines.session.records import POINT_COVARIANCE_COLUMNS
from pipelines.session.stages import locked
from pipelines.session.tables import ANGLES as ANGLES_TABLE
from pipelines.session.tables import SKELETON, TRUTH, motion_from, read_table

FLOOR: Final = "floor"
SHARED: Final = "shared"
_POSES: dict[str, Poses] = {FLOOR: "true", SHARED: "shared"}
METHODS = ("robust", "refined", "auto")
SPECIAL: dict[str, tuple[str, Any]] = {
    "background": ("reconstruction.background._MOST_UNBOUND", -1.0),
    "motion of drones": ("reconstruction.background._ACCELERATION_MPS2", np.inf),
    "ground": ("reconstruction.ground._FEWEST_PATCHES", 10**9),
    "cameras that stand": ("reconstruction.background._FEWEST_STANDING", 10**9),
    "joints without slow errors": ("reconstruction.refinement.refine.REMEMBERED", np.inf),
    "levels of constant errors": ("reconstruction.refinement.refine._with_constant_levels", lambda *_: None),
    "faster motion": ("reconstruction.refinement.refine._FAST_MOTION", 1.0),
    "swaps over time": ("reconstruct._without_swaps", lambda cameras, _: (cameras, {})),
    "swaps between views": ("keypoints.corrections._MIN_GAIN", np.inf),
}
"""Special cases of `auto`: the name in pipelines that is replaced, and the value without the case."""
GIVEN: tuple[Given, ...] = ("model", "nothing")
FLEXIONS = ("hip_flexion", "knee_flexion", "elbow_flexion")
_IN_95 = 7.814727903251179  # 95 % quantile of chi-square with 3 degrees of freedom


@dataclass(frozen=True)
class Case:
    """One reconstruction, to be measured."""

    flight: str
    method: str  # of METHODS or SPECIAL, FLOOR or SHARED
    detector: str
    given: Given = "model"
    draw: int = 0
    fault: str = ""  # of FAULTS


@dataclass(frozen=True)
class Outcome:
    """Figures of one reconstruction; None where nothing could be measured."""

    mpjpe_mm: float | None = None
    root_mpjpe_mm: float | None = None
    acceleration_mps2: float | None = None
    nees: float | None = None
    inside: float | None = None
    measured_share: float | None = None
    hip_flexion_deg: float | None = None  # RMSE against the angles of the true joints
    knee_flexion_deg: float | None = None
    elbow_flexion_deg: float | None = None
    error: str | None = None


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `corpus`."""
    parser.add_argument("--flights", nargs="+", default=["all"], help="tuning, kept, all, or names")
    parser.add_argument("--methods", nargs="+", choices=METHODS, help="on all draws (default: auto robust)")
    parser.add_argument("--special", action="store_true", help="`auto` without each of its special cases")
    parser.add_argument(
        "--faults", nargs="*", choices=FAULTS, help="`auto` and `robust` with faults in a log (default: each)"
    )
    parser.add_argument("--detector", choices=DETECTORS, default=DETECTORS[0])
    parser.add_argument("--draws", type=int, default=8)
    parser.add_argument("--processes", type=int, default=2)


def run(options: argparse.Namespace) -> Iterator[tuple[str, list[str]]]:
    """Measure, print a line for each flight, and yield the tables of the page."""
    chosen = chosen_flights(options.flights, options.detector)
    methods = options.methods or ["auto", "robust"]  # the first finds the clocks
    if options.special:
        found = measured(chosen, ["auto", *SPECIAL], options.detector, options.draws, options.processes)
        yield "corpus-special", special_table(chosen, found)
        return
    if options.faults is not None:
        faults = options.faults or FAULTS
        found = measured(
            chosen, ("auto", "robust"), options.detector, options.draws, options.processes, faults
        )
        yield "corpus-faults", faults_table(chosen, faults, found)
        return
    found = measured(chosen, methods, options.detector, options.draws, options.processes)
    for said in GIVEN:
        print(f"\nPose noise, {said} given: MPJPE / root-relative mm")
        print("\n".join(flights_table(chosen, methods, said, found)))
        yield f"corpus-{said}", summary(chosen, methods, said, found)
    yield "angles", angles_table(chosen, found)


def chosen_flights(names: Sequence[str], detector: str) -> list[Flight]:
    """Choose flights by half (tuning, kept, all) or name; report which of them are not here."""
    chosen = [f for f in flights() if f.half in names or f.name in names or "all" in names]
    usable = []
    for flight in chosen:
        if flight.missing_motions:
            print(f"{flight.name} is left out: MOCAP_REAL_DATA has no {flight.missing_motions[0].name}")
        elif not flight.keypoints_path(detector).is_file():
            print(f"{flight.name} is left out: it has no keypoints of {detector} yet")
        else:
            usable.append(flight)
    if not usable:
        raise SystemExit(f"no flight: {', '.join(names)} names none that is here")
    return usable


# --- measuring -----------------------------------------------------------------------------------------


def measured(
    chosen: Sequence[Flight],
    methods: Sequence[str],
    detector: str,
    draws: int,
    processes: int,
    faults: Sequence[str] = ("",),
) -> dict[Case, Outcome]:
    """Measure every flight, draw, method and fault."""
    work = [
        [
            [Case(flight.name, FLOOR, detector)],
            *([Case(flight.name, SHARED, detector, "model", draw)] for draw in range(draws)),
            *(
                [Case(flight.name, method, detector, said, draw, fault) for method in methods]
                for fault in faults
                for draw in range(draws)
                for said in GIVEN
            ),
        ]
        for flight in chosen
    ]
    found: dict[Case, Outcome] = {}
    began_s = time.perf_counter()
    with (
        tempfile.TemporaryDirectory(prefix="accuracy-") as place,
        get_context("spawn").Pool(processes) as pool,
    ):
        done = pool.imap_unordered(partial(_outcomes_of, Path(place)), work, chunksize=1)
        for number, outcomes in enumerate(done, 1):
            found |= outcomes
            took_s = time.perf_counter() - began_s
            print(f"{number} of {len(work)} flights after {took_s:.0f} s", file=sys.stderr, flush=True)
    return found


def _outcomes_of(shared: Path, groups: Sequence[Sequence[Case]]) -> dict[Case, Outcome]:
    """Measure a flight's draws."""
    cv2.setNumThreads(1)
    flight = next(each for each in flights() if each.name == groups[0][0].flight)
    drawn = DrawnFlight(flight, shared / flight.name)
    clocks_of_true_poses: dict[bytes, FoundClocks] = {}
    found: dict[Case, Outcome] = {}
    for group in groups:
        found |= measure_draw(drawn, group, clocks_of_true_poses if group[0].method in _POSES else {})
    return found


def measure_draw(
    drawn: DrawnFlight, cases: Sequence[Case], clocks: dict[bytes, FoundClocks]
) -> Iterator[tuple[Case, Outcome]]:
    """Make the session of one draw, reconstruct it by each method, and compare with the truth.

    Clocks of keypoints are found once for each state of knowledge, and put into `clocks`.
    """
    drawn.write_shared()
    flight, first = drawn.flight, cases[0]

    def find_once(robust: RobustFlight, stated: Bool) -> FoundClocks:
        unknown = robust.clock_sigma_s.tobytes()  # less of them where backgrounds tell some clocks
        clocks[unknown] = clocks[unknown] if unknown in clocks else find_clocks(robust, stated)
        return clocks[unknown]

    with tempfile.TemporaryDirectory(prefix="accuracy-") as folder:
        place = Path(folder) / "flight"
        session = drawn.session(
            place,
            first.draw,
            first.given,
            first.detector,
            poses=_POSES.get(first.method, "logged"),
            fault=first.fault,
        )
        with (
            kept_in_place_of_pictures(flight, first.detector),
            patch("pipelines.reconstruct.find_clocks", find_once),
            patch("pipelines.reconstruct.doubts_of", lambda *_, **__: []),
        ):
            with locked(session) as writable:
                detect(writable, detector=first.detector)
                if flight.with_pictures:
                    follow(writable)
            for case in cases:
                name, value = SPECIAL.get(case.method, ("reconstruct.RECONSTRUCT", RECONSTRUCT))
                method: Any = case.method if case.method in METHODS else "auto"
                method = "robust" if case.method in _POSES else method
                settings = ReconstructSettings(method=method, people=1, detector=first.detector)
                try:
                    with patch(f"pipelines.{name}", value):
                        reconstruct(session, settings, force=True)
                except DataError as error:
                    yield case, Outcome(error=str(error))
                else:
                    yield case, outcome_of(session)


def outcome_of(session: Path) -> Outcome:
    """Compare the first person of a reconstructed session with the truth."""
    skeleton = read_table(session / "reconstruct" / "skeleton.parquet", SKELETON).query("person == 0")
    joints = tuple(skeleton["joint"].iloc[: skeleton["joint"].nunique()])
    shape = (skeleton["t_ns"].nunique(), len(joints))
    t_ns = skeleton["t_ns"].to_numpy(np.int64).reshape(shape)[:, 0]
    ok = (skeleton["status"] == "ok").to_numpy().reshape(*shape, 1)
    position = np.where(ok, skeleton[["x", "y", "z"]].to_numpy(np.float64).reshape(*shape, 3), np.nan)
    table = read_table(session / "truth.parquet", TRUTH)
    truth = true_joints_at(motion_from(table, joints), t_ns)[:, 0]
    errors: Any = measure(position[:, None], truth[:, None], joints, t_ns)
    upper = skeleton[list(POINT_COVARIANCE_COLUMNS)].to_numpy(np.float64)
    covariance = upper[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(*shape, 3, 3)
    there = np.isfinite(position - truth).all(axis=-1)
    squared = nees(position[there] - truth[there], covariance[there])
    acceleration = errors["acceleration_error_mm_s2"]
    return Outcome(
        errors["mpjpe_mm"],
        errors["root_mpjpe_mm"],
        None if acceleration is None else acceleration / 1e3,
        float(squared.mean()),
        float((squared <= _IN_95).mean()),
        errors["reconstructed_share"],
        **dict(_flexion_errors(session, t_ns, table)),
    )


def _flexion_errors(session: Path, t_ns: Any, truth: pd.DataFrame) -> Iterator[tuple[str, Any]]:
    """Yield the RMSE (deg) of each of `FLEXIONS`, both sides together; None where none is known."""
    joints = tuple(dict.fromkeys(truth["joint"]))
    true = joint_angles(joints, true_joints_at(motion_from(truth, joints), t_ns)[:, :1]).value_deg[:, 0]
    stored = read_table(session / "reconstruct" / "angles.parquet", ANGLES_TABLE)
    own = stored[stored["person"] == 0]["value_deg"].to_numpy(np.float64).reshape(-1, len(ANGLES))
    for name in FLEXIONS:
        columns = [index for index, angle in enumerate(ANGLES) if angle.endswith(name)]
        error = (own[:, columns] - true[:, columns] + 180) % 360 - 180
        yield f"{name}_deg", float(np.sqrt(np.nanmean(error**2))) if np.isfinite(error).any() else None


def nees(error: Float, covariance: Float) -> Float:
    """Compute the squared error in units of its covariance [N], from [N, 3] and [N, 3, 3]."""
    solved = np.linalg.solve(covariance, error[..., None])[..., 0]
    return np.asarray(np.einsum("ni,ni->n", error, solved), dtype=np.float64)


# --- the tables ----------------------------------------------------------------------------------------


def flights_table(
    chosen: Sequence[Flight], methods: Sequence[str], given: Given, found: Mapping[Case, Outcome]
) -> list[str]:
    """Write a line for each flight: MPJPE and root-relative error of each method."""
    rows = []
    for flight in chosen:
        pairs = []
        for method in [*methods, *_POSES]:
            own = _of(flight, method, given, found)
            pairs.append(" / ".join(fixed(_mean(own, name)) for name in ("mpjpe_mm", "root_mpjpe_mm")))
        rows.append([flight.name, str(flight.scenario.drones.count), *pairs])
    return markdown_table(["flight", "drones", *methods, *_NAMES.values()], rows)


def summary(
    chosen: Sequence[Flight], methods: Sequence[str], given: Given, found: Mapping[Case, Outcome]
) -> list[str]:
    """Write a line for each half and method: medians over flights, and the largest ratio to `robust`."""
    rows = []
    for half in HALVES:
        own = [flight for flight in chosen if flight.half == half and flight.name != SAMPLE.name]
        for method in [*methods, *_POSES] if own else ():
            of = {flight.name: _of(flight, method, given, found) for flight in own}
            robust = {flight.name: _mean(_of(flight, "robust", given, found), "mpjpe_mm") for flight in own}
            ratios = [_mean(outcomes, "mpjpe_mm") / robust[name] for name, outcomes in of.items()]
            rows.append([half, _NAMES.get(method, method)])
            for name, digits, scale in _COLUMNS:
                values = [scale * _mean(outcomes, name) for outcomes in of.values()]
                known = [value for value in values if not np.isnan(value)]
                rows[-1].append(fixed(float(np.median(known)), digits) if known else "")
            rows[-1].insert(3, fixed(float(np.nanmax(ratios)), 2))
    header = ["half", "method", "MPJPE", "largest ratio to robust", "root-relative", "acceleration m/s^2"]
    return markdown_table([*header, "NEES", "in 95 % %", "measured %"], rows)


def special_table(chosen: Sequence[Flight], found: Mapping[Case, Outcome]) -> list[str]:
    """Write what `auto` loses without each special case, in the mean and on the flight that it helps most."""
    alike: dict[tuple[str, ...], list[str]] = {}  # of many nothing changes
    for case in SPECIAL:
        row = []
        for given in GIVEN:
            change = []
            for flight in chosen:
                without, whole = (_of(flight, method, given, found) for method in (case, "auto"))
                change.append(100 * (_mean(without, "mpjpe_mm") / _mean(whole, "mpjpe_mm") - 1))
            most = "lost" if np.isnan(change).any() else f"{max(change):+.0f}"
            row.append(f"{np.nanmean(change):+.1f} ({most})")
        alike.setdefault(tuple(row), []).append(case)
    rows = [[", ".join(cases), *row] for row, cases in alike.items()]
    return markdown_table(
        ["`auto` without", *(f"MPJPE %, {said} (most)" for said in ("stated", "not stated"))], sorted(rows)
    )


def faults_table(chosen: Sequence[Flight], faults: Sequence[str], found: Mapping[Case, Outcome]) -> list[str]:
    """Write for each fault mean errors of `robust` and `auto`, their largest ratio, and NEES of `auto`."""
    rows = []
    for fault in faults:
        row = [fault]
        for given in GIVEN:
            both = [[_of(of, method, given, found, fault) for of in chosen] for method in ("robust", "auto")]
            robust, auto = ([_mean(of, "mpjpe_mm") for of in each] for each in both)
            levels = [_mean(of, "nees") for of in both[1]]
            row += [f"{np.mean(robust):.0f}, {np.mean(auto):.0f}", f"{np.divide(auto, robust).max():.2f}"]
            row.append(f"{np.mean(levels):.1f} ({max(levels):.1f})")
        rows.append(row)
    names = ("`robust`, `auto` mm", "largest ratio", "NEES (largest)")
    return markdown_table(["", *(f"{name}, {said}" for said in ("stated", "not") for name in names)], rows)


_COLUMNS = (
    ("mpjpe_mm", 0, 1),
    ("root_mpjpe_mm", 0, 1),
    ("acceleration_mps2", 1, 1),
    ("nees", 1, 1),
    ("inside", 0, 100),
    ("measured_share", 0, 100),
)
_NAMES = {FLOOR: "true poses", SHARED: "shared error"}


def angles_table(chosen: Sequence[Flight], found: Mapping[Case, Outcome]) -> list[str]:
    """Write a line for each half and method: medians over flights of the angles' errors."""
    rows = []
    for half in HALVES:
        own = [flight for flight in chosen if flight.half == half]
        for method in ("auto", FLOOR) if own else ():
            each = [_of(flight, method, "model", found) for flight in own]
            medians = [np.nanmedian([_mean(of, f"{name}_deg") for of in each]) for name in FLEXIONS]
            rows.append([half, _NAMES.get(method, method), *(fixed(float(value), 1) for value in medians)])
    return markdown_table(["half", "method", "hip flexion RMSE deg", "knee flexion", "elbow flexion"], rows)


def _of(
    flight: Flight, method: str, given: Given, found: Mapping[Case, Outcome], fault: str = ""
) -> list[Outcome]:
    wanted = (flight.name, method, "model" if method in _POSES else given, fault)
    return [of for case, of in found.items() if (case.flight, case.method, case.given, case.fault) == wanted]


def _mean(outcomes: Sequence[Outcome], name: str) -> float:
    known = [value for outcome in outcomes if (value := getattr(outcome, name)) is not None]
    return float(np.mean(known)) if known else float("nan")


SUBJECTS: dict[str, tuple[Any, Any]] = {
    "corpus": (add_arguments, run),
    "films": (making.add_arguments, making.run),
    "gimbals": (gimbals.add_arguments, gimbals.run),
    "attitudes": (attitudes.add_arguments, attitudes.run),
    "people": (people.add_arguments, people.run),
    "bodies": (bodies.add_arguments, bodies.run),
    "detectors": (detectors.add_arguments, detectors.run),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    commands = parser.add_subparsers(dest="subject", required=True)
    for name, (add, _) in SUBJECTS.items():
        command = commands.add_parser(name)
        command.add_argument("--write", action="store_true", help="put the tables into docs/results.md")
        add(command)
    options = parser.parse_args()
    for key, lines in SUBJECTS[options.subject][1](options):
        show(key, lines, write=options.write)


if __name__ == "__main__":
    main()
