"""`mocap init`: the draft of a flight.yaml for the files of a flight."""

from collections import defaultdict
from collections.abc import Iterator, Mapping
from pathlib import Path

import click

from mocap_cli.options import Shown, any_path, output_options, overwrite_option
from mocap_cli.terminal import one_line, print_json, say, say_next, watching

# More files of one kind in one folder are counted instead of listed.
_MANY = 5


@click.command("init", short_help="Draft a flight.yaml from the files of a flight.")
@click.argument("paths", type=any_path, nargs=-1, required=True, metavar="PATHS...")
@click.option(
    "-o",
    "--output",
    type=click.Path(dir_okay=False, path_type=Path),
    help="Manifest to write [default: flight.yaml in the folder that all PATHS have in common].",
)
@overwrite_option
@output_options
def init_command(paths: tuple[Path, ...], output: Path | None, overwrite: bool, shown: Shown) -> None:
    """Look into logs, videos, keypoints, calibrations and maps, and draft the flight.yaml that names them.

    PATHS are files and folders; folders are searched. Names (drone1.mp4, drone1_poses.tum, /drone1/odometry,
    a camera of a calibration) and times decide what belongs to which camera. What no file states, such as a
    frame rate, a clock or a mount, is assumed and marked with `assumed: true`, or named as missing. Read the
    manifest before you ingest it. Without pictures or keypoints of any camera, the exit status is 1.
    """
    from pipelines.draft import draft
    from pipelines.ingest import OF_ONE_CAMERA
    from pipelines.session.storage import jsonable

    with watching(shown.level) as progress:
        result = draft(paths, output, overwrite=overwrite, progress=progress)
    if not shown.quiet:
        for line in _left_out(result.left_out):
            say(line, err=True)
        for word, remarks in (("missing", result.missing), ("assumed", result.assumed)):
            for remark in remarks:
                say(f"{word}: {one_line(remark)}", err=True)
    if shown.as_json:
        summary = {
            "flight": str(result.path),
            "cameras": result.cameras,
            "missing": result.missing,
            "assumed": result.assumed,
            "left_out": {str(path): reason for path, reason in result.left_out.items()},
        }
        print_json(jsonable(summary))
    else:
        if len(result.cameras) == 1 and not shown.quiet:
            say(OF_ONE_CAMERA, err=True)
        say(f"cameras: {', '.join(result.cameras) or 'none'}")
        say(f"written: {_from_here(result.path)}")
        if result.filmed:
            first = "write what is missing, then " if result.missing else ""
            say_next(f"{first}mocap check {{}}", _from_here(result.path), shown.quiet)
        else:
            say_next("add films or keypoints, then mocap init {}", paths[0], shown.quiet)
    if not result.filmed:
        raise SystemExit(1)


def _from_here(path: Path) -> Path:
    """Return the path relative to the working directory, if it is below it."""
    return path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path


def _left_out(left_out: Mapping[Path, str]) -> Iterator[str]:
    alike: dict[tuple[Path, str, str], list[Path]] = defaultdict(list)
    for path, reason in left_out.items():
        alike[path.parent, path.suffix, reason].append(path)
    for (folder, suffix, reason), group in alike.items():
        if len(group) > _MANY:
            yield one_line(f"{_from_here(folder) / f'*{suffix}'}: {len(group)} files {reason}")
        else:
            yield from (one_line(f"{_from_here(path)}: {reason}") for path in group)
