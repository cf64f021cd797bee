"""Logs of JSON lines: {"t": seconds, "topic": "/pose", "p": [x, y, z], "q": [x, y, z, w]}."""

import json
from types import SimpleNamespace as Fields

from pipelines.session.errors import DataError
from pipelines.session.records import Message, Topic


class JsonLines:
    name, title, suffixes = "jsonl", "JSON lines log", (".jsonl",)

    def recognises(self, path):
        return path.suffix == ".jsonl" and path.is_file()

    def describe(self, path):
        with self.open_log([path]) as log:
            return {"topics": [{"topic": t.name, "type": t.type, "messages": t.count} for t in log.topics]}

    def open_log(self, paths):
        return _Open(paths)


class _Open:
    def __init__(self, paths):
        self.dropped = {}
        self._rows = []
        for path in paths:
            for number, line in enumerate(path.read_text().splitlines(), 1):
                try:
                    self._rows.append(json.loads(line))
                except ValueError:
                    raise DataError(path, f"line {number} is no JSON", "write one object per line") from None
        self.topics = [self._topic(name) for name in sorted({row["topic"] for row in self._rows})]

    def _topic(self, name):
        stamps = [round(row["t"] * 1e9) for row in self._rows if row["topic"] == name]
        return Topic(name, "geometry_msgs/msg/PoseStamped", "json", len(stamps), min(stamps), max(stamps))

    def messages(self, topics):
        known = {topic.name: topic for topic in self.topics}
        for row in self._rows:
            if row["topic"] in topics:
                seconds, nanoseconds = divmod(round(row["t"] * 1e9), 1_000_000_000)
                header = Fields(stamp=Fields(sec=seconds, nanosec=nanoseconds), frame_id="map")
                pose = Fields(
                    position=Fields(**dict(zip("xyz", row["p"], strict=True))),
                    orientation=Fields(**dict(zip("xyzw", row["q"], strict=True))),
                )
                stamp = seconds * 1_000_000_000 + nanoseconds
                yield Message(known[row["topic"]], stamp, Fields(header=header, pose=pose))

    def __enter__(self):
        return self

    def __exit__(self, *exception):
        pass


FORMAT = JsonLines()
