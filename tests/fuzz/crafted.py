"""Crafted inputs: small files that ask for much time or memory, or state absurd numbers, in classes.

Each class is a generator of inputs. An input is written into an empty folder, and one entry of it is read.
"""

import bz2
import json
import sqlite3
import struct
import zipfile
import zlib
from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import lz4.frame
import numpy as np
from backports import zstd

from tests.formats.calibrations import test_anipose_toml
from tests.synthetic import drone_logs, videos
from tests.synthetic.flights import write_flight

MB = 1 << 20
Writer = Callable[[Path], object]


@dataclass(frozen=True)
class Crafted:
    """One input."""

    kind: str
    what: str
    stated: str  # the format that a user names
    write: Writer  # into an empty folder
    entry: str  # the path in that folder to read


Content = Writer | bytes | str
_Input = tuple[str, Content] | tuple[str, str, str, Content]
"""Crafted file: its name and content, after format and entry where they differ from the class."""
_Make = Callable[[], Iterable[_Input]]

KINDS: dict[str, tuple[str, str, _Make]] = {}
"""Classes by name: the format that a user names, the entry to read, and a generator of inputs."""


def _kind(name: str, stated: str, entry: str) -> Callable[[_Make], _Make]:
    def register(make: _Make) -> _Make:
        KINDS[name] = stated, entry, make
        return make

    return register


def crafted(kinds: Collection[str] | None = None) -> Iterator[Crafted]:
    """Yield all inputs, class by class; nothing is written yet, and large contents are made one at a time."""
    for kind in kinds or KINDS:
        usual_format, usual_entry, make = KINDS[kind]
        for given in make():
            what, stated, entry, content = (
                given if len(given) == 4 else (given[0], usual_format, usual_entry, given[1])
            )
            write = content if callable(content) else _writer(entry, content)
            yield Crafted(kind, what, stated, write, entry)


def _writer(entry: str, content: bytes | str) -> Writer:
    data = content.encode("utf-8", "surrogateescape") if isinstance(content, str) else content
    return lambda folder: (folder / entry).write_bytes(data)


_MCAP = b"\x89MCAP0\r\n"


def _op(kind: int, content: bytes) -> bytes:
    return struct.pack("<BQ", kind, len(content)) + content


def _text(value: str) -> bytes:
    return struct.pack("<I", len(value.encode())) + value.encode()


def _schema(number: int, name: str, definition: bytes, encoding: str = "ros2msg") -> bytes:
    head = struct.pack("<H", number) + _text(name) + _text(encoding)
    return _op(3, head + struct.pack("<I", len(definition)) + definition)


def _channel(number: int, schema: int, topic: str, encoding: str = "cdr") -> bytes:
    return _op(4, struct.pack("<HH", number, schema) + _text(topic) + _text(encoding) + bytes(4))


def _message(channel: int, stamp: int, data: bytes = b"\0\1\0\0\1\0\0\0\0") -> bytes:
    return _op(5, struct.pack("<HIQQ", channel, 0, stamp, stamp) + data)


def _chunk(content: bytes, compression: str = "", size: int | None = None) -> bytes:
    stated = 0 if size is None else size
    head = struct.pack("<QQQI", 0, 0, stated, 0) + _text(compression)
    return _op(6, head + struct.pack("<Q", len(content)) + content)


def _index(channel: int, rows: Iterable[tuple[int, int]]) -> bytes:
    content = b"".join(struct.pack("<QQ", *row) for row in rows)
    return _op(7, struct.pack("<HI", channel, len(content)) + content)


def _mcap(*records: bytes, closed: bool = True) -> bytes:
    end = _op(15, bytes(4)) + _op(2, bytes(20)) + _MCAP if closed else b""
    return _MCAP + _op(1, _text("ros2") + _text("test")) + b"".join(records) + end


_STRING = _schema(1, "std_msgs/msg/String", b"string data")


@_kind("MCAP: many channels", "mcap", "a.mcap")
def _mcap_channels() -> Iterator[_Input]:
    topics = b"".join(_channel(k, 1, f"/topic{k}") for k in range(60_000))
    inside = _STRING + topics + b"".join(_message(k, k) for k in range(60_000))
    yield "60,000 topics with a message each", _mcap(inside)
    yield "60,000 topics in a chunk", _mcap(_chunk(inside, size=len(inside)))


@_kind("MCAP: inflated chunks", "mcap", "a.mcap")
def _mcap_bombs() -> Iterator[_Input]:
    for name, press in (("zstd", zstd.compress), ("lz4", lz4.frame.compress)):
        large = press(bytes(1000 * MB))
        yield f"{name}, 1,000 MB of zeros", _mcap(_chunk(large, name, 1000 * MB))
        yield f"{name}, states 2^63", _mcap(_chunk(large, name, 2**63))
        some = press(bytes(60 * MB))
        yield f"{name}, 400 times 60 MB", _mcap(*[_chunk(some, name, 60 * MB)] * 400)


@_kind("MCAP: chunks and indices", "mcap", "a.mcap")
def _mcap_indices() -> Iterator[_Input]:
    head = _STRING + _channel(1, 1, "/a")
    body = head + _message(1, 1)
    rows = [(1, len(head))] * 1_000_000
    yield "300,000 empty chunks", _mcap(*[_chunk(b"")] * 300_000)
    yield ("1,000,000 rows for one message", _mcap(_chunk(body, size=len(body)), _index(1, rows)))
    yield "a record of 2^63 bytes", _mcap(head, struct.pack("<BQ", 5, 2**63), closed=False)


@_kind("messages: definitions", "mcap", "a.mcap")
def _definitions() -> Iterator[_Input]:
    def log(definition: str, data: bytes = bytes(64)) -> bytes:
        return _mcap(
            _schema(1, "a/msg/A", definition.encode()),
            _channel(1, 1, "/a"),
            _message(1, 1, b"\0\1\0\0" + data),
        )

    rule = "\n" + "=" * 80 + "\nMSG: a/"
    deep = "B0 x" + "".join(f"{rule}B{k}\nB{k + 1} x" for k in range(2000)) + f"{rule}B2000\nfloat64 x"
    yield "2,000 types deep", log(deep)
    wide = "B0[10] x" + "".join(f"{rule}B{k}\nB{k + 1}[10] x" for k in range(12)) + f"{rule}B12\nfloat64 x"
    yield "arrays of arrays, 10^13 numbers", log(wide)
    yield "a type within itself", log("A x")
    yield "a sequence of 2^32 - 1", log("float64[] x", b"\xff\xff\xff\xff" + bytes(8))


@_kind("messages: JSON and protobuf", "mcap", "a.mcap")
def _other_messages() -> Iterator[_Input]:
    def log(data: bytes, encoding: str = "json", schema: bytes = b"{}", name: str = "a.A") -> bytes:
        kind = {"json": "jsonschema", "protobuf": "protobuf"}[encoding]
        return _mcap(_schema(1, name, schema, kind), _channel(1, 1, "/a", encoding), _message(1, 1, data))

    yield "JSON nested 100,000 deep", log(b"[" * 100_000)
    yield "JSON with an integer of 100,000 digits", log(b'{"a": ' + b"9" * 100_000 + b"}")
    schema = b'{"a":' * 50_000 + b"{}" + b"}" * 50_000
    yield "a JSON schema 50,000 deep", log(b"{}", schema=schema)
    deep = b""
    for _ in range(5000):
        deep = b"\x1a" + _varint(len(deep)) + deep
    yield ("protobuf types nested deep", log(b"", "protobuf", b"\x0a" + _varint(len(deep)) + deep))


def _varint(value: int) -> bytes:
    found = bytearray()
    while value > 127:
        found.append(value & 127 | 128)
        value >>= 7
    return bytes([*found, value])


def _bag_record(fields: dict[str, bytes], data: bytes = b"") -> bytes:
    parts = [name.encode() + b"=" + value for name, value in fields.items()]
    header = b"".join(struct.pack("<I", len(part)) + part for part in parts)
    return struct.pack("<I", len(header)) + header + struct.pack("<I", len(data)) + data


def _bag(*records: bytes, chunks: int = 0) -> bytes:
    head = {"op": b"\3", "index_pos": struct.pack("<Q", 13), "conn_count": bytes(4)}
    return (
        b"#ROSBAG V2.0\n" + _bag_record(head | {"chunk_count": struct.pack("<I", chunks)}) + b"".join(records)
    )


def _bag_chunk(content: bytes, compression: str = "none", size: int | None = None) -> bytes:
    stated = len(content) if size is None else size
    fields = {"op": b"\5", "compression": compression.encode(), "size": struct.pack("<I", stated)}
    return _bag_record(fields, content)


def _bag_topic(number: int, topic: str, definition: bytes = b"string data") -> bytes:
    about = {
        "topic": topic.encode(),
        "type": b"std_msgs/String",
        "md5sum": b"*",
        "message_definition": definition,
    }
    data = _bag_record(about)[4:-4]
    fields = {"op": b"\7", "conn": struct.pack("<I", number), "topic": topic.encode()}
    return _bag_record(fields, data)


def _bag_message(number: int, data: bytes = bytes(4)) -> bytes:
    return _bag_record({"op": b"\2", "conn": struct.pack("<I", number), "time": bytes(8)}, data)


def _bag_index(number: int, rows: bytes) -> bytes:
    fields = {"op": b"\4", "ver": b"\1\0\0\0", "conn": struct.pack("<I", number)}
    return _bag_record(fields | {"count": struct.pack("<I", len(rows) // 12)}, rows)


@_kind("ROS 1: inflated chunks", "ros1", "a.bag")
def _bag_bombs() -> Iterator[_Input]:
    large = bz2.compress(bytes(1000 * MB))
    yield "bz2, 1,000 MB of zeros", _bag(_bag_chunk(large, "bz2", 1000 * MB))
    frames = lz4.frame.compress(bytes(1000)) * 100_000
    yield "lz4, 100,000 frames", _bag(_bag_chunk(frames, "lz4", 100_000_000))


@_kind("ROS 1: records", "ros1", "a.bag")
def _bag_records() -> Iterator[_Input]:
    yield "300,000 empty chunks", _bag(_bag_chunk(b"") * 300_000, chunks=300_000)
    bad = _bag_chunk(b"\0", "bz2", 5) * 300_000
    yield "300,000 damaged chunks", _bag(bad, chunks=300_000)
    small = bz2.compress(_bag_topic(0, "/a") + _bag_message(0))
    both = _bag_chunk(small, "bz2", len(_bag_topic(0, "/a") + _bag_message(0)))
    yield "50,000 chunks of a message", _bag(both * 50_000, chunks=50_000)
    content = _bag_topic(0, "/a") + _bag_message(0)
    place = struct.pack("<III", 0, 0, len(_bag_topic(0, "/a")))
    rows = _bag_index(0, place * 1_000_000)
    yield "1,000,000 rows for one message", _bag(_bag_chunk(content), rows, chunks=1)


@_kind("ROS 2: databases", "ros2", "a.db3")
def _databases() -> Iterator[_Input]:
    topics = (
        "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT,"
        " offered_qos_profiles TEXT)"
    )
    named = "INSERT INTO topics VALUES (1, '/a', 'std_msgs/msg/String', 'cdr', '')"

    def database(*statements: str) -> Writer:
        def write(folder: Path) -> None:
            made = sqlite3.connect(folder / "a.db3")
            with made:
                for statement in statements:
                    made.execute(statement)
            made.close()

        return write

    endless = (
        "CREATE VIEW messages AS WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n)"
        " SELECT i AS id, 1 AS topic_id, i AS timestamp, x'00' AS data FROM n"
    )
    yield "a view without end", database(topics, named, endless)
    zeros = "SELECT 1 AS id, 1 AS topic_id, 1 AS timestamp, zeroblob(999000000) AS data"
    yield "a view of 1 GB", database(topics, named, f"CREATE VIEW messages AS {zeros}")


@_kind("ROS 2: folders", "ros2", "bag")
def _bag_folders() -> Iterator[_Input]:
    def bag(metadata: str, **files: bytes) -> Writer:
        def write(folder: Path) -> None:
            place = folder / "bag"
            place.mkdir()
            (place / "metadata.yaml").write_text(metadata, encoding="utf-8")
            for name, content in files.items():
                (place / name.replace("__", ".")).write_bytes(content)

        return write

    log = _mcap(_STRING, _channel(1, 1, "/a"), _message(1, 1))
    yield "metadata of aliases", bag(_laughs(), a__mcap=log)
    bomb = zstd.compress(bytes(4000 * MB))
    stated = "rosbag2_bagfile_information:\n  message_count: 1\n  relative_file_paths: [a.db3.zstd]\n"
    yield "a zstd file of 4 GB", bag(stated, a__db3__zstd=bomb)


def _laughs(levels: int = 9, each: int = 9) -> str:
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * each)}]" for k in range(1, levels + 1)]
    return "\n".join(lines) + "\n"


_LENS = (
    "  camera_model: pinhole\n  distortion_model: none\n  distortion_coeffs: []\n"
    "  intrinsics: [500, 500, 320, 240]\n  resolution: [640, 480]\n"
)


@_kind("YAML: calibrations", "kalibr", "chain.yaml")
def _yaml_calibrations() -> Iterator[_Input]:
    chain = "".join(f"cam{k}:\n{_LENS}" for k in range(10_000))
    yield "10,000 cameras", chain
    aliases = f"cam0: &c\n{_LENS}" + "".join(f"cam{k}: *c\n" for k in range(1, 50_000))
    yield "50,000 cameras by aliases", aliases
    head = f"cam0:\n{_LENS}"
    yield "aliases of aliases", head + _laughs()
    keys = ["m0: &m0 {a: 1}"] + [
        f"m{k}: &m{k} {{<<: [{', '.join([f'*m{k - 1}'] * 9)}]}}" for k in range(1, 9)
    ]
    yield "merges of merges", head + "\n".join(keys)
    yield "nested 100,000 deep", head + "a: " + "[" * 100_000


@_kind("TOML, INI: calibrations", "anipose", "calib.toml")
def _toml() -> Iterator[_Input]:
    def cameras(count: int) -> str:
        return "".join(test_anipose_toml.CAMERA.replace("one", f"cam_{k}") for k in range(count))

    yield "10,000 cameras", cameras(10_000)
    yield "nested 100,000 deep", cameras(1) + "a = " + "[" * 100_000
    keys = "".join(f"k{k}\n1\n" for k in range(200_000))
    yield "an INI of 200,000 keys", "camera_info", "left.ini", "[image]\n" + keys


@_kind("keypoints: frame numbers", "coco", "a.json")
def _frame_numbers() -> Iterator[_Input]:
    def person(image: object) -> dict[str, object]:
        return {"image_id": image, "category_id": 1, "keypoints": [100.0, 100.0, 0.9] * 17, "score": 2.0}

    def flight(people: list[dict[str, object]]) -> Writer:
        def write(folder: Path) -> None:
            write_flight(folder, cameras=2, seconds=0.2)
            (folder / "drone1.json").write_text(json.dumps(people), encoding="utf-8")

        return write

    for number in (5_000_000, 2**62 - 1):
        both = [person("0.jpg"), person(f"{number}.jpg")]
        yield f"frames 0 and {number:,}", "", "flight.yaml", flight(both)
    yield "frame 1e300", json.dumps([person(1e300)])


@_kind("keypoints: JSON", "alphapose", "a.json")
def _keypoint_json() -> Iterator[_Input]:
    person = {"image_id": "0.jpg", "category_id": 1, "keypoints": [100.0, 100.0, 0.9] * 17, "score": 2.0}
    text = json.dumps(person)
    yield "30,000 people in a frame", "[" + ",".join([text] * 30_000) + "]"
    yield "nested 1,000,000 deep", "[" * 1_000_000
    yield "a key of 20 MB", "coco", "a.json", f'[{{"{"x" * 20 * MB}": 1}}]'
    yield "2,000,000 empty lists", "mmpose", "a.json", '{"instance_info": [' + "[]," * 2_000_000 + "[]]}"

    def folder(place: Path) -> None:
        (place / "drone").mkdir()
        for k in range(10_000):
            path = place / "drone" / f"a_{k:012d}_keypoints.json"
            path.write_text('{"version": 1.3, "people": []}', encoding="utf-8")

    yield "10,000 files without people", "openpose", "drone", folder


@_kind("text tables", "joints_csv", "joints.csv")
def _tables() -> Iterator[_Input]:
    row = "1700000000.0 0 0 0 0 0 0 1\n"
    for name, entry, good in (
        ("tum", "a.tum", row),
        ("csv", "poses.csv", "t_ns,x,y,z,qw,qx,qy,qz\n1,0,0,0,1,0,0,0\n"),
    ):
        separator = "," if name == "csv" else " "
        yield f"{name}: a line of 30 MB", name, entry, good + (f"1{separator}") * (15 * MB)
    yield "csv: 200,000 columns", "csv", "poses.csv", ",".join(f"c{k}" for k in range(200_000)) + "\n"
    joints = "t_ns,person,joint,x,y,z\n"
    many = "".join(f"{k},0,joint{k},0,0,0\n" for k in range(20_000))
    yield "joints: 20,000 joints at 20,000 times", joints + many
    yield "frame times: frame 10^15", "frame_times", "f.csv", f"frame,t_ns\n0,1\n{10**15},2\n"


@_kind("skeletons: BVH", "bvh", "a.bvh")
def _bvh() -> Iterator[_Input]:
    def motion(head: str, channels: int, frames: int = 1) -> str:
        return f"{head}MOTION\nFrames: {frames}\nFrame Time: 0.01\n" + ("0 " * channels + "\n") * frames

    root = "HIERARCHY\nROOT r\n{\nOFFSET 0 0 0\nCHANNELS 3 Xrotation Yrotation Zrotation\n"
    n = 50_000
    deep = "".join(f"JOINT j{k}\n{{\nOFFSET 0 1 0\n" for k in range(n)) + "}\n" * (n + 1)
    yield "nested 50,000 deep", motion(root + deep, 3)
    yield "10^9 frames stated", motion(root + "}\n", 3).replace("Frames: 1", "Frames: 1000000000")


@_kind("maps: point clouds", "pcd", "a.pcd")
def _clouds() -> Iterator[_Input]:
    pcd = (
        "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {n}\nHEIGHT 1\n"
        "VIEWPOINT 0 0 0 1 0 0 0\nPOINTS {n}\nDATA {data}\n"
    )
    yield "PCD: 10^12 points", pcd.format(n=10**12, data="binary").encode() + bytes(120)
    lzf = struct.pack("<II", 3 * 4_000_000, 264 * 4_000_000) + b"\xe0\xff\x00" * 4_000_000
    yield "PCD: LZF to 1 GB", pcd.format(n=88_000_000, data="binary_compressed").encode() + lzf
    far = "\n".join(["0 0 0", "1e308 0 0", "-1e308 1e308 1e38"])
    yield "PCD: points at 1e308", pcd.format(n=3, data="ascii") + far
    ply = "ply\nformat binary_little_endian 1.0\nelement vertex {n}\n"
    ply += "".join(f"property float {axis}\n" for axis in "xyz")
    many = ply.format(n=10**15) + "end_header\n"
    yield "PLY: 10^15 points", "ply", "a.ply", many
    lists = ply.format(n=1) + "property list uint uint a\nend_header\n"
    yield "PLY: a list of 2^32 - 1", "ply", "a.ply", lists.encode() + bytes(12) + b"\xff" * 4
    las = bytearray(227 + 40)
    las[:4] = b"LASF"
    las[24:26] = b"\1\2"
    struct.pack_into("<HII", las, 94, 227, 227, 2**32 - 1)
    struct.pack_into("<BHI", las, 104, 0, 20, 2**32 - 1)
    struct.pack_into("<dddddd", las, 131, 1e-3, 1e-3, 1e-3, 0, 0, 0)
    yield "LAS: 2^32 - 1 records and points", "las", "a.las", bytes(las)


@_kind("maps: grids", "ros_map", "map.yaml")
def _grids() -> Iterator[_Input]:
    def npz(shape: str, data: bytes = b"") -> bytes:
        file = BytesIO()
        header = f"{{'descr': '<f4', 'fortran_order': False, 'shape': {shape}, }}"
        header = header.ljust((len(header) + 10) // 64 * 64 + 53) + "\n"
        with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
            with archive.open("probability.npy", "w", force_zip64=True) as member:
                member.write(b"\x93NUMPY\1\0" + struct.pack("<H", len(header)) + header.encode())
                member.write(data)
            for name, value in (("origin", np.zeros(3)), ("resolution_m", np.array(0.2))):
                part = BytesIO()
                np.save(part, value)
                archive.writestr(f"{name}.npy", part.getvalue())
        return file.getvalue()

    yield "npz: 1,000 MB of zeros", "npz", "site.npz", npz("(250, 1000, 1000)", bytes(1000 * 10**6))
    yield "npz: 2^60 voxels stated", "npz", "site.npz", npz(f"({2**20}, {2**20}, {2**20})")
    yield "npz: a header nested deep", "npz", "site.npz", npz("(" * 3000 + ")" * 3000)

    def ros(about: str, name: str, picture: bytes) -> Writer:
        def write(folder: Path) -> None:
            (folder / "map.yaml").write_text(f"image: {name}\n{about}", encoding="utf-8")
            (folder / name).write_bytes(picture) if "/" not in name else None

        return write

    about = "resolution: 0.05\norigin: [0, 0, 0]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.2\n"
    yield "map.yaml: 2^31 pixels wide", ros(about, "a.pgm", b"P5\n2147483647 2147483647\n255\n\0")
    tiny = about.replace("0.05", "1e-300")
    yield "map.yaml: voxels of 1e-300 m", ros(tiny, "a.pgm", b"P5\n2 2\n255\n\0\0\0\0")
    yield "map.yaml: the picture is a device", ros(about, "/dev/zero", b"")


def _png(width: int, height: int) -> bytes:
    def part(kind: bytes, content: bytes) -> bytes:
        return (
            struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))
        )

    press = zlib.compressobj(9)
    row = bytes(width // 8 + 2)  # one bit for a pixel
    data = b"".join(press.compress(row) for _ in range(height)) + press.flush()
    head = struct.pack(">IIBBBBB", width, height, 1, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + part(b"IHDR", head) + part(b"IDAT", data) + part(b"IEND", b"")


@_kind("pictures", "pictures", "film")
def _pictures() -> Iterator[_Input]:
    def film(content: bytes, suffix: str = "png") -> Writer:
        def write(folder: Path) -> None:
            (folder / "film").mkdir()
            for k in range(3):
                (folder / "film" / f"{k:06d}.{suffix}").write_bytes(content)

        return write

    yield "PNG of 900,000,000 pixels", film(_png(30_000, 30_000))
    lied = bytearray(_png(16, 16))
    struct.pack_into(">II", lied, 16, 2**31 - 1, 2**31 - 1)
    struct.pack_into(">I", lied, 29, zlib.crc32(bytes(lied[12:29])))
    yield "PNG that states 2^31 - 1", film(bytes(lied))


@_kind("videos: boxes", "video", "a.mp4")
def _boxes() -> Iterator[_Input]:
    def changed(kind: bytes, offset: int, value: int) -> Writer:
        def write(folder: Path) -> None:
            path = videos.write_video(folder / "a.mp4", videos.even_ticks(15))
            content = bytearray(path.read_bytes())
            place = content.find(kind)
            while place >= 0:
                struct.pack_into(">I", content, place + 4 + offset, value)
                place = content.find(kind, place + 4)
            path.write_bytes(content)

        return write

    for scale in (0, 1, 2**31 - 1, 2**31, 2**32 - 1):
        yield f"mdhd: a time scale of {scale}", changed(b"mdhd", 12, scale)
    for kind, offset in ((b"stts", 4), (b"stsz", 8), (b"stsc", 4), (b"stco", 4), (b"ctts", 4), (b"elst", 4)):
        yield f"{kind.decode()}: 2^32 - 1 entries", changed(kind, offset, 2**32 - 1)
    yield "stts: a step of 2^32 - 1", changed(b"stts", 12, 2**32 - 1)
    yield "stts: 2^31 - 1 pictures", changed(b"stts", 8, 2**31 - 1)
    yield "tkhd: 2^31 wide", changed(b"tkhd", 76, 2**31 - 1)
    head = struct.pack(">I", 16) + b"ftypisom\0\0\0\0"
    nested = b""
    for _ in range(20_000):
        nested = struct.pack(">I", 8 + len(nested)) + b"moov" + nested if len(nested) < 60_000 else nested
    yield "boxes nested deep", head + nested
    yield "200,000 empty boxes", head + b"\0\0\0\x08free" * 200_000
    yield "a box of no length", head + bytes(4) + b"moov" + bytes(100)


@_kind("PX4 logs", "ulog", "a.ulg")
def _ulogs() -> Iterator[_Input]:
    head = b"ULog\x01\x12\x35\x01" + bytes(8)

    def log(*formats: str) -> bytes:
        return head + b"".join(drone_logs.ulog_record("F", text.encode()) for text in formats)

    yield "a chain of 5,000 types", log(*(f"t{k}:t{k + 1} a;" for k in range(5000)))
    topic = log("a:uint64_t timestamp;float x;")
    subscribed = b"".join(drone_logs.ulog_record("A", struct.pack("<BH", 0, k) + b"a") for k in range(60_000))
    yield "60,000 subscriptions", topic + subscribed
    rows = drone_logs.ulog_record("D", struct.pack("<HQf", 0, 1, 2.0)) * 1_000_000
    yield "1,000,000 equal rows", topic + drone_logs.ulog_record("A", bytes(3) + b"a") + rows


@_kind("other telemetry", "dji", "a.SRT")
def _telemetry() -> Iterator[_Input]:
    rows = [(128, 89, b"FMT", b"BBnNZ", b"Type,Length,Name,Format,Columns")]
    rows += [(k % 120 + 1, 3, b"A%03d" % (k % 1000), b"", b"") for k in range(200_000)]
    definitions = b"".join(b"\xa3\x95\x80" + struct.pack("<BB4s16s64s", *row) for row in rows)
    yield "ArduPilot: 200,000 definitions", "ardupilot", "a.bin", definitions
    packet = struct.pack(">Q", 1_700_000_000_000_000) + b"\xfe\x00\x00\x01\x01\x00\x00\x00"
    yield "MAVLink: 1,000,000 empty packets", "tlog", "a.tlog", packet * 1_000_000
    yield "MAVLink: 20 MB of marks", "tlog", "a.tlog", packet + b"\xfe" * (20 * MB)
    place = "[latitude: 1.0] [longitude: 2.0] [rel_alt: 1.0 abs_alt: 2.0]"
    cue = "{k}\n00:00:00,{a:03d} --> 00:00:00,{b:03d}\n" + place + "\n\n"
    cues = "".join(cue.format(k=k, a=k % 1000, b=k % 1000 + 1) for k in range(200_000))
    yield "SRT: 200,000 cues that go back", cues
    one = cue.format(k=1, a=0, b=33)
    yield "SRT: 1,000,000 brackets", one + "2\n00:00:01,000 --> 00:00:02,000\n" + "[" * 1_000_000
