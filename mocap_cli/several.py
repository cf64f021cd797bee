"""Commands for one flight or session, applied to several in turn; a failure does not stop the others."""

import functools
import glob
from collections.abc import Callable, Collection, Iterable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import click

from mocap_cli.options import any_place, is_url
from mocap_cli.terminal import next_once, one_line, print_json, say
from pipelines.session.errors import DataError, MocapError

Command = Callable[..., dict[str, Any] | None]


def expanded(paths: Iterable[str | Path]) -> list[Path]:
    """Expand the patterns among paths that the shell did not expand; return each path once.

    DataError: nothing matches a pattern.
    """
    found: dict[Path, None] = {}
    for text in map(str, paths):
        if not glob.has_magic(text) or Path(text).exists():
            found[Path(text)] = None
            continue
        if is_url(text):
            from pipelines.session.storage import url_of
            from pipelines.session.urls import matching

            matches = matching(url_of(text) or text)
        else:
            matches = sorted(glob.glob(text, recursive=True))  # noqa: PTH207  # Path's knows no absolute one
        if not matches:
            raise DataError(text, "matches nothing", "check the pattern", code="no-such-file")
        found.update(dict.fromkeys(map(Path, matches)))
    return list(found)


def _here(stack: ExitStack, argument: str, suffix: str, options: dict[str, Any]) -> dict[str, Any]:
    """Return a command's options with places of object stores replaced by copies, until the stack ends."""
    place, output = options[argument], options.get("output")
    own: dict[str, Any] = {}
    if is_url(place):
        from pipelines.session.storage import url_of
        from pipelines.session.urls import fetched, holds_session, session_here

        url = url_of(place) or ""
        if options.get("scheduler"):
            problem = "is copied to this machine, where no worker of a cluster sees it"
            remedy = "leave --scheduler out, or copy the session to a folder that all machines see"
            raise DataError(url, problem, remedy, code="bad-option")
        if argument == "session" or (argument == "path" and holds_session(url)):
            own[argument] = stack.enter_context(session_here(place))
            if (
                suffix == ".export" and output is None
            ):  # beside the session is nowhere: into the working directory
                own["output"] = Path(place.name).with_suffix(suffix)
        else:
            own[argument] = fetched(url, fresh=True)
            output = output or (place.with_suffix(suffix) if argument == "flight" else None)
    if output is not None and is_url(output):
        if argument != "flight":
            problem = "is a URL, and must be a path here"
            raise DataError(output, problem, "write it here, and copy it there", code="url-refused")
        from pipelines.session.urls import session_here

        own["output"] = stack.enter_context(session_here(output, create=True))
    return options | own


def each(
    argument: str, metavar: str, suffix: str = "", *, titled: bool = True
) -> Callable[[Command], Callable[..., None]]:
    """Let a command for one flight or session take several, or patterns.

    The command returns the result for --json and must not print it itself.

    Args:
        argument: the name of the command's argument for one path.
        metavar: the name of the paths in the help text.
        suffix: of the folders that are made below --output for several.
        titled: for several, print each path before the command's output.
    """

    def decorated(command: Command) -> Callable[..., None]:
        def run_one(**options: Any) -> dict[str, Any] | None:
            with ExitStack() as stack:
                return command(**_here(stack, argument, suffix, options))

        @click.argument("paths", nargs=-1, required=True, type=any_place, metavar=f"{metavar}...")
        @functools.wraps(command)
        def run(*, paths: tuple[Path, ...], **options: Any) -> None:
            ones = expanded(paths)
            if len(ones) == 1:
                result = run_one(**{argument: ones[0]}, **options)
                if result is not None:
                    print_json(result)
                return
            own: list[dict[str, Any]] = [{argument: path} for path in ones]
            if "output" in options:
                for mine, output in zip(own, _outputs(ones, options["output"], suffix), strict=True):
                    mine["output"] = output
            show = titled and not (options.get("as_json") or options.get("quiet"))
            calls = [functools.partial(run_one, **options | mine) for mine in own]
            _run_all(calls, ones, as_json=bool(options.get("as_json")), titled=show)

        return run

    return decorated


def _outputs(paths: list[Path], folder: Path | None, suffix: str) -> list[Path | None]:
    """Return the --output of each path, below the --output for all."""
    if folder is None:
        return [None] * len(paths)
    if folder.is_file() or (folder / "session.json").exists():
        what = "a file" if folder.is_file() else "a session"
        problem = f"is {what}: several need a folder around them all"
        raise DataError(folder, problem, "give another --output, or none")
    from pipelines.session.stages import names_of

    return [folder / f"{name}{suffix}" for name in names_of(paths)]


def _run_all(
    calls: Sequence[Callable[[], dict[str, Any] | None]], paths: list[Path], *, as_json: bool, titled: bool
) -> None:
    results: dict[str, Any] = {}
    failed: dict[str, str] = {}
    with next_once():
        for path, call in zip(paths, calls, strict=True):
            if titled:
                say(f"{one_line(str(path))}:")
            try:
                results[str(path)] = call()
            except MocapError as error:
                failed[str(path)] = tell(error)
    if as_json:
        print_json({"results": results, "failed": failed})
    end(failed, paths)


def tell(error: MocapError) -> str:
    """Print the error of one that failed, and return the line; the others still run."""
    line = one_line(str(error))
    say(f"mocap: {line}", err=True)
    return line


def end(failed: Collection[str], paths: Collection[Path]) -> None:
    """Print the number of failures and exit with status 1, if any failed."""
    if failed:
        say(f"mocap: {len(failed)} of {len(paths)} failed", err=True)
        click.get_current_context().exit(1)
