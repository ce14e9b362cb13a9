"""Reader of truncated bags, e.g. after a full disk or an interrupted transfer, from the beginning up to the damage.

The readers of rosbags need the index at the end of a bag, so only its message definitions are used here. Formats:
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
"""Maximum size of a record and of a decompressed chunk, bytes; a larger size is treated as damage."""

DECOMPRESSORS: dict[str, Callable[[], Any]] = {
    "bz2": bz2.BZ2Decompressor,
    "lz4": lz4.frame.LZ4FrameDecompressor,
    "zstd": zstd.ZstdDecompressor,
}
"""Decompressor classes by the name of the compression in a chunk's header."""


class Connection(NamedTuple):
    """Topic with its message type and, in ROS 1 bags, the message definition."""

    topic: str
    msgtype: str
    definition: str = ""


File = BufferedReader | BytesIO
Messages = Iterator[tuple[Connection, Stamp, bytes]]


class CutBag:
    """Reader of a truncated bag, with those methods of a rosbags reader that `BagRecording` calls.

    Args:
        path: path of a file, or of a folder whose files are read in order.

    Attributes:
        connections: topics with at least one readable message.
        start_time: time of the first readable message.

    Raises:
        Exception: of any type, if no message is readable.
    """

    def __init__(self, path: Path) -> None:
        files = sorted(path.glob("*"), key=_natural_key) if path.is_dir() else [path]
        self.parts = [(FORMATS[file.suffix], file) for file in files if file.suffix in FORMATS]
        self.ros1 = path.suffix == ".bag"
        self.store = get_typestore(Stores.ROS1_NOETIC if self.ros1 else Stores.ROS2_HUMBLE)
        connections: dict[Connection, Stamp] = {}
        try:
            for connection, time, _ in self._all_messages():
                connections.setdefault(connection, time)
        except Exception:  # `messages` raises it again
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
        """Decode a message of the type `kind`."""
        return (
            self.store.deserialize_ros1(data, kind) if self.ros1 else self.store.deserialize_cdr(data, kind)
        )

    def _all_messages(self) -> Messages:
        for read, file in self.parts:
            yield from read(file)


def _natural_key(file: Path) -> list[tuple[bool, int, str]]:
    """Return a sort key that compares numbers in file names by value, so that file _2 of a split bag precedes _10."""
    parts = re.split(r"([0-9]+)", file.name)
    return [(part.isdigit(), int(part) if part.isdigit() else 0, part) for part in parts]


def read_mcap(path: Path) -> Messages:
    """Iterate over the messages of an MCAP file."""
    schema_names: dict[int, str] = {}
    channels: dict[int, Connection] = {}
    with open(path, "rb") as file:
        file.seek(8)  # skip the magic bytes
        for opcode, body in mcap_records(file):
            if opcode == 3:  # Schema: id, name
                schema_id, size = struct.unpack_from("<HI", body)
                schema_names[schema_id] = body[6 : 6 + size].decode()
            elif opcode == 4:  # Channel: id, schema id, topic
                channel_id, schema_id, size = struct.unpack_from("<HHI", body)
                channels[channel_id] = Connection(body[8 : 8 + size].decode(), schema_names[schema_id])
            elif opcode == 5:  # Message: channel id, sequence number, log time, publish time
                channel_id, _, time, _ = struct.unpack_from("<HIQQ", body)
                yield channels[channel_id], time, body[22:]
            elif opcode == 15:  # Data End
                return
        raise cut_off(path, file)


def mcap_records(file: File, inside: bool = False) -> Iterator[tuple[int, bytes]]:
    """Iterate over (opcode, content) of the complete records, including those in chunks.

    Args:
        file: MCAP file after its magic bytes, or the content of a chunk.
        inside: whether `file` is the content of a chunk; chunks are not nested.
    """
    while len(header := file.read(9)) == 9:
        opcode, length = struct.unpack("<BQ", header)
        body = file.read(min(length, MAX_RECORD))
        if opcode == 6 and not inside:  # Chunk: start and end time, uncompressed size, CRC, compression, size
            uncompressed_size, _, size = struct.unpack_from("<QII", body, 16)
            content = decompress(body[32 : 32 + size].decode(), body[40 + size :], uncompressed_size)
            yield from mcap_records(BytesIO(content), True)
        elif len(body) == length:
            yield opcode, body
        if len(body) < length:
            file.seek(-len(body) - len(header), 1)
            return


def read_ros1(path: Path) -> Messages:
    """Iterate over the messages of a ROS 1 bag."""
    connections: dict[bytes, Connection] = {}
    with open(path, "rb") as file:
        file.readline()  # the version
        for inside, header, data in ros1_records(file):
            op = header[b"op"][0]
            if op == 7 and inside:  # connection
                values = fields(data)
                connections[header[b"conn"]] = Connection(
                    header[b"topic"].decode(),
                    values[b"type"].decode().replace("/", "/msg/"),
                    values[b"message_definition"].decode(),
                )
            elif op == 7:  # connections outside chunks belong to the index at the end
                return
            elif op == 2:  # message
                seconds, nanoseconds = struct.unpack("<II", header[b"time"])
                yield connections[header[b"conn"]], seconds * 10**9 + nanoseconds, data
        raise cut_off(path, file)


def ros1_records(file: File, inside: bool = False) -> Iterator[tuple[bool, dict[bytes, bytes], bytes]]:
    """Iterate over (`inside`, header, data) of the complete records, including those in chunks.

    Args:
        file: bag after its version line, or the content of a chunk.
        inside: whether `file` is the content of a chunk; chunks are not nested.
    """
    while len(header_size := file.read(4)) == 4:
        start = file.tell() - 4
        raw_header = file.read(min(int.from_bytes(header_size, "little"), MAX_RECORD))
        length = int.from_bytes(file.read(4), "little")
        data = file.read(min(length, MAX_RECORD))
        header = fields(raw_header) if length else {}
        if header.get(b"op") == b"\5" and not inside:  # chunk
            uncompressed_size = int.from_bytes(header[b"size"], "little")
            content = decompress(header[b"compression"].decode(), data, uncompressed_size)
            yield from ros1_records(BytesIO(content), True)
        elif len(data) == length:
            yield inside, header, data
        if len(data) < length:
            file.seek(start)
            return


def fields(data: bytes) -> dict[bytes, bytes]:
    """Parse the fields of a ROS 1 header: values by name."""
    values, offset = {}, 0
    while offset < len(data):
        (size,) = struct.unpack_from("<I", data, offset)
        name, _, value = data[offset + 4 : offset + 4 + size].partition(b"=")
        values[name] = value
        offset += 4 + size
    return values


def read_sqlite(path: Path) -> Messages:
    """Iterate over the messages of a .db3 file; SQLite reads rows until it needs a missing page."""
    database = sqlite3.connect(f"{path.absolute().as_uri()}?immutable=1", uri=True)
    try:
        database.execute("PRAGMA writable_schema = ON")  # otherwise SQLite refuses a file with missing pages
        topic_rows = database.execute("SELECT id, name, type FROM topics")
        topics = {topic_id: Connection(name, msgtype) for topic_id, name, msgtype in topic_rows}
        rows = database.execute("SELECT topic_id, timestamp, data FROM messages NOT INDEXED ORDER BY id")
        # a row is yielded after the next one was read: SQLite may read missing bytes of the last one as zeros
        previous: list[tuple[Connection, Stamp, bytes]] = []
        for topic_id, time, data in rows:
            yield from previous
            previous = [(topics[topic_id], time, data)]
        yield from previous
    except (sqlite3.DatabaseError, KeyError) as error:
        size = path.stat().st_size
        raise BrokenRecordingError(
            f"{path.name} is truncated: its {size} bytes are not a complete file ({error})"
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
        stated: decompressed size according to the chunk's header, bytes.

    Raises:
        BrokenRecordingError: if the decompressed size is larger than `stated` or `MAX_RECORD`.
    """
    if compression in ("", "none"):
        return data
    max_size = min(stated, MAX_RECORD)
    content: bytes = DECOMPRESSORS[compression]().decompress(data, max_length=max_size + 1)
    if len(content) > max_size:
        raise BrokenRecordingError(
            f"chunk: got more than {max_size} decompressed bytes, expected {stated} (at most {MAX_RECORD})"
        )
    return content


def cut_off(path: Path, file: BufferedReader) -> BrokenRecordingError:
    """Return the exception for a truncated file, read up to the position of `file`."""
    return BrokenRecordingError(
        f"{path.name} is truncated: of its {path.stat().st_size} bytes, the first {file.tell()} are complete records"
    )
