"""Keypoints of OpenPose, AlphaPose, COCO, MMPose, EasyMocap, Ultralytics, DeepLabCut, SLEAP and caliscope.

Each format is a line of a table: how its content is recognised, and how its people are gathered.
"""

import csv
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from pipelines.formats.keypoint_files.keypoint_people import (
    Gathering,
    KeypointFile,
    changing_digits,
    first_entry,
    is_alphapose_entry,
    json_files,
    load_json,
    numbers,
    objects,
    triples,
    whole_number,
)
from pipelines.geometry.arrays import Float
from pipelines.session.errors import DataError
from pipelines.session.people import SKELETONS, points_of_caliscope
from pipelines.session.storage import damaged, read_text

# --- OpenPose, and AlphaPose's formats `open` and `cmu` with a file for each picture -----------------------

# The list of people of a picture and the keypoints of each, in AlphaPose's formats `open` and `cmu`.
_BY_PICTURE = {"people": "pose_keypoints_2d", "bodies": "joints"}


def _is_frame(content: object) -> bool:
    return isinstance(content, dict) and any(isinstance(content.get(key), list) for key in _BY_PICTURE)


def _gather_openpose(people: Gathering) -> None:
    if people.path.is_dir():
        people.digits = changing_digits([_stem(file) for file in json_files(people.path)])
    for file, content in people.contents():
        if not isinstance(content, dict) or not _is_frame(content):
            people.dropped["file without a list of people"] += 1
        elif (frame := people.frame_of_file(file, _stem(file))) is not None:
            key = next(key for key in _BY_PICTURE if key in content)
            for rank, (where, person) in enumerate(objects(content[key], file, key)):
                # The second name is that of versions until 2018.
                if stated := person.get(_BY_PICTURE[key]) or person.get("pose_keypoints"):
                    track = person.get("person_id")
                    people.add(frame, triples(stated, where), where, rank=rank, own_id=_track(track))
    if people.count() == len(SKELETONS["body25"].joints):
        people.joint_names = SKELETONS[_order_of_25(people.keypoints())].joints


def _stem(file: Path) -> str:
    return file.stem.removesuffix("_keypoints")


def _track(stated: object) -> int | None:
    """Return a tracker's number, alone or in lists; None without one."""
    while isinstance(stated, list) and stated:
        stated = stated[0]
    number = whole_number(stated)
    return number if number is not None and number >= 0 else None


def _order_of_25(keypoints: Float) -> str:
    """Distinguish BODY_25 from BODY_25B, which has the same number of keypoints in another order."""
    xy = np.where(keypoints[..., 2:] > 0, keypoints[..., :2], np.nan)
    joints = SKELETONS["body25"].joints
    hip, left, right = (xy[:, joints.index(joint)] for joint in ("hip", "left_hip", "right_hip"))
    tested = np.isfinite(hip + left + right).all(axis=1)
    if not tested.any():
        return "body25"
    extent = np.nanmax(xy[tested], axis=1) - np.nanmin(xy[tested], axis=1)
    distance = np.linalg.norm(hip - (left + right) / 2, axis=1)[tested]
    midpoint = np.median(distance) <= 0.05 * np.median(extent.max(axis=1))
    return "body25" if midpoint else "body25b"


# --- AlphaPose, old and new, also in its formats `cmu` and `open` --------------------------------------


def _is_alphapose(content: object) -> bool:
    return is_alphapose_entry(first_entry(content)) or (
        isinstance(content, dict)
        and bool(content)
        and all(isinstance(shown, dict) and _BY_PICTURE.keys() & shown.keys() for shown in content.values())
    )


def _gather_alphapose(people: Gathering) -> None:
    content = load_json(people.path)
    if isinstance(content, dict):
        people.digits = changing_digits(content)
        for picture, shown in content.items():
            frame = people.frame_of(picture, str(people.path))
            key = next(key for key in _BY_PICTURE if key in shown)
            for where, person in objects(shown[key], f"{people.path}, {picture}", key):
                people.add(frame, triples(person.get(_BY_PICTURE[key]), where), where)
        return
    if isinstance(content, list):
        named = {entry.get("image_id") for entry in content if isinstance(entry, dict)}
        people.digits = changing_digits([name for name in named if isinstance(name, str)])
    for where, entry in objects(content, people.path, "results"):
        frame = people.frame_of(entry.get("image_id"), where)
        people.add(frame, triples(entry.get("keypoints"), where), where, own_id=_track(entry.get("idx")))


# --- COCO: results and annotations ---------------------------------------------------------------------


def _is_coco(content: object) -> bool:
    """Return True for a COCO file, even with boxes only or an empty list; reading reports the fault."""
    if isinstance(content, dict):
        return {"images", "annotations"} <= content.keys()
    entry = first_entry(content)
    return content == [] or (
        {"image_id", "category_id"} <= entry.keys()
        and ("keypoints" in entry or "bbox" in entry)
        and not is_alphapose_entry(entry)
    )


def _gather_coco(people: Gathering) -> None:
    content = load_json(people.path)
    boxes = _add_annotations(content, people) if isinstance(content, dict) else _add_results(content, people)
    if boxes and not len(people):
        problem = f"holds boxes only, no keypoints, in all of its {boxes} entries"
        raise DataError(people.path, problem, "run a keypoint detector", code="no-keypoints")
    people.dropped["entry without keypoints"] += boxes


def _add_results(content: object, people: Gathering) -> int:
    """Add the people of a list of results; return the number of entries without keypoints."""
    boxes = 0
    for where, entry in objects(content, people.path, "results"):
        frame = people.frame_of(entry.get("image_id"), where)
        if entry.get("keypoints"):
            people.add(frame, triples(entry["keypoints"], where), where)
        else:
            boxes += 1
    return boxes


def _add_annotations(content: dict[str, object], people: Gathering) -> int:
    """Add the people of an annotation file; return the number of annotations without keypoints."""
    frames: dict[str, int] = {}
    sizes = set()
    for where, image in objects(content.get("images"), people.path, "images"):
        frames[str(image.get("id"))] = people.frame_of(image.get("file_name", image.get("id")), where)
        sizes.add((whole_number(image.get("width")), whole_number(image.get("height"))))
    boxes = 0
    for where, annotation in objects(content.get("annotations"), people.path, "annotations"):
        if not annotation.get("keypoints"):
            boxes += 1
            continue
        image_id = str(annotation.get("image_id"))
        if image_id not in frames:
            problem = f"its image_id {image_id} is not among the images"
            raise DataError(where, problem, "check the images list")
        rows = triples(annotation["keypoints"], where)
        if not np.isin(rows[:, 2], (0, 1, 2)).all():
            problem = "its third values are not the visibilities 0, 1 and 2"
            raise DataError(where, problem, "store it as COCO results", code="bad-value")
        track = whole_number(annotation.get("track_id"))
        people.add(frames[image_id], rows * [1, 1, 0.5], where, own_id=track)
    names = first_entry(content.get("categories")).get("keypoints")
    if isinstance(names, list):
        people.joint_names = tuple(str(name).strip().lower().replace(" ", "_") for name in names)
    if len(sizes) == 1:
        people.image_size = _size(*sizes.pop())
    return boxes


def _size(width: object, height: object) -> tuple[int, int] | None:
    sides = whole_number(width), whole_number(height)
    return (sides[0], sides[1]) if sides[0] and sides[1] else None


# --- MMPose: a file of predictions, or a folder with one file for every picture ------------------------


def _is_mmpose(sample: object) -> bool:
    if isinstance(sample, dict):
        return "instance_info" in sample
    keys = first_entry(sample).keys()
    return {"frame_id", "instances"} <= keys or {"keypoints", "keypoint_scores"} <= keys


def _gather_mmpose(people: Gathering) -> None:
    """Add every person, file by file; the last joint names that a file states count."""
    for file, content in people.contents():
        predictions = content
        if isinstance(content, dict):
            meta = content.get("meta_info")
            by_id = meta.get("keypoint_id2name") if isinstance(meta, dict) else None
            if isinstance(by_id, dict):
                people.joint_names = tuple(str(by_id.get(str(index))) for index in range(len(by_id)))
            predictions = content.get("instance_info")
        if not isinstance(predictions, list):
            people.dropped["file without predictions"] += 1
        elif "instances" in first_entry(predictions):
            for where, entry in objects(predictions, file, "frames"):
                frame = people.frame_of(entry.get("frame_id"), where, file)
                _add_instances(frame, entry.get("instances"), where, people)
        elif (frame_of_file := people.frame_of_file(file)) is not None:
            _add_instances(frame_of_file, predictions, str(file), people)


def _add_instances(frame: int, instances: object, where: str, people: Gathering) -> None:
    for rank, (who, person) in enumerate(objects(instances, where, "instances")):
        points = numbers(person.get("keypoints"), who)
        scores = numbers(person.get("keypoint_scores"), who)
        if points.ndim != 2 or points.shape[1] != 2 or scores.shape != points.shape[:1]:
            shapes = f"{list(points.shape)} and {list(scores.shape)}"
            problem = f"keypoints and keypoint_scores are of shape {shapes}, not [K, 2] and [K]"
            raise DataError(who, problem, "save 2D predictions", code="bad-value")
        people.add(frame, np.column_stack([points, scores]), who, rank=rank)


# --- EasyMocap: annots/CAMERA/000000.json --------------------------------------------------------------


def _is_easymocap(sample: object) -> bool:
    return isinstance(sample, dict) and isinstance(sample.get("annots"), list) and "filename" in sample


def _gather_easymocap(people: Gathering) -> None:
    for file, content in people.contents():
        if not isinstance(content, dict) or not _is_easymocap(content):
            people.dropped["file without annotations"] += 1
        elif (frame := people.frame_of_file(file)) is not None:
            people.image_size = _size(content.get("width"), content.get("height"))
            for rank, (where, person) in enumerate(objects(content["annots"], file, "annots")):
                rows = numbers(person.get("keypoints"), where)
                if rows.ndim != 2 or rows.shape[1] != 3:
                    problem = f"keypoints are of shape {list(rows.shape)}, not [K, 3]"
                    raise DataError(where, problem, "extract 2D keypoints", code="bad-value")
                people.add(frame, rows, where, rank=rank, own_id=_track(person.get("personID")))


# --- Ultralytics: results as JSON, one file a picture, or a list of pictures ---------------------------


def _is_ultralytics(sample: object) -> bool:
    content = sample[0] if isinstance(sample, list) and sample and isinstance(sample[0], list) else sample
    entry = first_entry(content)
    return "box" in entry and isinstance(entry.get("keypoints"), dict)


def _gather_ultralytics(people: Gathering) -> None:
    """Add every person; a list of lists holds the pictures from frame 0 on."""
    for file, content in people.contents():
        if isinstance(content, list) and content and all(isinstance(each, list) for each in content):
            for number, picture in enumerate(content):
                _add_results_of_yolo(people, people.frame_of(number, str(file)), picture, file)
        elif (frame := people.frame_of_file(file)) is not None:
            _add_results_of_yolo(people, frame, content, file)


def _add_results_of_yolo(people: Gathering, frame: int, picture: object, file: Path) -> None:
    """Add people with keypoints {x: [...], y: [...], visible: [...]}."""
    for rank, (where, person) in enumerate(objects(picture, file, "results")):
        stated = person.get("keypoints")
        points: dict[str, object] = stated if isinstance(stated, dict) else {}
        columns = [numbers(points.get(axis), where) for axis in "xy"]
        columns.append(numbers(points.get("visible", [1.0] * columns[0].size), where))
        if columns[0].ndim != 1 or len({column.shape for column in columns}) > 1:
            problem = "keypoints are not equally many numbers x, y, visible"
            raise DataError(where, problem, "save results of a pose model", code="bad-value")
        track = _track(person.get("track_id"))
        people.add(frame, np.stack(columns, axis=1), where, rank=rank, own_id=track)


# --- tables of keypoints with names of the user's own --------------------------------------------------

Points = dict[str, dict[str, int]]
"""The columns x, y and, if there is one, score of every keypoint of a person."""
Rows = Iterator[tuple[list[str], list[tuple[list[str], Float]]]]


def _people_in(people: Gathering, rows: list[list[str]], first: int, everybody: Sequence[Points]) -> Rows:
    """Yield each row with the keypoints [K, 3] of everybody in it; a last row that breaks off is counted."""
    everybody = [{name: at for name, at in points.items() if {"x", "y"} <= at.keys()} for points in everybody]
    if not all(everybody) or not everybody:
        raise DataError(people.path, "has no columns x and y", "export it again", code="missing-column")
    last = max((k for k, row in enumerate(rows) if any(row)), default=0)
    for k, row in enumerate(rows[first:], start=first):
        if not any(row):
            continue
        try:
            if len(row) != len(rows[0]):
                raise ValueError(f"{len(row)} cells instead of {len(rows[0])}")
            cells = [float(cell or "nan") if cell[:1] in "-.0123456789" else np.nan for cell in row]
        except ValueError as error:
            if k < last:
                raise damaged(people.path, f"line {k + 1}: {error}") from error
            people.dropped["truncated last line"] += 1
            return
        yield row, [
            (
                [*points],
                np.array(
                    [[cells[at["x"]], cells[at["y"]], cells[at["score"]] if "score" in at else 1.0]
                     for at in points.values()]
                ),
            )
            for points in everybody
        ]  # fmt: skip


# --- DeepLabCut: a table below lines scorer, individuals, bodyparts, coords ----------------------------

_DLC_LINES = ("scorer", "individuals", "bodyparts", "coords")


def _is_deeplabcut(head: object) -> bool:
    labels = [line.partition(",")[0].strip() for line in str(head).split("\n", 4)[:4]]
    return labels[0] == "scorer" and {"bodyparts", "coords"} <= set(labels)


def _gather_deeplabcut(people: Gathering) -> None:
    rows = list(csv.reader(read_text(people.path).split("\n")))
    head = {row[0].strip(): [cell.strip() for cell in row] for row in rows[:4] if row}
    kinds = head.get("coords", [])
    first = next((k for k, kind in enumerate(kinds) if kind in {"x", "y"}), 0)
    parts, owners = head.get("bodyparts", []), head.get("individuals", [""] * len(kinds))
    if not first or not len(rows[0]) == len(kinds) == len(parts) == len(owners):
        problem = "has no lines bodyparts and coords of equal length"
        raise DataError(people.path, problem, "export it again", code="missing-column")
    everybody: dict[str, Points] = {}
    for k in range(first, len(kinds)):
        kind = "score" if kinds[k] == "likelihood" else kinds[k]
        everybody.setdefault(owners[k], {}).setdefault(parts[k], {})[kind] = k
    below = sum(label in _DLC_LINES for label in head)
    for row, found in _people_in(people, rows, below, list(everybody.values())):
        frame = people.frame_of(row[first - 1].strip(), str(people.path))
        for rank, (names, points) in enumerate(found):
            if np.isfinite(points[:, :2]).any():
                people.add_named(frame, names, points, str(people.path), rank=rank, own_id=rank)


# --- SLEAP: analysis as CSV, a row for each person in a frame ------------------------------------------


def _is_sleap(head: object) -> bool:
    cells = str(head).partition("\n")[0].strip().split(",")
    return "frame_idx" in cells and any(cell.endswith(".x") for cell in cells)


def _gather_sleap(people: Gathering) -> None:
    """Add every row: track, frame_idx, instance.score, then x, y and score of each node."""
    rows = list(csv.reader(read_text(people.path).split("\n")))
    points: Points = {}
    for k, cell in enumerate(rows[0]):
        node, _, kind = cell.strip().rpartition(".")
        if node != "instance" and kind in {"x", "y", "score"}:
            points.setdefault(node, {})[kind] = k
    head = {cell.strip(): k for k, cell in enumerate(rows[0])}
    if "frame_idx" not in head:
        raise DataError(people.path, "has no column frame_idx", "export it again", code="missing-column")
    tracks: dict[str, int] = {}
    for row, [(names, found)] in _people_in(people, rows, 1, [points]):
        track = row[head["track"]].strip() if "track" in head else ""
        frame = people.frame_of(row[head["frame_idx"]].strip(), str(people.path))
        own_id = tracks.setdefault(track, len(tracks)) if track else None
        people.add_named(frame, names, found, str(people.path), own_id=own_id)


# --- caliscope: a row for each point in a picture ------------------------------------------------------

_CALISCOPE = {"sync_index", "frame_index", "point_id", "img_loc_x", "img_loc_y"}


def _is_caliscope(head: object) -> bool:
    return {*str(head).partition("\n")[0].strip().split(",")} >= _CALISCOPE


def _gather_caliscope(people: Gathering) -> None:
    """Add the person of each picture by `frame_index`; `port`, later `cam_id`, must be one camera."""
    path, names = people.path, points_of_caliscope(people.path)
    people.joint_names = tuple(dict.fromkeys(names.values()))
    text = read_text(path)
    if not _is_caliscope(text):
        raise DataError(path, "has no columns of caliscope", "export it again", code="missing-column")
    rows = [row for row in csv.DictReader(text.splitlines()) if any(row.values())]
    cameras = sorted({str(row.get("cam_id", row.get("port"))) for row in rows})
    if len(cameras) > 1:
        problem = f"holds keypoints of {len(cameras)} cameras ({', '.join(cameras)[:60]})"
        raise DataError(path, problem, "write the rows of each camera to a file of its own", code="ambiguous")
    pictures: dict[int, dict[str, list[float]]] = {}
    for row in rows:
        try:
            xy = [float(row[f"img_loc_{axis}"] or "nan") for axis in "xy"]
        except (TypeError, ValueError) as error:
            raise damaged(path, f"has a row that is no point: {str(row)[:60]}") from error
        if name := names.get(str(row["point_id"]).removesuffix(".0")):
            frame = people.frame_of(str(row["frame_index"]).removesuffix(".0"), str(path))
            pictures.setdefault(frame, {})[name] = [*xy, 1.0]
    for frame, found in pictures.items():
        people.add_named(frame, [*found], np.array([*found.values()]), str(path))


OPENPOSE = KeypointFile("openpose", "OpenPose keypoints", _is_frame, _gather_openpose)
ALPHAPOSE = KeypointFile(
    "alphapose", "AlphaPose keypoints", _is_alphapose, _gather_alphapose, of_folders=False
)
COCO = KeypointFile("coco", "COCO keypoints", _is_coco, _gather_coco, of_folders=False)
MMPOSE = KeypointFile("mmpose", "MMPose keypoints", _is_mmpose, _gather_mmpose)
EASYMOCAP = KeypointFile("easymocap_keypoints", "EasyMocap keypoints", _is_easymocap, _gather_easymocap)
ULTRALYTICS = KeypointFile("ultralytics", "Ultralytics keypoints", _is_ultralytics, _gather_ultralytics)
DEEPLABCUT = KeypointFile("deeplabcut", "DeepLabCut keypoints", _is_deeplabcut, _gather_deeplabcut, (".csv",))
SLEAP = KeypointFile("sleap", "SLEAP keypoints", _is_sleap, _gather_sleap, (".csv",))
CALISCOPE = KeypointFile(
    "caliscope_keypoints", "caliscope keypoints", _is_caliscope, _gather_caliscope, (".csv",)
)
