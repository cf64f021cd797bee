"""The errors that a user can cause or correct. Each is one line: which file, what is wrong, what to do.

The command line prints the line and exits 1. Any other exception that escapes is a bug of this program.
"""

from pathlib import Path

CODES = {
    "ambiguous": "several formats, topics or cameras fit what was named",
    "axes-unknown": "the axes of the data are neither stated nor known",
    "bad-option": "an option of the command does not fit the others, or cannot be used",
    "bad-value": "a number or text is outside of what is allowed",
    "busy": "another process is writing the session",
    "changed": "a file is not what was written or ingested",
    "clock-unknown": "nothing says when something was recorded",
    "damaged": "a file is cut off, or its content contradicts itself",
    "data": "any other input that cannot be used",
    "disk-full": "there is no space left to write",
    "doubted": "the flight.yaml cannot be right, and --strict was given",
    "empty": "a file holds nothing",
    "exists": "something would be overwritten",
    "incomplete": "a drafted flight.yaml lacks what only the user knows, or assumes what is not right",
    "keypoints-normalised": "keypoints are shares of the picture, and not pixels",
    "limits-broken": "every planned flight breaks limits of safety",
    "losses": "data were lost, and --strict was given",
    "missing-column": "a table lacks a column or a header",
    "missing-library": "a library that is not installed is needed",
    "missing-model": "a model file is not there yet",
    "newer-schema": "a later version of mocap wrote the file",
    "no-actor": "nothing says where the actor was",
    "no-attitude": "nothing says how a camera was turned",
    "no-body": "nobody has a body with a surface to export",
    "no-intrinsics": "nothing says how a camera projects",
    "no-keypoints": "there are no keypoints",
    "no-overlap": "two recordings share no time",
    "no-permission": "a file may not be read or written",
    "no-pictures": "there are no pictures",
    "no-poses": "there are no poses",
    "no-positions": "a log holds no positions",
    "no-scheduler": "no Dask scheduler answers",
    "no-such-file": "a file or folder is not there",
    "no-such-name": "nothing has the name that was given",
    "no-such-topic": "a log has no such topic",
    "no-views": "at no time do the cameras have pictures, people and a pose",
    "nobody-found": "the detector found no person",
    "not-a-folder": "a file lies where a folder belongs, or a folder where a file does",
    "not-a-session": "a folder is no session, or no whole one",
    "nothing-reconstructed": "no joint could be reconstructed",
    "out-of-memory": "the memory does not suffice",
    "outside-folder": "a relative path leads out of its folder",
    "place-unknown": "a place on Earth is not known, or cannot be brought into the world",
    "special-file": "a pipe, a socket, a device, or a large sparse file that is all but empty",
    "stated-twice": "one thing is stated more than once",
    "store-refused": "an object store refuses the credentials",
    "store-unreachable": "an object store does not answer",
    "too-large": "a file is larger than can be meant",
    "unit-unknown": "the unit of the data is neither stated nor known",
    "unknown-key": "a key of a YAML file is not known",
    "unreadable": "the operating system cannot read or write a file",
    "unsupported": "a known kind of file or of content that mocap does not read",
    "url-refused": "a URL that is not fetched",
    "url-with-secret": "a URL with credentials in it",
    "worker-lost": "a process or a machine of a cluster ended",
    "wrong-kind": "a file is of another kind than belongs there",
    "wrong-model": "a model file is not the expected one",
    "wrong-option": "an option stands beside a file that does not take it",
    "wrong-size": "pictures, calibrations or keypoints differ in size",
    "wrong-worker": "a machine of a cluster has another version of mocap, session or model",
}
"""Every code of a DataError, and what it stands for. Codes stay when a message's words change."""


class MocapError(Exception):
    """Root of every error that is reported as one line; `code` is its kind, one of `CODES`."""

    code: str = "data"


class DataError(MocapError):
    """Input that cannot be used: what is wrong with which file or setting, and what the user can do."""

    def __init__(
        self, source: Path | str, problem: str, remedy: str = "", *, code: str | None = None
    ) -> None:
        self.source = source
        self.problem = problem
        self.remedy = remedy
        if code is not None:
            self.code = code
        super().__init__(f"{source}: {problem}" + (f"; {remedy}" if remedy else ""))

    def __reduce__(self) -> tuple[object, ...]:
        """Pickle it by its arguments, because it travels between processes."""
        return type(self), (self.source, self.problem, self.remedy), {"code": self.code}


class NoViewsError(DataError):
    """At no time do the cameras have pictures, people and a pose."""

    code = "no-views"


class BusyError(MocapError):
    """Another process is writing the session."""

    code = "busy"
