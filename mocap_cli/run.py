"""`mocap run`: from the folder of a flight to its report and verdict."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from mocap_cli.options import Shown, any_path, cores_option, output_options
from mocap_cli.reconstruct import print_verdict
from mocap_cli.terminal import one_line, print_json, say, say_warnings, watching
from pipelines.session.errors import DataError

if TYPE_CHECKING:
    from pipelines.drafting.matching import Answer, Question

# More questions are not answered with care, and the report lists every assumption.
MAX_QUESTIONS = 3


@click.command("run", short_help="Go from a folder to the verdict in one command.")
@click.argument("folder", type=any_path, metavar="FOLDER|FLIGHT.yaml")
@click.option("--yes", is_flag=True, help="Take the likely answer to every question.")
@cores_option
@output_options
def run_command(folder: Path, yes: bool, workers: int, shown: Shown) -> None:
    """Draft the flight.yaml of a folder, then ingest, reconstruct, replan and report the flight.

    A flight.yaml that is there is taken as it is. What no file tells is asked in a terminal, at most three
    questions with the likely answer first. Elsewhere --yes takes the likely answer. Planners are compared
    where the flight has a map and an actor. The same command again continues: what is finished is skipped.
    A draft is made again when files were added or something is missing in it, unless you edited it.
    """
    from pipelines.run import drafted, run

    asks = not (yes or shown.as_json or shown.quiet) and sys.stdin.isatty() and sys.stderr.isatty()
    questions = _Questions(asks, takes=yes)
    with watching(-1 if asks else shown.level) as progress:
        manifest, assumed = drafted(folder, ask=questions.choose, progress=progress)
    unasked = [each for each in assumed if not any(f": {key}: " in each for key in questions.answered)]
    for remark in unasked[: questions.left]:
        questions.confirm(manifest, remark)
    with watching(shown.level) as progress:
        result = run(manifest, workers=workers, progress=progress)
    verdict: dict[str, Any] = result.reconstructed.metrics["verdict"]
    if shown.as_json:
        print_json(
            {
                "flight": str(manifest),
                "session": str(result.session),
                "assumed": result.assumed,
                "verdict": verdict,
                "page": str(result.page),
            }
        )
        return
    say_warnings(result.warnings, shown.quiet)
    say(f"page: {result.page}")
    print_verdict(verdict, result.session, manifest)


class _Questions:
    """Questions to somebody at a terminal; after the last one the likely answers are taken, as with --yes."""

    def __init__(self, asks: bool, *, takes: bool) -> None:
        self.left = MAX_QUESTIONS if asks else 0
        self.answered: set[str] = set()  # keys that somebody chose
        self._takes = takes or asks

    def choose(self, question: Question) -> Answer | None:
        """Let somebody choose an option; None leaves it open."""
        from pipelines.drafting.matching import Answer

        if not self.left:
            return Answer(0, stated=False) if self._takes else None
        self.left -= 1
        say(f"{question.key} of {', '.join(question.cameras)}: no file tells it. It may be", err=True)
        for number, option in enumerate(question.options, 1):
            say(f"  {number}: {one_line(option)}", err=True)
        numbers = click.IntRange(0, len(question.options))
        chosen = click.prompt("Which (0: none of these)?", default=1, type=numbers, err=True)
        self.answered.add(question.key)
        return Answer(chosen - 1, stated=True) if chosen else None

    def confirm(self, manifest: Path, remark: str) -> None:
        """Ask if an assumption is right.

        Raises:
            DataError: it is not; the manifest says what can be written instead.
        """
        if not click.confirm(f"assumed: {one_line(remark)}. Is that right?", default=True, err=True):
            problem = f"assumes what is not right: {one_line(remark)}"
            remedy = "correct the line, take `assumed: true` away, and run the same command again"
            raise DataError(manifest, problem, remedy, code="incomplete")
