"""The page of results: docs/results.md, written from docs/results.json.

    python -m benchmarks.results             # measure the sample and the planner (10 min), write the page
    python -m benchmarks.results --only sample-poses
    python -m benchmarks.results --page      # write the page alone
    python -m benchmarks.results --check     # exit 1 if the page is not what docs/results.json gives

The other commands of `benchmarks` replace their parts of the page with `--write`.
"""

import argparse
import json
import math
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from textwrap import wrap
from typing import Any

from pipelines.reporting.studies import tables
from pipelines.session.storage import read_json

ROOT = Path(__file__).parents[1]
PAGE, STORE = ROOT / "docs" / "results.md", ROOT / "docs" / "results.json"
PLACE = ROOT / "build" / "results"
REAL = "real"
RENDERED = "rendered pictures, real detector"
MODELLED = "modelled"


@dataclass(frozen=True)
class Part:
    """One table of the page."""

    key: str
    title: str
    kind: str
    halves: str = ""  # on which flights: tuned on, kept aside, or neither


@dataclass(frozen=True)
class Section:
    """Tables of one subject, below a few sentences."""

    title: str
    words: str
    parts: tuple[Part, ...]


TUNED, KEPT = "tuned on", "kept aside"
SECTIONS = (
    Section(
        "Skeletons",
        "Errors are those of joints, in mm. The error that all cameras share bounds what any method reaches."
        " NEES of 3 is right.",
        (
            Part("sample-poses", "The sample flight", RENDERED, TUNED),
            Part("corpus-model", "The corpus, pose noise stated", RENDERED, KEPT),
            Part("corpus-nothing", "The corpus, pose noise not stated", RENDERED, KEPT),
            Part("angles", "Joint angles", RENDERED, KEPT),
            Part("corpus-special", "`auto` without each of its special cases", RENDERED, "17-stand tuned on"),
            Part("corpus-faults", "Faults of one drone that nobody states", RENDERED, "tuned on"),
            Part("bodies", "Bodies with a surface, noise stated", RENDERED, KEPT),
        ),
    ),
    Section(
        "Real pictures",
        "Pose2Sim's demo: one person, four still cameras. Virtual gimbals crop and turn the videos along"
        " known paths; attitude errors are drawn. The reference is `robust` from still cameras. Bounds are"
        " those of exact paths.",
        (
            Part("gimbals-kept", "Cameras that turn", REAL, KEPT),
            Part("gimbals-tuned", "Cameras that turn", REAL, TUNED),
            Part("attitudes-kept", "Attitudes from pictures", RENDERED, KEPT),
            Part("attitudes-tuned", "Attitudes from pictures", RENDERED, TUNED),
            Part("attitudes-used-kept", "Joints with them", RENDERED, KEPT),
            Part("joined", "No log, stature stated", RENDERED, f"two {TUNED}"),
            Part("detectors", "Detectors", REAL, ""),
        ),
    ),
    Section(
        "Several people",
        "Coverage is the share of times at which two cameras see somebody and a reconstructed person is"
        " within 0.5 m. Switches, phantoms and IDF1 are those of metrics.json.",
        (Part("people", "Scenes with three drones", MODELLED, KEPT),),
    ),
    Section(
        "Mistakes in flight.yaml",
        "Each flight is described with one mistake. It counts if the error grows by more than 20 %."
        " Named: the first doubt has the right code. Mended: its remedy brings the error within 10 % of"
        " the right one. Fitted: it states poses with standard deviations; true: within two of these. Made"
        " worse: a remedy raises error or misfit.",
        (
            Part("mistakes-kept", "Mistakes named and mended", MODELLED, KEPT),
            Part("mistakes-tuned", "Mistakes named and mended", MODELLED, TUNED),
            Part("mistakes-film-kept", "Mistakes in the times of all pictures", RENDERED, KEPT),
            Part("mistakes-film-tuning", "Mistakes in the times of all pictures", RENDERED, TUNED),
            Part("mistakes-right", "Right flights that are doubted", MODELLED, ""),
            Part("expected-errors", "Expected errors of verdicts", MODELLED, KEPT),
        ),
    ),
    Section(
        "Planner",
        "Errors are those of joints that all arms measured. Differences: `adaptive` less the flight as flown;"
        " by keypoints: the model with those of the films. Worlds to 14 set the model's deviations.",
        (
            Part("filmed", "The paper's experiments, filmed", RENDERED, ""),
            Part("planner-worlds", "Random worlds", MODELLED, KEPT),
            Part("planner-films", "Modelled and filmed differences", RENDERED, "kept aside from world 15 on"),
            Part("planner-filming", "View quality of published plans, and of ours", REAL, ""),
            Part("planner-groups", "Groups that split", MODELLED, KEPT),
        ),
    ),
    Section(
        "Studies",
        "A walk, keypoints of the modelled detector, method `robust`; `dlt` and `midpoint` differ by less"
        " than the intervals. Noise per axis: low 0.1 m and 0.5 deg, medium 0.3 m and 1 deg, high 0.5 m"
        " and 2 deg.",
        (
            Part("study-tilt", "Error against tilt", MODELLED, ""),
            Part("study-drones", "Error against the number of drones", MODELLED, ""),
        ),
    ),
    Section(
        "Time and size",
        "Processor time of one slow core, compiled code warm.",
        (
            Part("speed", "Speed, and peers", "measured", ""),
            Part("scale", "Long flights: memory and time", MODELLED, ""),
        ),
    ),
)


# --- the store and the page ------------------------------------------------------------------------------


def keep(key: str, lines: Sequence[str], command: str | None = None) -> None:
    """Replace a part of docs/results.json by these lines of Markdown, and write the page."""
    assert any(key == part.key for section in SECTIONS for part in section.parts), key
    asked = ["git", "rev-parse", "--short", "HEAD"]
    done = subprocess.run(asked, cwd=ROOT, capture_output=True, text=True, check=False)  # noqa: S603
    module = sys.modules["__main__"].__spec__
    name = module.name.removesuffix(".__main__") if module else "benchmarks"
    stored = read_json(STORE)
    stored[key] = {
        "command": command or shlex.join(["python", "-m", name, *sys.argv[1:]]),
        "date": datetime.now(UTC).date().isoformat(),
        "commit": done.stdout.strip(),
        "lines": list(lines),
    }
    STORE.write_text(json.dumps(stored, indent=1) + "\n", encoding="utf-8")
    PAGE.write_text(page_of(stored), encoding="utf-8")


def parser_of(words: str | None) -> argparse.ArgumentParser:
    """Make the parser of a benchmark whose docstring is its help; `--write` keeps its table."""
    parser = argparse.ArgumentParser(description=words, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", action="store_true", help="put the table into docs/results.md")
    return parser


def show(key: str, lines: Sequence[str], *, write: bool) -> None:
    """Print a table, and keep it if asked."""
    print("\n".join(["", *lines]), flush=True)
    if write:
        keep(key, lines)


def page_of(stored: Mapping[str, Mapping[str, Any]]) -> str:
    """Write the page as text; equal parts give equal text."""
    lines = [
        "# Results",
        "",
        *_words(
            "All figures, with kind, command, date and commit."
            " `python -m benchmarks.results` measures the sample again and writes this page; the other"
            " commands replace their tables with `--write`. Of flights kept aside, 22-jog alone chose a"
            " constant (free white errors). Closed loops amplify rounding: other processors change their"
            " figures by up to 8 %."
        ),
    ]
    before = ""  # the command of the table above, which is not repeated
    for section in SECTIONS:
        measured = [part for part in section.parts if part.key in stored]
        lines += [f"## {section.title}", "", *_words(section.words)] if measured else []
        for part in measured:
            one = stored[part.key]
            kind = ", ".join(filter(None, (part.kind, part.halves)))
            lines += [f"**{part.title}** ({kind}; {one['date']}, {one['commit']})", ""]
            new = one["command"] != before
            lines += [*(f"    {command}" for command in one["command"].splitlines() if new), *[""] * new]
            lines += [*one["lines"], ""]
            before = one["command"]
    return "\n".join(lines).rstrip() + "\n"


def _words(text: str) -> list[str]:
    return [*wrap(text, 118, break_long_words=False, break_on_hyphens=False), ""]


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Format a table."""
    return [f"| {' | '.join(line)} |" for line in (header, ["---"] * len(header), *rows)]


def fixed(value: float | None, digits: int = 0) -> str:
    """Format a number; "-" for none."""
    return "-" if value is None or math.isnan(value) else f"{value:.{digits}f}"


def with_interval(stated: Mapping[str, Any], digits: int = 1) -> str:
    """Format a mean with its 95 % interval, as metrics.json has it."""
    if stated["mean"] is None or stated["interval"] is None:
        return fixed(stated["mean"], digits)
    low, high = stated["interval"]
    return f"{stated['mean']:.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]"


# --- the sample, the planners' scenarios and the studies -------------------------------------------------

SAMPLE = "sample_data/mound_walk"
POSES = {
    "true poses: the detector alone": ("true_poses", "--method robust"),
    "logged poses, `robust`": ("flight", "--method robust"),
    "logged poses, `auto`": ("flight", ""),
}
POSE_FIGURES = ("mpjpe_mm", "root_mpjpe_mm", "pa_mpjpe_mm", "pck150", "reconstructed_share_of_truth")
FILMED = {
    "E2, mound": (
        "real_e2",
        "--arms adaptive,fixed --config sample_data/planning/real_e2_planner.yaml --config yaw_deg=45"
        " --render 5,start=23,end=28",
    ),
    **{
        f"E3, {name}": (
            scenario,
            "--arms adaptive --config sample_data/planning/real_e3_planner.yaml"
            f" --render 10,start={start},end={start + 5}",
        )
        for name, scenario, start in (("jogging", "real_e3_jog", 4), ("soccer", "real_e3_soccer", 5))
    },
}
_WALK = "noise=none,low,medium,high method=robust seconds=20 trials=5"
STUDIES = {
    "study-tilt": f"mocap study tilt_deg=0:60:15 {_WALK} -o FOLDER",
    "study-drones": f"mocap study robots=2,3,4,5 {_WALK} -o FOLDER",
}


def _run(command: str) -> None:
    """Run `mocap ...` of this environment from the top of the repository."""
    print(command, flush=True)
    first, *words = shlex.split(command)
    program = [str(Path(sys.executable).with_name(first)), *words]
    done = subprocess.run(program, cwd=ROOT, capture_output=True, text=True, check=False)  # noqa: S603
    if done.returncode:
        raise SystemExit(f"{command}\n{done.stderr}")


def measure_poses() -> None:
    """Reconstruct the sample from true and from logged poses."""
    rows = []
    for number, (name, (manifest, options)) in enumerate(POSES.items()):
        session = PLACE / f"poses{number}.session"
        _run(f"mocap ingest {SAMPLE}/{manifest}.yaml -o {session}")
        _run(f"mocap reconstruct {session} {options}")
        found = read_json(session / "reconstruct" / "metrics.json")
        shares = [100 * found[key] for key in POSE_FIGURES[3:]]
        rows.append([name, *(fixed(v, 1) for v in [*(found[key] for key in POSE_FIGURES[:3]), *shares])])
    header = ["poses", "MPJPE", "root-relative", "PA", "PCK@150 mm %", "measured %"]
    command = f"mocap ingest {SAMPLE}/flight.yaml; mocap reconstruct SESSION"
    keep("sample-poses", markdown_table(header, rows), command)


def _simulated(scenario: str) -> Path:
    """Simulate and ingest a scenario of the planner; return the session."""
    place = PLACE / scenario
    _run(f"mocap simulate sample_data/planning/{scenario}.yaml -o {place} --no-video")
    _run(f"mocap ingest {place}/flight.yaml -o {place}.session")
    return place.with_suffix(".session")


def measure_filmed() -> None:
    """Film the paper's experiments with real drones in simulation; poses err by 0.02 m and 0.2 deg."""
    rows, verdicts = [], []
    for name, (scenario, options) in FILMED.items():
        session = _simulated(scenario)
        _run(f"mocap replan-compare {session} {options}")
        filmed = read_json(session / "film" / "metrics.json")
        for arm, scores in filmed["arms"].items():
            errors = scores["reconstruction_error"]
            rows.append(
                [
                    *(name, arm, *(fixed(scores["tilt_deg"][key], 1) for key in ("mean", "max"))),
                    fixed(100 * scores["keypoint_pck"], 1),
                    fixed(100 * errors["coverage"]["mean"], 1),
                    fixed(100 * errors["pck150"]["mean"], 1),
                    with_interval(errors["mpjpe_mm"]),
                ]
            )
        if filmed["best"] is not None:
            verdicts.append(filmed["verdict"])
    header = ["experiment", "arm", "tilt mean deg", "max", "keypoints right %", "measured %"]
    header += ["PCK@150 mm %", "MPJPE"]
    keep("filmed", [*markdown_table(header, rows), "", *verdicts], "mocap replan-compare SESSION --render 5")


def measure_studies() -> None:
    """Study the error against tilt and against the number of drones."""
    for key, command in STUDIES.items():
        _run(command.replace("FOLDER", str(PLACE / key)))
        lines: list[str] = []
        for table in tables(read_json(PLACE / key / "metrics.json")):
            if table.title.startswith("MPJPE, "):
                rows = [[row[0], *(cell.partition(" [")[0] for cell in row[2:])] for row in table.rows]
                header = [f"noise; {table.title}", *table.header[2:]]
                lines += [*markdown_table(header, rows), ""]
        keep(key, lines[:-1], command)


MEASURES: dict[str, Callable[[], None]] = {
    "sample-poses": measure_poses,
    "filmed": measure_filmed,
    "studies": measure_studies,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--only", choices=MEASURES, help="measure one part")
    parser.add_argument("--page", action="store_true", help="write the page alone")
    parser.add_argument("--check", action="store_true", help="check that the page is up to date")
    options = parser.parse_args()
    if options.check:
        sys.exit(0 if PAGE.read_text(encoding="utf-8") == page_of(read_json(STORE)) else f"{PAGE}: is old")
    if not options.page:
        if not options.only:
            shutil.rmtree(PLACE, ignore_errors=True)
        PLACE.mkdir(parents=True, exist_ok=True)
        for name, measure in MEASURES.items():
            if options.only in (None, name):
                measure()
    PAGE.write_text(page_of(read_json(STORE)), encoding="utf-8")
    print(f"written: {PAGE}")


if __name__ == "__main__":
    main()
