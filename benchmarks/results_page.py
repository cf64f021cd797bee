"""docs/results.md as text, from the numbers that `python -m benchmarks.results` measured."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from textwrap import wrap
from typing import Any

from pipelines.reporting.ablation import METRICS, tables

Numbers = dict[str, Any]

PLACE = "build/results"
_SAMPLE = "sample_data/mound_walk"
_TRIALS = 5
_STUDY_TABLES = ("mpjpe_mm", "root_mpjpe_mm", "reconstructed_share", "ratio")


@dataclass(frozen=True)
class PosesSection:
    """The sample flight with three kinds of poses: commands by session."""

    commands: Mapping[str, tuple[str, ...]]
    names: Mapping[str, str]
    compare: str
    figures: tuple[str, ...]
    measures: tuple[str, ...]


POSES = PosesSection(
    commands={
        "true": (
            f"mocap ingest {_SAMPLE}/true_poses.yaml -o {PLACE}/true.session",
            f"mocap reconstruct {PLACE}/true.session",
        ),
        "sample": (
            f"mocap ingest {_SAMPLE}/flight.yaml -o {PLACE}/sample.session",
            f"mocap reconstruct {PLACE}/sample.session",
        ),
        "background": (
            f"mocap ingest {_SAMPLE}/flight.yaml -o {PLACE}/background.session",
            f"mocap reconstruct {PLACE}/background.session --refine-cameras background",
        ),
    },
    names={
        "true": "true poses: the detector alone",
        "sample": "logged poses",
        "background": "logged poses, corrected by the background of the pictures",
    },
    compare=(
        f"mocap report {PLACE}/sample.session {PLACE}/background.session {PLACE}/true.session "
        f"-o {PLACE}/compared.html --figures {PLACE}/compared"
    ),
    figures=("compare-time", "compare-joints"),
    measures=("mpjpe_mm", "root_mpjpe_mm", "pa_mpjpe_mm", "pck150", "reconstructed_share_of_truth"),
)
ARM_COLUMNS = ("tilt mean deg", "max", "near obstacle", "hidden %", "MPJPE mm", "measured %")
_QUICK = "--methods dlt,midpoint,robust --seconds 20 --trials 5"
STUDIES = {
    "tilt": f"mocap ablate tilt {_QUICK} -o {PLACE}/tilt",
    "robots": f"mocap ablate robots {_QUICK} -o {PLACE}/robots",
}


def _planned(name: str) -> tuple[str, ...]:
    place, config = f"{PLACE}/{name}", "sample_data/planning/planner.yaml"
    return (
        f"mocap simulate sample_data/planning/{name}.yaml -o {place} --no-video",
        f"mocap ingest {place}/flight.yaml -o {place}.session",
        f"mocap replan-compare {place}.session --arms adaptive,fixed --trials {_TRIALS} --config {config}",
    )


SCENARIOS = {
    "sample": (f"mocap replan-compare {PLACE}/sample.session --trials {_TRIALS}",),
    "mound": _planned("mound"),
    "wall": _planned("wall"),
    "trees": _planned("trees"),
}
_ARM_KEYS = {"sample": ("arms-top",), "mound": ("arms-top", "arms-time")}
ARM_FIGURES = {
    name: (f"mocap report {PLACE}/{name}.session --figures {PLACE}/{name}-figures", keys)
    for name, keys in _ARM_KEYS.items()
}


def render(numbers: Numbers) -> str:
    """The page; the same numbers give the same text."""
    return "\n".join([*_head(numbers), *_poses(numbers), *_studies(numbers), *_arms(numbers)])


def _head(numbers: Numbers) -> list[str]:
    return [
        "# Results",
        "",
        "Every table and figure of this page is written by one command, from a clean clone:",
        "",
        "    mocap models fetch blazepose",
        "    python -m benchmarks.results      # or: make results",
        "",
        *_words(
            f"It takes about {numbers['cpu_minutes']} minutes of processor time and runs the commands above "
            "each table, in quick versions: shorter walks and fewer trials than [studies](studies.md) and "
            "[the planner](planner.md) have."
        ),
        *_words(
            "**Everything here is simulated**: body, flights, logs and pictures are made by "
            "`mocap simulate`. The detector that looks at the sample flight's pictures is the real one."
        ),
    ]


def _poses(numbers: Numbers) -> list[str]:
    rows = []
    for name, told in numbers["poses"].items():
        errors = [_fixed(told[key], 1) for key in POSES.measures[:3]]
        shares = [_fixed(100 * told[key], 1) for key in POSES.measures[3:]]
        rows.append([POSES.names[name], *errors, *shares])
    commands = [command for own in POSES.commands.values() for command in own]
    header = ["poses", "MPJPE mm", "root-relative mm", "PA mm", "PCK@150 mm %", "measured %"]
    return [
        "## The sample flight: what the poses cost",
        "",
        *_words(
            "`sample_data/mound_walk`: two drones, 12 s, BlazePose on the rendered pictures, method "
            "`robust`. The poses' errors are one draw of those that `sample_data/README.md` states."
        ),
        *_code([*commands, POSES.compare]),
        *markdown_table(header, rows),
        *_figure("poses-time", "Distance from truth over time; predicted error, tilt and share below"),
        *_figure("poses-joints", "Error of every joint, and how often it was measured"),
    ]


def _studies(numbers: Numbers) -> list[str]:
    titles = {"tilt": "Error against tilt", "robots": "Error against the number of drones"}
    lines = [
        "## Studies: tilt and number of drones",
        "",
        *_words(
            "A walk of 20 s, 5 trials, keypoints of the modelled detector; in brackets 95 % of bootstrap "
            "means over trials. Pose noise per axis: low 0.1 m / 0.5 deg, medium 0.3 m / 1 deg, high 0.5 m / "
            "2 deg. [Studies](studies.md) has 75 s, 10 trials, and what the tables say."
        ),
    ]
    wanted = {METRICS[key] for key in _STUDY_TABLES if key in METRICS}
    for name, summary in numbers["studies"].items():
        lines += [f"### {titles[name]}", "", *_code([STUDIES[name]])]
        for table in tables(summary):
            if table.title in wanted or table.title.startswith("MPJPE relative to"):
                lines += [f"{table.title}:", "", *markdown_table(table.header, table.rows)]
        lines += _figure(f"study-{name}", f"{titles[name]}, for every method and level of pose noise")
    return lines


def _arms(numbers: Numbers) -> list[str]:
    rows, verdicts = [], []
    for scenario, told in numbers["arms"].items():
        for arm, scores in told["arms"].items():
            error = _estimate(scores["reconstruction_error"]["mpjpe_mm"])
            rows.append([scenario, arm, *arm_figures(scores, error)])
        verdicts.append(f"- **{scenario}**: {told['verdict']}")
    commands = [command for own in SCENARIOS.values() for command in own]
    lines = [
        "## Planners: adaptive against fixed",
        "",
        *_words(
            f"The planners fly again against the logged actor and the map; {_TRIALS} draws of noise. `flown` "
            "is what the log of the sample says. Errors are on joint-frames that all arms measured."
        ),
        *_code([*commands, *(command for command, _ in ARM_FIGURES.values())]),
        *markdown_table(["flight", "arm", *ARM_COLUMNS], rows),
        *verdicts,
        "",
    ]
    for name, (_, keys) in ARM_FIGURES.items():
        for key in keys:
            what = "from above" if key == "arms-top" else "over time: tilt, range, sight, predicted error"
            lines += _figure(f"{name}-{key}", f"The arms of {name} {what}")
    return lines


def _words(text: str) -> list[str]:
    return [*wrap(text, 118, break_long_words=False, break_on_hyphens=False), ""]


def _code(commands: Sequence[str]) -> list[str]:
    return [*(f"    {command}" for command in commands), ""]


def arm_figures(scores: Mapping[str, Any], error: str) -> list[str]:
    """What `ARM_COLUMNS` name of the scores in replan/metrics.json; `error` as it is to be said."""
    tilt, coverage = scores["tilt_deg"], scores["reconstruction_error"]["coverage"]
    return [
        _fixed(tilt["mean"], 1),
        _fixed(tilt["max"], 1),
        _fixed(tilt["near_obstacle"], 1),
        _fixed(100 * scores["occluded_share"], 1),
        error,
        _fixed(100 * coverage["mean"], 1),
    ]


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """A table, and an empty line behind it."""
    lines = [header, ["---"] * len(header), *rows]
    return [*(f"| {' | '.join(line)} |" for line in lines), ""]


def _figure(name: str, words: str) -> list[str]:
    return [f"![{words} (simulated)](figures/{name}.svg)", "", f"*{words}. Simulated.*", ""]


def _fixed(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _estimate(told: Mapping[str, Any]) -> str:
    if told["mean"] is None or told["interval"] is None:
        return _fixed(told["mean"], 1)
    low, high = told["interval"]
    return f"{told['mean']:.1f} [{low:.1f}, {high:.1f}]"
