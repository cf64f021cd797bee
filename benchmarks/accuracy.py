"""Accuracy of every method on the corpus of rendered flights: `python -m benchmarks.accuracy`.

    python -m benchmarks.accuracy [--flights tuning|kept|all|NAME ...] [--methods METHOD ...] [--draws 8]
        [--detector blazepose|blazepose-heavy] [--given model nothing] [--write]

Pictures are rendered, the detector is real (`benchmarks/corpus/README.md`). For each draw the errors of the
logs are drawn anew. flight.yaml gives their true model, or neither it nor the logs give anything. Every
method gets the same sessions by the same call as `mocap reconstruct`. "True poses" is `robust` with them.
"Shared error only" is `robust` with the true poses, moved and turned together by the error that all cameras
of a draw share. No picture tells of that one: whoever knew all poses relative to each other would keep it.
Without `--methods`, `robust` and `auto` are measured on all draws, and the parts of `auto` by themselves on
the first one, with the model given: they would take as long as everything else.

Per flight and method, means over the draws (times: medians):

- MPJPE and root-relative error, mm, of the joint-frames that the method measured, with their share;
- error of the acceleration, m/s^2;
- peak speed of wrists and ankles over the true one: mean speed over mean true speed, over the 5 % of moments
  at which the truth is fastest; joints that reach 1 m/s only;
- NEES (3 is right), and the share of joint-frames within their 95 % ellipsoids;
- processor seconds of the call on the first draw, detection and following excluded; fallbacks.

To save time, methods share the clocks that the first of them found by keypoints, and mistakes are searched
for in the call alone whose time is taken: errors do not depend on either. All draws of the shared error share
the clocks of the true poses, too: all their cameras move alike. Two processes, each flight in one.

Results are kept in build/accuracy by the hash of the code and of the flight's files, so an interrupted run
goes on, and a changed program measures anew. `--write` writes docs/results.md.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import asdict, dataclass, replace
from functools import cache, partial
from hashlib import sha256
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Final
from unittest.mock import patch

import cv2
import numpy as np

from benchmarks.corpus.drawn import DrawnFlight, Given, Poses, kept_in_place_of_pictures
from benchmarks.corpus.stored import CORPUS, DETECTORS, HALVES, SAMPLE, Flight, Half, flights
from benchmarks.results import keep_numbers
from benchmarks.results_page import markdown_table
from pipelines.detect import detect
from pipelines.follow import Following
from pipelines.geometry.arrays import Bool, Float
from pipelines.geometry.metrics import measure
from pipelines.reconstruct import Settings, reconstruct
from pipelines.reconstruction.refining import FoundClocks, RobustFlight, find_clocks
from pipelines.session.description import Doubt
from pipelines.session.errors import DataError
from pipelines.session.people import true_joints_at
from pipelines.session.records import POINT_COVARIANCE_COLUMNS
from pipelines.session.stages import locked
from pipelines.session.tables import SKELETON, TRUTH, motion_from, read_table

ROOT = Path(__file__).parents[1]
WORK = ROOT / "build" / "accuracy"

FLOOR: Final = "floor"
SHARED: Final = "shared"
_POSES: dict[str, Poses] = {FLOOR: "true", SHARED: "shared"}
METHODS: dict[str, dict[str, Any]] = {
    "robust": {"method": "robust"},
    "refined": {"method": "refined"},
    "background": {"method": "robust", "refine_cameras": "background"},
    "both": {"method": "refined", "refine_cameras": "background"},
    "auto": {"method": "auto"},
}
ALWAYS = ("auto", "robust")
"""Methods that are measured on all draws; the first finds the clocks, and its time is taken."""
GIVEN: tuple[Given, ...] = ("model", "nothing")
DRAWS = 8

_FASTEST_SHARE = 0.05
_FAST_MPS = 1.0
_IN_95 = 7.814727903251179  # 95 % quantile of chi-square with 3 degrees of freedom
_WRISTS_AND_ANKLES = ("left_wrist", "right_wrist", "left_ankle", "right_ankle")


@dataclass(frozen=True)
class Case:
    """One reconstruction, to be measured."""

    flight: str
    method: str  # of METHODS, FLOOR or SHARED
    detector: str
    given: Given = "model"
    draw: int = 0


@dataclass(frozen=True)
class Outcome:
    """Figures of one reconstruction; None where nothing could be measured."""

    mpjpe_mm: float | None = None
    root_mpjpe_mm: float | None = None
    acceleration_mps2: float | None = None
    peak_ratio: float | None = None
    nees: float | None = None
    inside: float | None = None
    measured_share: float | None = None
    cpu_s: float | None = None  # of the first method of the first draw
    fallback: str | None = None  # reason why a part of the method was not used
    error: str | None = None


def main() -> None:
    """Measure, print the tables and the criteria; write the page if asked."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--flights", nargs="+", default=["all"], help="tuning, kept, all, or names")
    parser.add_argument("--methods", nargs="+", choices=METHODS, help="on all draws (default: see above)")
    parser.add_argument("--detector", choices=DETECTORS, default=DETECTORS[0])
    parser.add_argument("--given", nargs="+", choices=GIVEN, default=list(GIVEN))
    parser.add_argument("--draws", type=int, default=DRAWS)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--write", action="store_true", help="write the section of docs/results.md")
    arguments = parser.parse_args()
    chosen = chosen_flights(arguments.flights, arguments.detector)
    methods = arguments.methods or list(ALWAYS)
    parts = [name for name in METHODS if not arguments.methods]
    found = measured(
        chosen, methods, parts, arguments.detector, arguments.given, arguments.draws, arguments.processes
    )
    lines = report(chosen, methods, arguments.detector, found)
    if parts:
        lines += parts_table(chosen, parts, arguments.detector, found)
    print("\n".join(lines))
    if arguments.write:
        command = shlex.join(["python", "-m", "benchmarks.accuracy", *sys.argv[1:]])
        keep_numbers("accuracy", {arguments.detector: [f"    {command}", "", *lines]})


def chosen_flights(names: Sequence[str], detector: str) -> list[Flight]:
    """Choose flights by half (tuning, kept, all) or name; say which of them are not here."""
    halves: list[Half] = [half for half in HALVES if half in names or "all" in names]
    chosen = [f for f in flights() if f.half in halves or f.name in names]
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
    parts: Sequence[str],
    detector: str,
    given: Sequence[Given],
    draws: int,
    processes: int,
) -> dict[Case, Outcome]:
    """Measure every flight, draw and method, and the parts on the first draw with the model given.

    What is kept of earlier runs of the same code is taken.
    """
    work = [
        [
            [Case(flight.name, FLOOR, detector)],
            *([Case(flight.name, SHARED, detector, "model", draw)] for draw in range(draws)),
            *(
                [Case(flight.name, method, detector, said, draw) for method in dict.fromkeys(names)]
                for draw in range(draws)
                for said in given
                for names in [[*methods, *(parts if (said, draw) == ("model", 0) else ())]]
            ),
        ]
        for flight in sorted(chosen, key=_effort, reverse=True)
    ]
    found: dict[Case, Outcome] = {}
    began_s = time.perf_counter()
    with (
        tempfile.TemporaryDirectory(prefix="accuracy-") as place,
        get_context("spawn").Pool(processes) as pool,
    ):
        done = pool.imap_unordered(partial(_outcomes_of, revision(), Path(place)), work, chunksize=1)
        for number, outcomes in enumerate(done, 1):
            found |= outcomes
            took_s = time.perf_counter() - began_s
            print(f"{number} of {len(work)} flights after {took_s:.0f} s", file=sys.stderr, flush=True)
    return found


def _effort(flight: Flight) -> tuple[bool, int]:
    """Order flights by how long they take: unknown clocks most of all, then cameras."""
    drones = flight.scenario.drones
    return any(drones.clock_offsets_s), drones.count


@cache
def revision() -> str:
    """Hash the code that decides the results."""
    files = [*(ROOT / "pipelines").rglob("*.py"), *(ROOT / "pipelines").rglob("data/*")]
    files += [Path(__file__), *CORPUS.glob("*.py")]
    digest = sha256()
    for path in sorted(filter(Path.is_file, files)):  # a folder holds compiled functions
        digest.update(path.relative_to(ROOT).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:16]


def _outcomes_of(code: str, shared: Path, groups: Sequence[Sequence[Case]]) -> dict[Case, Outcome]:
    """Measure a flight's draws, or read their results of the same code and flight."""
    cv2.setNumThreads(1)
    first = groups[0][0]
    flight = next(each for each in flights() if each.name == first.flight)
    place = WORK / f"{code}-{_files_hash(flight, first.detector)}"
    place.mkdir(parents=True, exist_ok=True)
    drawn = DrawnFlight(flight, shared / flight.name)
    clocks_of_true_poses: dict[bytes, FoundClocks] = {}
    paths = {case: place / f"{_name_of(case)}.json" for group in groups for case in group}
    for group in groups:
        missing = [case for case in group if not paths[case].is_file()]
        clocks = clocks_of_true_poses if group[0].method in _POSES else {}
        for case, outcome in measure_draw(drawn, missing, clocks) if missing else ():
            partial_path = paths[case].with_suffix(f".{os.getpid()}")
            partial_path.write_text(json.dumps(asdict(outcome)), encoding="utf-8")
            partial_path.replace(paths[case])
    return {case: Outcome(**json.loads(path.read_text(encoding="utf-8"))) for case, path in paths.items()}


def _name_of(case: Case) -> str:
    return f"{case.flight}-{case.method}-{case.given}-{case.draw}"


def _files_hash(flight: Flight, detector: str) -> str:
    files = [flight.scenario_path, flight.keypoints_path(detector), flight.tracks_path, flight.stills_path]
    digest = sha256(detector.encode())
    for path in files:
        digest.update(path.read_bytes() if path.is_file() else b"-")
    return digest.hexdigest()[:16]


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
            place, first.draw, first.given, first.detector, poses=_POSES.get(first.method, "logged")
        )
        with (
            kept_in_place_of_pictures(flight, first.detector),
            patch("pipelines.attempt.find_clocks", find_once),
        ):
            with locked(session) as writable:
                detect(writable, detector=first.detector)
                if flight.with_pictures:
                    Following(writable).finish()
            for case in cases:
                timed = case is first and not case.draw
                method = METHODS["robust" if case.method in _POSES else case.method]
                settings = Settings(**method, people=1, detector=first.detector)
                began_s = time.process_time()
                try:
                    with nullcontext() if timed else patch("pipelines.attempt.doubts_of", _no_doubts):
                        metrics = reconstruct(session, settings).metrics
                except DataError as error:
                    yield case, Outcome(error=str(error))
                else:
                    took_s = time.process_time() - began_s if timed else None
                    yield case, _outcome(session, metrics, took_s)


def _no_doubts(*_: object, **__: object) -> list[Doubt]:
    return []


def _outcome(session: Path, metrics: Mapping[str, Any], took_s: float | None) -> Outcome:
    skeleton = read_table(session / "reconstruct" / "skeleton.parquet", SKELETON)
    skeleton = skeleton[skeleton["person"] == 0]
    joints = tuple(skeleton["joint"].iloc[: skeleton["joint"].nunique()])
    shape = (skeleton["t_ns"].nunique(), len(joints))
    t_ns = skeleton["t_ns"].to_numpy(np.int64).reshape(shape)[:, 0]
    ok = (skeleton["status"] == "ok").to_numpy().reshape(*shape, 1)
    position = np.where(ok, skeleton[["x", "y", "z"]].to_numpy(np.float64).reshape(*shape, 3), np.nan)
    truth = true_joints_at(motion_from(read_table(session / "truth.parquet", TRUTH), joints), t_ns)[:, 0]
    errors = measure(position[:, None], truth[:, None], joints, t_ns)
    upper = skeleton[list(POINT_COVARIANCE_COLUMNS)].to_numpy(np.float64)
    covariance = upper[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(*shape, 3, 3)
    there = np.isfinite(position - truth).all(axis=-1)
    squared = nees(position[there] - truth[there], covariance[there])
    acceleration = errors["acceleration_error_mm_s2"]
    return Outcome(
        _number(errors["mpjpe_mm"]),
        _number(errors["root_mpjpe_mm"]),
        None if acceleration is None else _number(acceleration) / 1e3,
        peak_ratio(position, truth, joints, t_ns),
        float(squared.mean()),
        float((squared <= _IN_95).mean()),
        _number(errors["reconstructed_share"]),
        took_s,
        _fallback(metrics),
    )


def _number(value: Any) -> float:
    return float(value)


def nees(error: Float, covariance: Float) -> Float:
    """Compute the squared error in units of its covariance [N], from [N, 3] and [N, 3, 3]."""
    solved = np.linalg.solve(covariance, error[..., None])[..., 0]
    return np.asarray(np.einsum("ni,ni->n", error, solved), dtype=np.float64)


def peak_ratio(position: Float, truth: Float, joints: Sequence[str], t_ns: Any) -> float | None:
    """Compare the peak speeds of wrists and ankles with the true ones; None if all of them are slow.

    Args:
        position: [T, J, 3] m.
        truth: [T, J, 3] m.
        joints: the J names.
        t_ns: [T] strictly increasing.
    """
    ratios = []
    span_s = (t_ns[2:] - t_ns[:-2])[:, None] / 1e9
    for name in _WRISTS_AND_ANKLES:
        if name not in joints:
            continue
        speed, true = (
            np.linalg.norm((path[2:, joints.index(name)] - path[:-2, joints.index(name)]) / span_s, axis=-1)
            for path in (position, truth)
        )
        both = np.isfinite(speed) & np.isfinite(true)
        if not both.any():
            continue
        speed, true = speed[both], true[both]
        fastest = np.argsort(true)[-max(1, round(_FASTEST_SHARE * len(true))) :]
        if true[fastest].mean() >= _FAST_MPS:
            ratios.append(speed[fastest].mean() / true[fastest].mean())
    return float(np.mean(ratios)) if ratios else None


def _fallback(metrics: Mapping[str, Any]) -> str | None:
    """Collect what the method left out: its refinement, or the backgrounds of cameras."""
    reasons = [metrics["refinement"]["fallback"]] if "refinement" in metrics else []
    background = metrics.get("background") or {}
    reasons += [
        f"{name}: {entry['reason']}"
        for name, entry in background.items()
        if isinstance(entry, dict) and not entry.get("used", True)
    ]
    return "; ".join(reason for reason in reasons if reason) or None


# --- the tables ----------------------------------------------------------------------------------------


def report(
    chosen: Sequence[Flight], methods: Sequence[str], detector: str, found: Mapping[Case, Outcome]
) -> list[str]:
    """Write the tables and the criteria as lines of Markdown."""
    given = [said for said in GIVEN if any(case.given == said for case in found if case.method not in _POSES)]
    draws = 1 + max(case.draw for case in found)
    lines = [f"Means over {draws} draws of the logs' errors."]
    for said in given:
        lines += ["", f"Pose noise: {_SAID[said]}. MPJPE / root-relative mm.", ""]
        lines += markdown_table(
            ["flight", "drones", *methods, "true poses", "shared error only"],
            [_errors_row(flight, methods, detector, said, found) for flight in chosen],
        )
        judged = "auto" if "auto" in methods else methods[-1]
        lines += ["", f"`{judged}`, {_SAID[said]}:", ""]
        lines += markdown_table(
            _QUALITY,
            [_quality_row(flight, judged, detector, said, found) for flight in chosen],
        )
        lines += ["", *criteria(chosen, judged, detector, said, found)]
    return lines


def parts_table(
    chosen: Sequence[Flight], parts: Sequence[str], detector: str, found: Mapping[Case, Outcome]
) -> list[str]:
    """Write the table of the first draw, with `auto` beside what it is made of."""
    first = {case: outcome for case, outcome in found.items() if not case.draw}
    rows = [_errors_row(flight, parts, detector, "model", first) for flight in chosen]
    said = "The parts of `auto`, on the first draw, its true model given. MPJPE / root-relative mm."
    return [
        "",
        said,
        "",
        *markdown_table(["flight", "drones", *parts, "true poses", "shared error only"], rows),
    ]


_QUALITY = (
    "flight",
    "acceleration m/s^2",
    "peak speed",
    "NEES",
    "in 95 % %",
    "measured %",
    "CPU s",
    "fell back",
)
_SAID: dict[Given, str] = {"model": "its true model given", "nothing": "nothing given"}


def _of(
    flight: Flight, method: str, detector: str, given: Given, found: Mapping[Case, Outcome]
) -> list[tuple[Case, Outcome]]:
    return [
        (case, outcome)
        for case, outcome in found.items()
        if (case.flight, case.method, case.detector, case.given) == (flight.name, method, detector, given)
    ]


def _mean(outcomes: Sequence[tuple[Case, Outcome]], name: str) -> float:
    values = [getattr(outcome, name) for _, outcome in outcomes]
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else float("nan")


def _cell(value: float, digits: int = 0) -> str:
    return "" if np.isnan(value) else f"{value:.{digits}f}"


def _errors_row(
    flight: Flight, methods: Sequence[str], detector: str, given: Given, found: Mapping[Case, Outcome]
) -> list[str]:
    cells = [flight.name, str(flight.scenario.drones.count)]
    for method in [*methods, *_POSES]:
        outcomes = _of(flight, method, detector, "model" if method in _POSES else given, found)
        mean = [_mean(outcomes, name) for name in ("mpjpe_mm", "root_mpjpe_mm")]
        failed = sum(outcome.error is not None for _, outcome in outcomes)
        cells.append(" / ".join(map(_cell, mean)) if failed < len(outcomes) else "")
    return cells


def _quality_row(
    flight: Flight, method: str, detector: str, given: Given, found: Mapping[Case, Outcome]
) -> list[str]:
    outcomes = _of(flight, method, detector, given, found)
    return [
        flight.name,
        _cell(_mean(outcomes, "acceleration_mps2"), 1),
        _cell(_mean(outcomes, "peak_ratio"), 2),
        _cell(_mean(outcomes, "nees"), 1),
        _cell(100 * _mean(outcomes, "inside")),
        _cell(100 * _mean(outcomes, "measured_share")),
        _cell(_mean(outcomes, "cpu_s"), 1),
        str(sum(outcome.fallback is not None for _, outcome in outcomes)),
    ]


# --- the criteria --------------------------------------------------------------------------------------


def criteria(
    chosen: Sequence[Flight], method: str, detector: str, given: Given, found: Mapping[Case, Outcome]
) -> list[str]:
    """Test what was asked of the default method, and of `robust`'s covariances, for each half by itself."""
    lines = []
    for half in HALVES:
        own = [f for f in chosen if f.half == half and f.name != SAMPLE.name]
        if not own:
            continue
        of = {flight: _of(flight, method, detector, given, found) for flight in own}
        verdicts = [*_against_robust(of, found), *_motion(of), *_covariances(of)]
        robust = {flight: _of(flight, "robust", detector, given, found) for flight in own}
        if method != "robust" and all(robust.values()):
            verdicts += [(f"`robust`, {said}", passed) for said, passed in _covariances(robust)]
        lines += [f"- {_VERDICT[passed]} {half}: {said}" for said, passed in verdicts]
        shared = {flight: _of(flight, SHARED, detector, "model", found) for flight in own}
        ratios = list(_ratios(shared, found, "mpjpe_mm").values())
        if ratios and given == "model":
            lines.append(
                f"- {half}: if all poses were exact but for the error that the cameras share, MPJPE would be"
                f" {np.median(ratios):.2f} of robust in the median, {max(ratios):.2f} at most"
            )
    sample = [flight for flight in chosen if flight.name == SAMPLE.name]
    if sample:
        outcomes = _of(sample[0], method, detector, given, found)
        errors = [_mean(outcomes, name) for name in ("mpjpe_mm", "root_mpjpe_mm")]
        wanted = _WANTED_OF_SAMPLE[detector]
        passed = all(error <= most for error, most in zip(errors, wanted, strict=True))
        lines.append(
            f"- {_VERDICT[passed]} sample: {errors[0]:.1f} / {errors[1]:.1f} mm"
            f" (at most {wanted[0]} / {wanted[1]}), {_mean(outcomes, 'cpu_s'):.1f} s of the processor"
        )
    return lines


_VERDICT = {True: "pass", False: "**fail**"}
_WANTED_OF_SAMPLE = {"blazepose": (62, 36), "blazepose-heavy": (56, 28)}
_Outcomes = Mapping[Flight, Sequence[tuple[Case, Outcome]]]
_Verdict = tuple[str, bool]


def _against_robust(of: _Outcomes, found: Mapping[Case, Outcome]) -> Iterator[_Verdict]:
    """Compare with `robust` on the same draws."""
    for name, title, wanted in (("mpjpe_mm", "MPJPE", 0.55), ("root_mpjpe_mm", "root-relative", 0.85)):
        ratios = _ratios(of, found, name)
        if not ratios:
            yield f"{title}: no results of robust to compare to", False
            continue
        worst = max(ratios, key=ratios.__getitem__)
        yield f"{title} at most 1.02 of robust: {ratios[worst]:.2f} on {worst}", ratios[worst] <= 1.02
        median = float(np.median(list(ratios.values())))
        yield f"{title} at most {wanted} of robust in the median: {median:.2f}", median <= wanted


def _ratios(of: _Outcomes, found: Mapping[Case, Outcome], name: str) -> dict[str, float]:
    """Compute each flight's mean error over that of `robust` on the same draws."""
    ratios: dict[str, float] = {}
    for flight, outcomes in of.items():
        pairs = []
        for case, outcome in outcomes:
            robust = getattr(found.get(replace(case, method="robust")), name, None)
            mine = getattr(outcome, name)
            if robust is not None and mine is not None:
                pairs.append((mine, robust))
        if pairs:
            ratios[flight.name] = float(np.mean([p[0] for p in pairs]) / np.mean([p[1] for p in pairs]))
    return ratios


def _motion(of: _Outcomes) -> Iterator[_Verdict]:
    error = float(np.median([_mean(outcomes, "acceleration_mps2") for outcomes in of.values()]))
    yield f"error of the acceleration at most 10 m/s^2 in the median: {error:.1f}", error <= 10
    peaks = {flight.name: _mean(outcomes, "peak_ratio") for flight, outcomes in of.items()}
    known = {name: value for name, value in peaks.items() if not np.isnan(value)}
    worst = max(known, key=lambda name: abs(known[name] - 1))
    off = [name for name, value in known.items() if abs(value - 1) > 0.1]
    yield f"peak speeds within 10 %: {known[worst]:.2f} on {worst}, {len(off)} flights off", not off


def _covariances(of: _Outcomes) -> Iterator[_Verdict]:
    each = np.array([_mean(outcomes, "nees") for outcomes in of.values()])
    mean = float(each.mean())
    yield f"mean NEES between 2 and 4.5: {mean:.2f}", 2 <= mean <= 4.5
    good = int(((each >= 0.5) & (each <= 8)).sum())
    yield f"NEES between 0.5 and 8 on 10 of 12 flights: {good} of {len(each)}", good >= len(each) * 10 / 12
    inside = float(np.mean([_mean(outcomes, "inside") for outcomes in of.values()]))
    yield f"90 % in the 95 % ellipsoids: {100 * inside:.0f} %", inside >= 0.9


if __name__ == "__main__":
    main()
