"""Text of docs/results.md, from the numbers that `python -m benchmarks.results` measured."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from textwrap import wrap
from typing import Any

from pipelines.reporting.studies import METRICS, tables

Numbers = dict[str, Any]

PLACE = "build/results"
_SAMPLE = "sample_data/mound_walk"
_TRIALS = 5
_STUDY_TABLES = ("mpjpe_mm", "root_mpjpe_mm", "reconstructed_share", "ratio")


@dataclass(frozen=True)
class PosesSection:
    """Section on the sample flight with three kinds of poses: commands by session."""

    commands: Mapping[str, tuple[str, ...]]
    names: Mapping[str, str]
    compare: str
    figures: tuple[str, ...]
    measures: tuple[str, ...]


POSES = PosesSection(
    commands={
        "true": (
            f"mocap ingest {_SAMPLE}/true_poses.yaml -o {PLACE}/true.session",
            f"mocap reconstruct {PLACE}/true.session --method robust",
        ),
        "sample": (
            f"mocap ingest {_SAMPLE}/flight.yaml -o {PLACE}/sample.session",
            f"mocap reconstruct {PLACE}/sample.session --method robust",
        ),
        "background": (
            f"mocap ingest {_SAMPLE}/flight.yaml -o {PLACE}/background.session",
            f"mocap reconstruct {PLACE}/background.session --method robust --refine-cameras background",
        ),
        "auto": (
            f"mocap ingest {_SAMPLE}/flight.yaml -o {PLACE}/auto.session",
            f"mocap reconstruct {PLACE}/auto.session",
        ),
    },
    names={
        "true": "true poses: the detector alone",
        "sample": "logged poses",
        "background": "logged poses, corrected by the background of the pictures",
        "auto": "logged poses, as `mocap reconstruct` does unasked",
    },
    compare=(
        f"mocap report {PLACE}/sample.session {PLACE}/background.session {PLACE}/auto.session "
        f"{PLACE}/true.session -o {PLACE}/compared.html --figures {PLACE}/compared"
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


def _filmed(name: str, scenario: str, options: str) -> tuple[str, ...]:
    place = f"{PLACE}/{name}"
    return (
        f"mocap simulate sample_data/planning/{scenario}.yaml -o {place} --no-video",
        f"mocap ingest {place}/flight.yaml -o {place}.session",
        f"mocap replan-compare {place}.session {options}",
    )


_E3 = "--arms adaptive --config sample_data/planning/real_e3_planner.yaml --trials 2 --render --render-hz 10"
FILMED = {
    "e2": _filmed(
        "e2",
        "real_e2",
        "--arms adaptive,fixed --config sample_data/planning/real_e2_planner.yaml --yaw 45 --trials 2 "
        "--render --render-hz 5 --render-start 23 --render-end 28",
    ),
    "jog": _filmed("jog", "real_e3_jog", f"{_E3} --render-start 4 --render-end 9"),
    "soccer": _filmed("soccer", "real_e3_soccer", f"{_E3} --render-start 5 --render-end 10"),
}
"""Flights that are rendered and passed to the real detector: commands by name."""
FILMED_NAMES = {"e2": "E2, mound", "jog": "E3, jogging", "soccer": "E3, soccer"}
STILL = "e2-filmed.jpg"


def render(numbers: Numbers) -> str:
    """Write the page as text; the same numbers give the same text."""
    return "\n".join(
        [
            *_head(numbers),
            *_poses(numbers),
            *_studies(numbers),
            *_arms(numbers),
            *_filming(numbers),
            *_gimbals(numbers),
            *_accuracy(numbers),
        ]
    )


def _head(numbers: Numbers) -> list[str]:
    return [
        "# Results",
        "",
        "One command writes tables and figures, from a clean clone; the sections on real pictures and on the",
        "corpus have their own:",
        "",
        "    mocap models fetch blazepose",
        "    python -m benchmarks.results      # or: make results",
        "",
        *_words(
            f"It takes about {numbers['cpu_minutes']} minutes of processor time and runs the commands above "
            "each table, in quick versions: shorter walks and fewer trials than the studies and "
            "whole comparisons of planners. Processors round differently, and closed "
            "loops of planners amplify that: on another processor the figures of the arms changed, those of "
            "filmed ones by up to 8 %."
        ),
        *_words(
            "**Everything here is simulated**, except for the section on real pictures: body, flights, logs "
            "and pictures are made by `mocap simulate`. The detector that looks at the pictures of the "
            "sample flight and of filmed planners is the real one."
        ),
    ]


def _poses(numbers: Numbers) -> list[str]:
    rows = []
    for name, metrics in numbers["poses"].items():
        errors = [_fixed(metrics[key], 1) for key in POSES.measures[:3]]
        shares = [_fixed(100 * metrics[key], 1) for key in POSES.measures[3:]]
        rows.append([POSES.names[name], *errors, *shares])
    commands = [command for own in POSES.commands.values() for command in own]
    header = ["poses", "MPJPE mm", "root-relative mm", "PA mm", "PCK@150 mm %", "measured %"]
    return [
        "## The sample flight: what the poses cost",
        "",
        *_words(
            "`sample_data/mound_walk`: two drones, 12 s, BlazePose on the rendered pictures, method "
            "`robust` but for the row that says `mocap reconstruct`. The poses' errors are one draw of those "
            "that `sample_data/README.md` states."
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
            "2 deg. Whole studies walk 75 s with 10 trials."
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
    for scenario, compared in numbers["arms"].items():
        for arm, scores in compared["arms"].items():
            error = _estimate(scores["reconstruction_error"]["mpjpe_mm"])
            rows.append([scenario, arm, *arm_figures(scores, error)])
        verdicts.append(f"- **{scenario}**: {compared['verdict']}")
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


def _filming(numbers: Numbers) -> list[str]:
    rows = []
    for name, arms in numbers["filmed"].items():
        for arm, scores in arms.items():
            tilt = scores["tilt_deg"]
            shares = (tilt["within_5_share"], scores["in_view_share"], scores["detected_share"])
            rows.append(
                [
                    *(FILMED_NAMES[name], arm, _fixed(tilt["mean"], 1), _fixed(tilt["max"], 1)),
                    *(_fixed(100 * share, 0) for share in shares),
                    _fixed(100 * scores["keypoint_pck"], 1),
                    _fixed(scores["reprojection_px"]["mean"], 1),
                    *(_fixed(100 * scores[key], 1) for key in ("reconstructed_share", "pck150")),
                    *(_fixed(scores[key], 1) for key in ("mpjpe_mm", "root_mpjpe_mm")),
                ]
            )
    header = ["experiment", "arm", "tilt mean deg", "max", "within 5 deg %", "in view %", "detected %"]
    header += ["keypoints within a tenth %", "reprojection px", "measured %", "PCK@150 mm %", "MPJPE mm"]
    return [
        "## Planners filmed, with the real detector",
        "",
        *_words(
            "The paper's experiments with real drones, in simulation: flights are rendered as each arm's "
            "cameras would have seen them, BlazePose looks at the pictures, and `auto` reconstructs from "
            "poses with one draw of 0.02 m and 0.2 deg. In E2 somebody walks towards a mound that the fixed "
            "formation climbs; in E3 they jog a slalom with a dead stop, and play soccer. Clips of 5 s; "
            "The columns are those of `metrics.json`."
        ),
        *_code([command for own in FILMED.values() for command in own]),
        *markdown_table([*header, "root-relative mm"], rows),
        *_words(
            "Seen from 60 deg above, legs fold into the trunk: the detector places joints wrong or finds "
            "nobody, and the reconstruction breaks."
        ),
        *_picture(
            STILL, "Both cameras of adaptive (above) and fixed (below), when fixed measured the fewest joints"
        ),
    ]


def _gimbals(numbers: Numbers) -> list[str]:
    lines = [
        "## Real pictures that move: virtual gimbals",
        "",
        *_words(
            "A person filmed by four still cameras (Pose2Sim's demo, 1.7 s): crops of the videos pan, "
            "tilt, roll and shake along known paths. Pictures and detector are real, paths and errors of "
            "the logged attitudes are drawn: the same standard deviation per axis for a constant part and "
            "for one that is new in every picture. Positions are exact. `noise` says if flight.yaml gives "
            "the size of the errors. The tables have a command of their own, which needs the recording:"
        ),
        *_code(
            [
                "python -m benchmarks.gimbals FOLDER --methods robust auto --write           # tuned on",
                "python -m benchmarks.gimbals FOLDER --methods robust auto --write --kept    # kept aside",
            ]
        ),
        *_words(
            "Means over two paths and six draws of the errors. There is no truth of the person. Distance "
            "(median) is that from the result of `robust` from the still cameras, which errs too; the rows "
            "without attitude errors are the floor. NEES takes "
            "that result for exact, the second one adds its covariance. Jitter contains the person's own "
            "acceleration. The constant part of the attitudes is as good as the calibration; the part of it "
            "about the optical axis is shown by itself. The docstring of `benchmarks/gimbals.py` has more."
        ),
    ]
    for title, entries in numbers.get("gimbals", {}).items():
        lines += [f"{title}:", "", *gimbal_table(entries)]
    return lines


def _accuracy(numbers: Numbers) -> list[str]:
    if "accuracy" not in numbers:
        return []
    lines = [
        "## Methods on rendered flights",
        "",
        *_words(
            "Rendered pictures and real detectors. Flights with odd numbers, and the sample, were tuned "
            "on; even ones are kept aside. `benchmarks/corpus/README.md` describes each of them, the "
            "docstring of `benchmarks/accuracy.py` the figures. Times depend on the processor: "
            "these are of a slow one, beside other work."
        ),
    ]
    for detector, own in numbers["accuracy"].items():
        lines += [f"Detector `{detector}`:", "", *own, ""]
    return lines


def gimbal_table(entries: Sequence[Mapping[str, Any]]) -> list[str]:
    """Format the figures of `benchmarks.gimbals`."""
    columns = {
        "distance_mm": ("distance mm", 1),
        "jitter_mm": ("jitter mm", 1),
        "changing_deg": ("attitudes, changing deg", 3),
        "constant_deg": ("constant deg", 2),
        "constant_error_deg": ("standard error", 2),
        "roll_deg": ("about the optical axis", 2),
        "nees": ("NEES", 1),
        "nees_both": ("NEES, both", 1),
        "share_percent": ("measured %", 1),
        "cpu_s": ("CPU s", 1),
    }
    rows = [
        [
            f"{entry['level_deg']:g} deg" if entry["level_deg"] else "none",
            ("given" if entry["noise_given"] else "not given") if entry["level_deg"] else "",
            entry["method"],
            *(_fixed(entry[key], digits) for key, (_, digits) in columns.items()),
        ]
        for entry in entries
    ]
    header = ["attitude errors", "noise", "method", *(name for name, _ in columns.values())]
    return markdown_table(header, rows)


def _words(text: str) -> list[str]:
    return [*wrap(text, 118, break_long_words=False, break_on_hyphens=False), ""]


def _code(commands: Sequence[str]) -> list[str]:
    return [*(f"    {command}" for command in commands), ""]


def arm_figures(scores: Mapping[str, Any], error: str) -> list[str]:
    """Format the scores of replan/metrics.json for `ARM_COLUMNS`; `error` is inserted as given."""
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
    """Format a table, with an empty line after it."""
    lines = [header, ["---"] * len(header), *rows]
    return [*(f"| {' | '.join(line)} |" for line in lines), ""]


def _figure(name: str, words: str) -> list[str]:
    return _picture(f"{name}.svg", words)


def _picture(name: str, words: str) -> list[str]:
    return [f"![{words} (simulated)](figures/{name})", "", f"*{words}. Simulated.*", ""]


def _fixed(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _estimate(stated: Mapping[str, Any]) -> str:
    if stated["mean"] is None or stated["interval"] is None:
        return _fixed(stated["mean"], 1)
    low, high = stated["interval"]
    return f"{stated['mean']:.1f} [{low:.1f}, {high:.1f}]"
