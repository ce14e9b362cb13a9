"""Reader of truncated bags, as of a full disk or an interrupted transfer, from the beginning up to the damage.

rosbags needs the index at the end of a bag; here only its message definitions are used. Formats:
https://mcap.dev/spec, https://wiki.ros.org/Bags/Format/2.0 and, for .db3, https://sqlite.org/fileformat.html.
"""

import bz2
import re
import sqlite3
import struct
import sys
from collections.abc import Callable, Iterator, Sequence
from io import BufferedReader, BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import lz4.frame
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from imagination.recordings.recording import BrokenRecordingError
from imagination.recordings.trajectory import Stamp

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

MAX_RECORD = 2**30
"""Largest record and largest decompressed chunk, bytes; larger sizes are damage."""

DECOMPRESSORS: dict[str, Callable[[], Any]] = {
    "bz2": bz2.BZ2Decompressor,
    "lz4": lz4.frame.LZ4FrameDecompressor,
    "zstd": zstd.ZstdDecompressor,
}
"""Decompressors by the compression name in a chunk's header."""


class Connection(NamedTuple):
    """Topic and message type; the message `definition` only in ROS 1 bags."""

    topic: str
    msgtype: str
    definition: str = ""


File = BufferedReader | BytesIO
Messages = Iterator[tuple[Connection, Stamp, bytes]]


class CutBag:
    """Reader of a truncated bag with the part of the rosbags reader's interface that `BagRecording` uses.

    Args:
        path: path of a file, or of a folder whose files are read in order.

    Attributes:
        connections: topics of the readable messages.
        start_time: time of the first readable message.

    Raises:
        Exception: of any type, if no message is readable.
    """

    def __init__(self, path: Path) -> None:
        files = sorted(path.glob("*"), key=_in_order) if path.is_dir() else [path]
        self.parts = [(FORMATS[file.suffix], file) for file in files if file.suffix in FORMATS]
        self.ros1 = path.suffix == ".bag"
        self.store = get_typestore(Stores.ROS1_NOETIC if self.ros1 else Stores.ROS2_HUMBLE)
        connections: dict[Connection, Stamp] = {}
        try:
            for connection, time, _ in self._all_messages():
                connections.setdefault(connection, time)
        except Exception:  # raised again when the messages are read
            if not connections:
                raise
        self.connections, self.start_time = list(connections), min(connections.values())
        for connection in self.connections:
            if connection.definition:
                self.store.register(get_types_from_msg(connection.definition, connection.msgtype))

    def messages(self, connections: Sequence[Connection]) -> Messages:
        """Iterate over the messages of some topics in the order in which they were written.

        Raises:
            Exception: of any type, where the bag is truncated.
        """
        return (message for message in self._all_messages() if message[0] in connections)

    def deserialize(self, data: bytes, kind: str) -> Any:
        """Decode a message."""
        return (
            self.store.deserialize_ros1(data, kind) if self.ros1 else self.store.deserialize_cdr(data, kind)
        )

    def _all_messages(self) -> Messages:
        for read, file in self.parts:
            yield from read(file)


def _in_order(file: Path) -> list[tuple[bool, int, str]]:
    """Return the sort key of a split bag's files, whose names end in numbers: _2 before _10."""
    parts = re.split(r"([0-9]+)", file.name)
    return [(part.isdigit(), int(part) if part.isdigit() else 0, part) for part in parts]


def read_mcap(path: Path) -> Messages:
    """Iterate over the messages of an MCAP file."""
    names: dict[int, str] = {}
    channels: dict[int, Connection] = {}
    with open(path, "rb") as file:
        file.seek(8)  # skip the magic bytes
        for kind, body in mcap_records(file):
            if kind == 3:  # schema: number, name
                number, size = struct.unpack_from("<HI", body)
                names[number] = body[6 : 6 + size].decode()
            elif kind == 4:  # channel: number, schema's number, topic
                number, schema, size = struct.unpack_from("<HHI", body)
                channels[number] = Connection(body[8 : 8 + size].decode(), names[schema])
            elif kind == 5:  # message: channel's number, count, two times
                number, _, time, _ = struct.unpack_from("<HIQQ", body)
                yield channels[number], time, body[22:]
            elif kind == 15:  # the end of the data
                return
        raise cut_off(path, file)


def mcap_records(file: File, inside: bool = False) -> Iterator[tuple[int, bytes]]:
    """Iterate over (kind, content) of the complete records, including those in chunks (which cannot be nested)."""
    while len(head := file.read(9)) == 9:
        kind, length = struct.unpack("<BQ", head)
        body = file.read(min(length, MAX_RECORD))
        if kind == 6 and not inside:  # chunk: two times, size, checksum, compression, size
            stated, _, size = struct.unpack_from("<QII", body, 16)
            content = decompress(body[32 : 32 + size].decode(), body[40 + size :], stated)
            yield from mcap_records(BytesIO(content), True)
        elif len(body) == length:
            yield kind, body
        if len(body) < length:
            file.seek(-len(body) - len(head), 1)
            return


def read_ros1(path: Path) -> Messages:
    """Iterate over the messages of a ROS 1 bag."""
    connections: dict[bytes, Connection] = {}
    with open(path, "rb") as file:
        file.readline()  # the version
        for inside, header, data in ros1_records(file):
            kind = header[b"op"][0]
            if kind == 7 and inside:  # a connection
                values = fields(data)
                connections[header[b"conn"]] = Connection(
                    header[b"topic"].decode(),
                    values[b"type"].decode().replace("/", "/msg/"),
                    values[b"message_definition"].decode(),
                )
            elif kind == 7:  # the index at the end
                return
            elif kind == 2:  # a message
                seconds, nanoseconds = struct.unpack("<II", header[b"time"])
                yield connections[header[b"conn"]], seconds * 10**9 + nanoseconds, data
        raise cut_off(path, file)


def ros1_records(file: File, inside: bool = False) -> Iterator[tuple[bool, dict[bytes, bytes], bytes]]:
    """Iterate over (inside a chunk, header, data) of the complete records."""
    while len(start := file.read(4)) == 4:
        at = file.tell() - 4
        header = file.read(min(int.from_bytes(start, "little"), MAX_RECORD))
        length = int.from_bytes(file.read(4), "little")
        data = file.read(min(length, MAX_RECORD))
        values = fields(header) if length else {}
        if values.get(b"op") == b"\5" and not inside:  # a chunk
            stated = int.from_bytes(values[b"size"], "little")
            content = decompress(values[b"compression"].decode(), data, stated)
            yield from ros1_records(BytesIO(content), True)
        elif len(data) == length:
            yield inside, values, data
        if len(data) < length:
            file.seek(at)
            return


def fields(data: bytes) -> dict[bytes, bytes]:
    """Parse the names and values of a ROS 1 header."""
    values, at = {}, 0
    while at < len(data):
        (size,) = struct.unpack_from("<I", data, at)
        name, _, value = data[at + 4 : at + 4 + size].partition(b"=")
        values[name] = value
        at += 4 + size
    return values


def read_sqlite(path: Path) -> Messages:
    """Iterate over the messages of a .db3 file; SQLite reads rows until it needs a missing page."""
    database = sqlite3.connect(f"{path.absolute().as_uri()}?immutable=1", uri=True)
    try:
        database.execute("PRAGMA writable_schema = ON")  # otherwise SQLite refuses a file with missing pages
        topic_rows = database.execute("SELECT id, name, type FROM topics")
        topics = {number: Connection(topic, kind) for number, topic, kind in topic_rows}
        rows = database.execute("SELECT topic_id, timestamp, data FROM messages NOT INDEXED ORDER BY id")
        # delayed by one row: missing bytes of the last row before the damage may be read as zeros
        previous: list[tuple[Connection, Stamp, bytes]] = []
        for number, time, data in rows:
            yield from previous
            previous = [(topics[number], time, data)]
        yield from previous
    except (sqlite3.DatabaseError, KeyError) as error:
        size = path.stat().st_size
        raise BrokenRecordingError(
            f"{path.name} is cut off: its {size} bytes are incomplete ({error})"
        ) from error
    finally:
        database.close()


FORMATS: dict[str, Callable[[Path], Messages]] = {
    ".mcap": read_mcap,
    ".db3": read_sqlite,
    ".bag": read_ros1,
}
"""Readers by file suffix."""


def decompress(compression: str, data: bytes, stated: int) -> bytes:
    """Decompress a chunk, which may be truncated.

    Args:
        compression: none, bz2, lz4 or zstd.
        data: compressed bytes.
        stated: decompressed size in the chunk's header, bytes.

    Raises:
        BrokenRecordingError: if the decompressed size is larger than stated.
    """
    if compression in ("", "none"):
        return data
    max_size = min(stated, MAX_RECORD)
    content: bytes = DECOMPRESSORS[compression]().decompress(data, max_length=max_size + 1)
    if len(content) > max_size:
        raise BrokenRecordingError(
            f"{len(data)} bytes of a chunk decompress to more than the stated {stated} bytes (at most {MAX_RECORD})"
        )
    return content


def cut_off(path: Path, file: BufferedReader) -> BrokenRecordingError:
    """Return the error of a truncated file."""
    return BrokenRecordingError(
        f"{path.name} is cut off: of its {path.stat().st_size} bytes, the records before byte {file.tell()} are whole"
    )
