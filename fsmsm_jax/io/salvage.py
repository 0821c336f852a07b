"""Messages out of rosbags whose index was never written, because the recorder died.

A bag is closed by writing an index at its end, and the usual readers start there. The
messages themselves lie one after the other from the start of the file, and here they
are read in that order until the bytes end or make no sense:

- ROS 1: records `size header size data`; chunks hold records of connections (a topic
  and its type) and messages (format 2.0, wiki.ros.org/Bags);
- mcap: records `opcode size content`; chunks hold schemas, channels and messages
  (mcap.dev/spec);
- sqlite: the rows of `messages` as stored, not in the order that needs an index.
"""

import bz2
import sqlite3
import struct
import sys
from collections.abc import Container, Iterator
from io import BufferedIOBase, BytesIO
from pathlib import Path
from typing import NamedTuple

__all__ = ["RawMessage", "salvage"]

# Beyond a tear are random bytes, which fail anywhere: as sizes, names, codes, floats.
_TORN = (
    *(ArithmeticError, EOFError, LookupError, MemoryError, OSError, RuntimeError),
    *(ValueError, struct.error, sqlite3.Error),
)


class RawMessage(NamedTuple):
    """One message as it lies in a bag."""

    topic: str
    kind: str
    """Its type in the spelling of ROS 2, as `sensor_msgs/msg/LaserScan`."""
    recorded: float
    """When it was recorded [s]."""
    data: bytes


def salvage(path: Path, kinds: Container[str]) -> list[RawMessage]:
    """The messages of some kinds that can be read, in the order of the file.

    Never an error: what cannot be read is not there.

    Args:
        path: a `.bag`, `.db3`, `.mcap` or a folder of the last two.
        kinds: types of messages in the spelling of ROS 2.
    """
    files = (
        sorted([*path.glob("*.db3"), *path.glob("*.mcap")]) if path.is_dir() else [path]
    )
    found = []
    for file in files:
        try:
            for message in _READERS[file.suffix](file):
                if message.kind in kinds:
                    found.append(message)
        except _TORN:
            continue
    return found


def _sized(stream: BufferedIOBase, form: str) -> bytes:
    """A block that follows its size; shorter where the file ends."""
    head = stream.read(struct.calcsize(form))
    return stream.read(*struct.unpack(form, head))


def _unpacked(data: bytes, compression: str) -> bytes:
    """The content of a chunk, as far as a torn one goes."""
    if compression == "bz2":
        return bz2.BZ2Decompressor().decompress(data)
    if compression == "lz4":
        from lz4.frame import LZ4FrameDecompressor

        return LZ4FrameDecompressor().decompress(data)
    if compression == "zstd":
        if sys.version_info >= (3, 14):
            from compression import zstd
        else:
            from backports import zstd
        try:
            return zstd.ZstdDecompressor().decompress(data)
        except zstd.ZstdError as error:
            raise ValueError(str(error)) from error
    return data


def _bag(path: Path) -> Iterator[RawMessage]:
    with path.open("rb") as file:
        file.readline()
        yield from _bag_records(file, {})


def _bag_records(
    stream: BufferedIOBase, connections: dict[bytes, tuple[str, str]]
) -> Iterator[RawMessage]:
    while True:
        try:
            header = _bag_fields(_sized(stream, "<I"))
            data = _sized(stream, "<I")
        except struct.error:
            return
        match header[b"op"]:
            case b"\x05":
                chunk = _unpacked(data, header[b"compression"].decode())
                yield from _bag_records(BytesIO(chunk), connections)
            case b"\x07":
                package, _, name = _bag_fields(data)[b"type"].decode().partition("/")
                connections[header[b"conn"]] = (
                    header[b"topic"].decode(),
                    f"{package}/msg/{name}",
                )
            case b"\x02":
                seconds, nanoseconds = struct.unpack("<II", header[b"time"])
                topic, kind = connections[header[b"conn"]]
                yield RawMessage(topic, kind, seconds + 1e-9 * nanoseconds, data)


def _bag_fields(block: bytes) -> dict[bytes, bytes]:
    fields = {}
    stream = BytesIO(block)
    while field := (stream.tell() < len(block) and _sized(stream, "<I")):
        name, _, value = field.partition(b"=")
        fields[name] = value
    return fields


def _mcap(path: Path) -> Iterator[RawMessage]:
    with path.open("rb") as file:
        file.seek(8)
        yield from _mcap_records(file, {}, {})


def _mcap_records(
    stream: BufferedIOBase,
    schemas: dict[int, str],
    channels: dict[int, tuple[str, str]],
) -> Iterator[RawMessage]:
    while opcode := stream.read(1):
        try:
            content = _sized(stream, "<Q")
        except struct.error:
            return
        block = BytesIO(content)
        match opcode:
            case b"\x06":
                block.seek(28)  # times, size and checksum of the chunk
                compression = _sized(block, "<I").decode()
                chunk = _unpacked(_sized(block, "<Q"), compression)
                yield from _mcap_records(BytesIO(chunk), schemas, channels)
            case b"\x03":
                (schema,) = struct.unpack("<H", block.read(2))
                schemas[schema] = _sized(block, "<I").decode()
            case b"\x04":
                channel, schema = struct.unpack("<HH", block.read(4))
                channels[channel] = (_sized(block, "<I").decode(), schemas[schema])
            case b"\x05":
                channel, _, recorded, _ = struct.unpack("<HIQQ", block.read(22))
                yield RawMessage(*channels[channel], 1e-9 * recorded, block.read())


def _sqlite(path: Path) -> Iterator[RawMessage]:
    database = sqlite3.connect(
        f"{path.resolve().as_uri()}?mode=ro&immutable=1", uri=True
    )
    # The file may then be shorter than its header says.
    database.execute("PRAGMA writable_schema = ON")
    try:
        topics = {
            number: (name, kind)
            for number, name, kind in database.execute(
                "SELECT id, name, type FROM topics"
            )
        }
        for topic, recorded, data in database.execute(
            "SELECT topic_id, timestamp, data FROM messages"
        ):
            yield RawMessage(*topics[topic], 1e-9 * recorded, data)
    finally:
        database.close()


_READERS = {".bag": _bag, ".mcap": _mcap, ".db3": _sqlite}
