"""Maps of obstacles, from a file or from a log in which they replace each other, in the world."""

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace

from pipelines.formats.logs.maps import (
    MAP_TYPES,
    OCCUPANCY_GRID,
    LoggedMaps,
    Losses,
    MapTopic,
    frame_of,
    read_maps,
)
from pipelines.formats.logs.trajectories import frames_of_poses, place_of_frame
from pipelines.geometry.arrays import Int64
from pipelines.session.errors import DataError
from pipelines.session.manifest import Manifest, MapSource
from pipelines.session.records import Message, Occupancy
from pipelines.session.source_options import LoggedMap
from pipelines.sources.logs import FlightLogs
from pipelines.sources.world import in_enu, in_world, world_times

DEFAULT_HEIGHT_M = 2.5
"""Height of the cells of a floor plan: an ordinary storey."""


def maps_of_log(
    flight: Manifest,
    stated: MapSource,
    logs: FlightLogs,
    *,
    max_gap_ns: int,
    note: Callable[[str], None],
) -> LoggedMaps:
    """Read the maps of a topic, in ENU axes at world times.

    Raises:
        DataError: no such topic, several candidates, no readable map, or a map in a frame that the
            log does not connect with its world.
    """
    log, options = stated.file, LoggedMap.model_validate(stated.options)
    with logs.open(log) as opened:
        recording, source, settings = opened.recording, opened.source, opened.settings
        there = [known.name for known in recording.topics if known.type in MAP_TYPES]
        topic = opened.choose_among(there, "maps", stated.topic)
        type_ = opened.type_of(topic) or ""
        place = f"{source} {topic}"
        first = next(recording.messages([topic]), None)
        if first is None:
            raise Losses(place, recording.dropped).nothing_usable()
        if options.height_m is not None and type_ != OCCUPANCY_GRID:
            problem = f"{topic} holds {type_}, which has heights of its own"
            raise DataError(source, problem, "leave `height_m` out", code="wrong-option")
        frame = frame_of(first, place)
        log_from_frame = place_of_frame(
            recording,
            source,
            place,
            frame,
            parent=options.parent,
            poses_in=frames_of_poses(recording, source, _poses_taken(flight, logs, log)),
            stamps=settings.stamps,
            max_gap_ns=max_gap_ns,
            note=note,
        )
        started_ns = opened.started_ns
    lost: dict[str, int] = {}

    def read() -> Iterator[Message]:
        with logs.open(log) as opened:
            yield from opened.recording.messages([topic])
            lost.update(opened.recording.dropped)

    about = MapTopic(
        source=place,
        frame=frame,
        stamps=settings.stamps,
        world_from_frame=in_world(
            in_enu(log_from_frame, settings.axes or flight.world.frame), settings.world_from_source
        ),
        max_gap_ns=max_gap_ns,
        resolution_m=stated.resolution_m,
        height_m=DEFAULT_HEIGHT_M if options.height_m is None else options.height_m,
    )
    found = read_maps(read, type_, about)
    for line in found.notes:
        note(line)
    from_ns = world_times(settings.clock, found.from_ns, started_ns)
    return replace(
        found,
        maps=_at_times(found.maps, from_ns),
        from_ns=from_ns,
        dropped=dict(Counter(found.dropped) + Counter(lost)),
    )


def _poses_taken(flight: Manifest, logs: FlightLogs, log: str) -> list[tuple[str | None, str | None]]:
    """Return topic and parent of all poses that the flight takes from a log."""
    poses = [camera.pose for camera in flight.cameras.values()]
    taken = [(pose.file, pose.topic, pose.options.get("parent")) for pose in poses]
    taken += [(actor.file, actor.topic, None) for actor in flight.logged_people.values()]
    paths = logs.paths(log)
    return [(topic, parent) for name, topic, parent in taken if logs.paths(name) == paths]


def _at_times(maps: Iterator[Occupancy], from_ns: Int64) -> Iterator[Occupancy]:
    for occupancy, since_ns in zip(maps, from_ns.tolist(), strict=True):
        yield replace(occupancy, from_ns=since_ns)
