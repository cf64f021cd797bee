"""`--render` of `mocap replan-compare`: film every arm and run a real detector on the pictures."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from mocap_cli.options import FiniteRange, any_path
from mocap_cli.terminal import print_table, say

if TYPE_CHECKING:
    from pipelines.session.progress import Progress

Command = TypeVar("Command", bound=Callable[..., Any])


@dataclass(frozen=True)
class Rendering:
    """The values of the render options."""

    rate_hz: float
    start_s: float | None
    end_s: float | None
    detector: str
    scenario: Path | None


def render_options(command: Command) -> Command:
    """Add --render and its options; the command takes `rendering: Rendering | None`."""

    @click.option(
        "--render",
        is_flag=True,
        help="Film every arm of a simulated flight and run the detector on the pictures:"
        " SESSION/film/ARM/CAMERA.mp4.",
    )
    @click.option(
        "--render-hz", type=FiniteRange(0.1, 30), default=5.0, show_default=True, help="Pictures a second."
    )
    @click.option("--render-start", type=FiniteRange(0, 1e6), metavar="S", help="Film from then on only.")
    @click.option("--render-end", type=FiniteRange(0, 1e6), metavar="S", help="And before then only.")
    @click.option("--detector", default="blazepose", show_default=True, help="See `mocap models`.")
    @click.option(
        "--scenario",
        type=any_path,
        metavar="SCENARIO.yaml",
        help="Of the simulated flight [default: scenario.yaml beside the flight].",
    )
    @functools.wraps(command)
    def with_rendering(
        *arguments: Any,
        render: bool,
        render_hz: float,
        render_start: float | None,
        render_end: float | None,
        detector: str,
        scenario: Path | None,
        **options: Any,
    ) -> Any:
        asked = Rendering(render_hz, render_start, render_end, detector, scenario)
        return command(*arguments, rendering=asked if render else None, **options)

    return with_rendering  # type: ignore[return-value]


def film_arms(session: Path, asked: Rendering, *, force: bool, progress: Progress) -> dict[str, Any]:
    """Film the session's arms and return their figures."""
    from pipelines.film import Settings, film

    settings = Settings(asked.rate_hz, asked.start_s, asked.end_s, asked.detector)
    return film(session, settings, scenario=asked.scenario, force=force, progress=progress).metrics


def print_filmed(metrics: dict[str, Any]) -> None:
    """Print a table with one row for each arm."""
    say()
    say(f"filmed (simulated) at {metrics['rate_hz']:g} Hz, keypoints by {metrics['detector']}:")
    header = [
        "arm",
        "pictures",
        "tilt deg",
        "max",
        "within 5 deg %",
        "in view %",
        "detected %",
        "PCK %",
        "keypoint px",
    ]
    header += ["reprojection px", "measured %", "MPJPE mm", "in common mm", "PCK150 %"]
    rows: list[list[object]] = [
        [
            name,
            arm["pictures"],
            arm["tilt_deg"]["mean"],
            arm["tilt_deg"]["max"],
            100 * arm["tilt_deg"]["within_5_share"],
            100 * arm["in_view_share"],
            100 * arm["detected_share"],
            _percent(arm["keypoint_pck"]),
            arm["keypoint_median_px"],
            None if arm["reprojection_px"] is None else arm["reprojection_px"]["mean"],
            _percent(arm["reconstructed_share"]),
            arm["mpjpe_mm"],
            arm["common_mpjpe_mm"],
            _percent(arm["pck150"]),
        ]
        for name, arm in metrics["arms"].items()
    ]
    print_table(header, rows)


def _percent(share: float | None) -> float | None:
    return None if share is None else 100 * share
