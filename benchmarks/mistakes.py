"""Mistakes in a flight's description: are they doubted, named, and does the remedy mend them?

    python -m benchmarks.mistakes [--kept] [--less-usual] [FLIGHT ...]
    python -m benchmarks.mistakes --right 40 [--seed 100]          # right flights: none should be doubted
    python -m benchmarks.mistakes --corpus tuning|kept             # with real detectors on rendered pictures
    python -m benchmarks.mistakes --expected 42 [--seed 900]       # are expected errors right?

Right flights (modelled keypoints) are described anew with one mistake each. It counts if the error of the
skeleton grows by more than 20 %, or nothing is reconstructed. `named`: the first doubt has the right code.
Its remedy is put into the manifest. `mended`: that brings the error back to within 10 % of the right one;
`worse`: it raises the error, or the misfit that the doubt states. `fitted`: it states poses with standard
deviations; `true`: within two of these. Every third right flight is of somebody who lies or turns cartwheels.

With --expected, modelled flights of several geometries are reconstructed by `auto`, with and without their
pose noise in flight.yaml. Counted is how often the true error lies inside the 80 % interval of the verdict.

With --corpus, the flights are those of `benchmarks.corpus`. They are checked as they are, and with mistakes
in the times of all pictures, which backgrounds alone can show. `--write` puts the counts into the results.
"""

import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, get_args
from unittest.mock import patch

import numpy as np
from ruamel.yaml import YAML

from benchmarks.corpus.drawn import DrawnFlight, Given, kept_in_place_of_pictures
from benchmarks.corpus.stored import DETECTORS, HALVES, Flight, Half, flights
from benchmarks.results import fixed, markdown_table, parser_of, show
from pipelines.check import check
from pipelines.detect import detect, follow
from pipelines.geometry.poses import compose, invert, rotation_vector_from_quaternion
from pipelines.ingest import ingest
from pipelines.reconstruct import ReconstructSettings, reconstruct
from pipelines.session.description import Doubt
from pipelines.session.errors import DataError
from pipelines.session.stages import locked
from pipelines.session.tables import read_poses
from tests.synthetic.described_flights import (
    FLIGHTS,
    KEPT_ASIDE,
    LESS_USUAL,
    MISTAKES,
    Described,
    Mistake,
    acrobatic_flight,
    measured,
    mistaken,
    right_flight,
    with_remedy,
    written,
)


class Outcome(NamedTuple):
    """Result of one mistake: its errors, its doubts, and whether the remedy mends it."""

    counts: bool  # the error grows by more than 20 %
    doubted: bool
    named: bool  # by the first doubt
    remedied: bool  # the first doubt has a remedy
    mended: bool
    fitted: bool
    true: bool
    worse: bool


def described(folder: Path, names: list[str], only: list[str], *, kept: bool, rare: bool) -> list[str]:
    """Make each mistake in each flight, print a line for each, and return the counts."""
    drones: dict[int, list[Outcome]] = {}
    by_mistake: dict[str, list[Outcome]] = {}
    print("| flight | mistake | error mm | first doubt | named | remedied mm | off in sigmas |")
    for flight in KEPT_ASIDE if kept else FLIGHTS:
        if names and flight.name not in names:
            continue
        own = Described(flight, folder / flight.name)
        right, doubts, stopped = measured(mistaken(own, None))
        row(flight.name, "none", right, doubts[0]["code"] if doubts else stopped or "-", "", "")
        for mistake in LESS_USUAL if rare else MISTAKES:
            if mistake.fits(flight) and (not only or mistake.name in only):
                outcome = tried(own, mistake, right or float("nan"))
                drones.setdefault(flight.drones, []).append(outcome)
                by_mistake.setdefault(mistake.name, []).append(outcome)
    for name, found in by_mistake.items():
        print(f"{name}: named, remedied, mended, fitted, true, worse of all: {' '.join(counted(found)[2:])}")
    header = "drones, mistakes that count, doubted, named first, remedies, mended, fitted, true, made worse"
    rows = [[str(n), *counted(each)] for n, each in sorted(drones.items())]
    return markdown_table(header.split(", "), rows)


def counted(found: Sequence[Outcome]) -> list[str]:
    """Count the mistakes that count, and what became of them; those that any remedy made worse."""
    columns = list(zip(*(each for each in found if each.counts), strict=True)) or [()] * 8
    return [*(str(sum(column)) for column in columns[:-1]), str(sum(each.worse for each in found))]


def tried(own: Described, mistake: Mistake, right: float) -> Outcome:
    """Make a mistake, and return what became of it."""
    if (compared := mistake.compared(own.flight)) != "mpjpe_mm":
        right = measured(mistaken(own, None), compared)[0] or float("nan")
    manifest = mistaken(own, mistake.change)
    error, doubts, stopped = measured(manifest, compared)
    first = doubts[0] if doubts else None
    named = bool(first and first["code"] in mistake.codes)
    off: list[float] = []
    after, why, remedied = None, "", first is not None and with_remedy(manifest, first["remedy"])
    if first and remedied:
        with patch("pipelines.reconstruct.doubts_of", lambda *_, **__: []):  # only the error is looked at
            after, _, why = measured(manifest, compared)
        if compared == "mpjpe_mm" and after is not None:  # else the place is not known
            off = off_sigmas(own, manifest.with_suffix(".session"), first["evidence"])
    mended = after is not None and after <= 1.1 * right
    misfits = first["evidence"].get("tried") if first else None
    raised = misfits is not None and misfits["misfit_after"] > misfits["misfit_before"]
    grown = remedied and error is not None and (after is None or after > 1.05 * error)
    worse = raised or (grown and not mended)
    counts = error is None or error > 1.2 * right
    verdict = ("yes" if named else "NO") if counts else f"({'yes' if named else 'no'})"
    said = f"{first['code']}: {first['what']}" if first else (stopped or "nothing")
    row(own.flight.name, mistake.name, error, said, verdict, fixed(after) if after else why, off)
    return Outcome(counts, bool(doubts), named, remedied, mended, bool(off), max(off, default=9) < 2, worse)


def off_sigmas(own: Described, session: Path, evidence: dict[str, Any]) -> list[float]:
    """Return how far stated poses are from the true ones, in the standard deviations of a remedy."""
    off = []
    for name, (_, right) in own.cameras.items():
        track = read_poses(session / "cameras" / name / "poses.parquet")
        moved, turned = compose(invert(*right), (track.position, track.quaternion_xyzw))
        apart = (moved, np.degrees(rotation_vector_from_quaternion(turned)))
        off.append([float(np.median(np.linalg.norm(each, axis=1))) for each in apart])
    worst = dict(zip(("shift_sigma_m", "turn_sigma_deg"), np.max(off, axis=0), strict=True))
    return [round(float(value) / evidence[key], 1) for key, value in worst.items() if evidence.get(key)]


def row(flight: str, mistake: str, error: float | None, *cells: object) -> None:
    """Print a line of the table."""
    print(f"| {flight} | {mistake} | {fixed(error)} |", *(f"{cell} |" for cell in cells), flush=True)


def right_flights(folder: Path, seeds: range) -> list[str]:
    """Check random right flights, print those that are doubted, and return the count."""
    doubted = []
    for seed in seeds:
        flight = acrobatic_flight(seed, folder) if seed % 3 == 0 else right_flight(seed)
        if doubts := check(mistaken(Described(flight, folder / flight.name), None)).doubts:
            doubted.append(doubts[0].code)
            print(f"{flight}\n  {doubts[0].code}: {doubts[0].what} {doubts[0].evidence}", flush=True)
    return markdown_table(["right flights", "doubted"], [[str(len(seeds)), str(len(doubted))]])


# --- expected errors ---------------------------------------------------------------------------------------

GEOMETRIES: dict[str, tuple[int, tuple[int, ...], tuple[float, float], tuple[float, float]]] = {
    "near": (2, (0, 1), (4, 6), (5, 35)),
    "usual": (2, (0, 1), (8, 12), (5, 35)),
    "far": (2, (0, 1), (18, 25), (5, 35)),
    "opposite": (4, (0, 2), (8, 12), (5, 35)),
    "three": (3, (0, 1, 2), (8, 14), (5, 35)),
    "high": (2, (0, 1), (8, 12), (45, 60)),
}
"""Drones that fly, those of them that film, and the ranges of radius (m) and tilt (deg)."""


def expected_errors(folder: Path, seeds: range) -> list[str]:
    """Reconstruct flights of all geometries, print each, and count true errors inside the 80 % intervals."""
    inside: dict[str, list[bool]] = {}
    for seed in seeds:
        draw = np.random.default_rng(seed)
        geometry, (flown, filming, radius_m, tilt_deg) = list(GEOMETRIES.items())[seed % len(GEOMETRIES)]
        formation = (
            f"{{radius_m: {draw.uniform(*radius_m):.1f}, tilt_deg: {draw.uniform(*tilt_deg):.0f},"
            f" yaw_deg: {draw.uniform(0, 360):.0f}, yaw_rate_deg_per_s: {draw.uniform(-10, 10):.1f}}}"
        )
        flight = replace(right_flight(seed), name=f"expected{seed}", drones=flown, formation=formation)
        own = Described(flight, folder / flight.name)
        known = seed // len(GEOMETRIES) % 3  # the noise is stated, or only the log's own, or nobody's
        made = mistaken(own, None) if known == 2 else own.folder / "made" / "flight.yaml"
        document = YAML(typ="safe").load(made.read_text(encoding="utf-8"))
        document["cameras"] = dict(list(document["cameras"].items())[index] for index in filming)
        document["truth"] = "made/truth/joints.csv" if known == 2 else "truth/joints.csv"
        for camera in document["cameras"].values() if known else ():
            del camera["pose_noise"]
        session = own.folder / "expected.session"
        shutil.rmtree(session, ignore_errors=True)
        ingest(written(document, made.with_name("expected.yaml")), session)
        try:
            with patch("pipelines.reconstruct.doubts_of", lambda *_, **__: []):
                metrics = reconstruct(session, ReconstructSettings()).metrics
        except DataError as refusal:
            print(f"| {seed} | {geometry} | refused: {refusal.code} | | |", flush=True)
            continue
        low, median, high = metrics["verdict"]["expected_error_mm"]
        error, source = metrics["mpjpe_mm"], metrics["method_used"]["pose_noise"]
        for kind in ("all", geometry, f"pose noise {source}"):
            inside.setdefault(kind, []).append(low <= error <= high)
        print(f"| {seed} | {geometry} | {source} | {error:.0f} | {low} {median} {high} |", flush=True)
    rows = [[kind, str(len(found)), f"{np.mean(found):.0%}"] for kind, found in inside.items()]
    return markdown_table(["flights", "number", "true error inside the 80 % interval"], rows)


CORPUS_MISTAKES: dict[str, tuple[str, int | None, float, float]] = {
    "none": ("", 0, 0.0, 1.0),
    "clock 0.5 s, all": ("clock", None, 0.5, 1.0),
    "clock 0.3 s, one": ("clock", 1, 0.3, 1.0),
    "30 for 24 Hz, all": ("frame_rate", None, 0.0, 1.25),
}
"""Codes, how many cameras (None: all) are late by seconds, and by which factor their pictures come faster."""


def corpus(folder: Path, half: Half) -> list[str]:
    """Check the flights of the corpus, right and with mistakes in their times."""
    told: dict[tuple[str, bool], list[bool]] = {}
    for flight in flights([half]):
        if flight.missing_motions:
            continue
        drawn = DrawnFlight(flight, folder / flight.name)
        drawn.write_shared()
        off = any(flight.scenario.drones.clock_offsets_s)
        for given in get_args(Given):
            with tempfile.TemporaryDirectory() as place:
                drawn.session(Path(place) / "flight", 0, given, DETECTORS[0])
                for mistake, (code, *_) in CORPUS_MISTAKES.items():
                    if not code or (flight.with_pictures and given == "model"):
                        doubts = _doubted(flight, Path(place) / "flight", mistake)
                        said = f"{doubts[0].code}: {doubts[0].what}" if doubts else "nothing"
                        told.setdefault((mistake, off), []).append(
                            bool(doubts) and code in ("", doubts[0].code)
                        )
                        print(f"| {flight.name} | {given} | {mistake} | {said} |", flush=True)
    rows = [
        [mistake, "off" if off else "right", f"{sum(found)} of {len(found)}"]
        for (mistake, off), found in told.items()
    ]
    return markdown_table(["mistake", "clocks", "named first (none: doubted)"], rows)


def _doubted(flight: Flight, place: Path, mistake: str) -> list[Doubt]:
    _, some, late_s, faster = CORPUS_MISTAKES[mistake]
    document = YAML(typ="safe").load((place / "flight.yaml").read_text(encoding="utf-8"))
    for camera in list(document["cameras"].values())[:some]:
        camera["clock"]["offset_s"] += late_s
        if faster != 1:
            camera["frame_times"]["fps"] = faster * flight.scenario.drones.camera.rate_hz
    session = place / f"{mistake}.session"
    ingest(written(document, place / f"{mistake}.yaml"), session)
    with kept_in_place_of_pictures(flight, DETECTORS[0]), locked(session) as writable:
        detect(writable, detector=DETECTORS[0])
        if flight.with_pictures:
            follow(writable)
    return check(session).doubts


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("--folder", type=Path, default=Path(tempfile.gettempdir()) / "mocap_mistakes")
    parser.add_argument("--kept", action="store_true", help="the flights that were kept aside")
    parser.add_argument("--less-usual", action="store_true", help="make less usual mistakes instead")
    parser.add_argument("--mistake", action="append", default=[], help="only these; repeat it for several")
    parser.add_argument("--right", type=int, metavar="N", help="check random right flights instead")
    parser.add_argument("--expected", type=int, metavar="N", help="check the expected errors of N flights")
    parser.add_argument("--seed", type=int, default=100, help="the first of the right flights")
    parser.add_argument("--corpus", choices=HALVES, help="check the flights of the corpus instead")
    parser.add_argument("flights", nargs="*")
    options = parser.parse_args()
    if options.right:
        key = "mistakes-right"
        lines = right_flights(options.folder, range(options.seed, options.seed + options.right))
    elif options.expected:
        key = "expected-errors"
        lines = expected_errors(options.folder, range(options.seed, options.seed + options.expected))
    elif options.corpus:
        key, lines = f"mistakes-film-{options.corpus}", corpus(options.folder / "corpus", options.corpus)
    else:
        key = "mistakes-kept" if options.kept else "mistakes-tuned"
        chosen = {"kept": options.kept, "rare": options.less_usual}
        lines = described(options.folder, options.flights, options.mistake, **chosen)
    show(key, lines, write=options.write)


if __name__ == "__main__":
    main()
