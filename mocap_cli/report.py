"""`mocap report`: a page about a session, and one about several."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

import click

from mocap_cli.options import Shown, any_path, any_place, force_option, output_options, overwrite_option
from mocap_cli.several import end, expanded, tell
from mocap_cli.terminal import after_page, print_json, say, say_next, say_warnings, watching
from pipelines.session.errors import MocapError

if TYPE_CHECKING:
    from pipelines.reporting.pictures import Video


@click.command("report", short_help="Write a page about each session, and one that compares them.")
@click.argument("sessions", nargs=-1, required=True, type=any_place, metavar="SESSION...")
@click.option(
    "-o",
    "--output",
    type=any_path,
    help="Page that compares the sessions [default: comparison/index.html beside the first]; of one session,"
    " its page, and the session is only read.",
)
@click.option(
    "--study",
    "studies",
    type=any_path,
    multiple=True,
    metavar="FOLDER",
    help="Show a study of `mocap study` on each session's page, too; repeat it for several.",
)
@click.option(
    "--figures",
    type=any_path,
    metavar="FOLDER",
    help="Write the page's figures there as PNG, SVG and PDF, too, with their numbers as CSV; of several "
    "sessions, those of the page that compares them.",
)
@click.option(
    "--video",
    type=click.Choice(["none", "small", "full"]),
    default="small",
    show_default=True,
    help="Pictures of the videos beside the 3D view: none, at most 3 MB, or at most 10 MB.",
)
@force_option
@overwrite_option
@output_options
def report_command(
    sessions: tuple[Path, ...],
    output: Path | None,
    studies: tuple[Path, ...],
    figures: Path | None,
    video: Video,
    force: bool,
    overwrite: bool,
    shown: Shown,
) -> None:
    """Write one self-contained HTML page for each session: its quality, its certainty, its doubts.

    Two or more sessions are compared side by side as well, every one against the first: which skeleton is
    better, by how much, and if that is more than noise.
    """
    from pipelines.report import compare_sessions, report, write_figures_of
    from pipelines.session.urls import session_here

    ones = expanded(sessions)
    compared = drawn = None
    results = []
    failed: dict[str, str] = {}
    with ExitStack() as stack:
        ones = [stack.enter_context(session_here(session)) for session in ones]
        progress = stack.enter_context(watching(shown.level))
        progress.start("Writing pages", len(ones) + (len(ones) > 1) + (figures is not None))
        for session in ones:
            try:
                own = output if len(ones) == 1 else None
                results.append(
                    report(session, own, studies=studies, video=video, force=force, overwrite=overwrite)
                )
            except MocapError as error:
                if len(ones) == 1:
                    raise
                failed[str(session)] = tell(error)
            progress.advance()
        if len(ones) > 1 and not failed:  # else the first, with which all are compared, may be missing
            compared = compare_sessions(ones, output, overwrite=overwrite)
            progress.advance()
        if figures is not None and not failed:
            drawn = write_figures_of(ones, figures, studies=studies, overwrite=overwrite, force=force)
            progress.advance()
    for result in results:
        say_warnings(result.warnings, shown.quiet)
    if shown.as_json:
        print_json(
            {
                "pages": [str(result.place) for result in results],
                "comparison": None if compared is None else str(compared.place),
                "figures": None if drawn is None else str(drawn.place),
                "failed": failed,
            }
        )
        end(failed, ones)
        return
    for result in [*results, *(one for one in (compared, drawn) if one is not None)]:
        say(f"{'unchanged' if result.skipped else 'written'}: {result.place}")
    if len(ones) == 1:
        say_next(after_page(ones[0]), ones[0], shown.quiet)
    end(failed, ones)
