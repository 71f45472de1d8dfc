"""The writing side of an MCAP file (https://mcap.dev/spec): whole chunks at once, each on the disk in turn.

After every call the file ends with a whole record, so the file of a killed process is readable up to there.
After a failed write (disk full) the broken record is cut off again.
"""

from __future__ import annotations

import contextlib
import os
import struct
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path

import numpy as np
import zstandard
from numpy.typing import NDArray

from fri.errors import ConfigurationError, DataError
from lwr_driver.session.messages import Layout, Schema

MAGIC = b"\x89MCAP0\r\n"

MESSAGE_HEAD = struct.Struct("<BQHIQQ")
"""Start of a message record: opcode, length, channel, sequence, log time, publish time; then the message."""

_HEAD_FIELDS = {"channel_sequence": ("<u4", 11), "log_time": ("<u8", 15), "publish_time": ("<u8", 23)}

FOOTER_SIZE = 9 + 20 + len(MAGIC)
"""Bytes of the footer record and the closing magic."""


class Opcode(IntEnum):
    """Record types."""

    HEADER = 0x01
    FOOTER = 0x02
    SCHEMA = 0x03
    CHANNEL = 0x04
    MESSAGE = 0x05
    CHUNK = 0x06
    MESSAGE_INDEX = 0x07
    CHUNK_INDEX = 0x08
    ATTACHMENT = 0x09
    ATTACHMENT_INDEX = 0x0A
    STATISTICS = 0x0B
    METADATA = 0x0C
    METADATA_INDEX = 0x0D
    SUMMARY_OFFSET = 0x0E
    DATA_END = 0x0F


def _record(opcode: Opcode, *parts: bytes) -> bytes:
    content = b"".join(parts)
    return struct.pack("<BQ", opcode, len(content)) + content


def _text(value: str) -> bytes:
    data = value.encode()
    return struct.pack("<I", len(data)) + data


def _texts(values: Mapping[str, str]) -> bytes:
    """A map of strings with its length in bytes."""
    data = b"".join(_text(key) + _text(value) for key, value in values.items())
    return struct.pack("<I", len(data)) + data


def record_layout(layout: Layout, channel_number: int) -> Layout:
    """Layout of the message records of a channel: their head with its fields, then the message."""
    head = MESSAGE_HEAD.pack(Opcode.MESSAGE, MESSAGE_HEAD.size - 9 + layout.size, channel_number, 0, 0, 0)
    return layout.relaid(head, _HEAD_FIELDS)


PROFILE = "ros2"


@dataclass(frozen=True)
class Messages:
    """Message records in the order of their log time.

    records : complete message records
    channel : (n,) int, channel numbers
    log_time : (n,) int64 [ns]
    """

    records: Sequence[bytes]
    channel: NDArray[np.int64]
    log_time: NDArray[np.int64]

    def split(self, log_time: int) -> tuple[Messages, Messages]:
        """The messages up to `log_time`, and those after it."""
        at = int(np.searchsorted(self.log_time, log_time, side="right"))
        return (
            Messages(self.records[:at], self.channel[:at], self.log_time[:at]),
            Messages(self.records[at:], self.channel[at:], self.log_time[at:]),
        )

    def merged(self, other: Messages) -> Messages:
        """These messages and `other`, in order of log time."""
        if not len(other.records):
            return self
        times = np.concatenate([self.log_time, other.log_time])
        order = np.argsort(times, kind="stable")
        records = [*self.records, *other.records]
        channel = np.concatenate([self.channel, other.channel])
        return Messages([records[row] for row in order.tolist()], channel[order], times[order])


@dataclass
class _Channel:
    number: int
    schema: Schema
    record: bytes
    schema_record: bytes
    written: bool = False


class Container:
    """An MCAP file being written. Refuses to overwrite a file.

    fsync : force each chunk to the disk itself: even a power cut loses the open chunk only
    level : zstd compression level
    """

    def __init__(self, path: Path, *, library: str, fsync: bool = False, level: int = 1) -> None:
        self.path = path
        self.offset = 0
        self._fsync = fsync
        self._compressor = zstandard.ZstdCompressor(level=level, write_checksum=False)
        self._channels: dict[str, _Channel] = {}
        self._schemas: dict[str, tuple[int, bytes]] = {}
        self._counts: dict[int, int] = {}
        self._chunks: list[bytes] = []
        self._attachments: list[bytes] = []
        self._metadata: list[bytes] = []
        self._times: tuple[int, int] | None = None
        try:
            self._file = open(path, "xb", buffering=0)  # noqa: SIM115 - held as long as the object
        except FileExistsError as error:
            raise ConfigurationError(
                f"session log {path} exists already; a log is never overwritten, choose another folder"
            ) from error
        except OSError as error:
            raise ConfigurationError(
                f"session log {path} cannot be created: {error.strerror}; choose a folder that can be written"
            ) from error
        try:
            self._write(MAGIC + _record(Opcode.HEADER, _text(PROFILE), _text(library)))
        except BaseException:
            self._file.close()
            path.unlink(missing_ok=True)
            raise

    def attach(self, name: str, data: bytes, media_type: str, time_ns: int) -> None:
        """Write an attachment."""
        content = struct.pack("<QQ", time_ns, time_ns) + _text(name) + _text(media_type)
        content += struct.pack("<Q", len(data)) + data
        content = _record(Opcode.ATTACHMENT, content, struct.pack("<I", zlib.crc32(content)))
        head = struct.pack("<QQQQQ", self.offset, len(content), time_ns, time_ns, len(data))
        self._write(content)
        self._attachments.append(_record(Opcode.ATTACHMENT_INDEX, head, _text(name), _text(media_type)))

    def describe(self, name: str, values: Mapping[str, str]) -> None:
        """Write a metadata record."""
        content = _record(Opcode.METADATA, _text(name), _texts(values))
        place = struct.pack("<QQ", self.offset, len(content))
        self._write(content)
        self._metadata.append(_record(Opcode.METADATA_INDEX, place, _text(name)))

    def channel(
        self,
        topic: str,
        schema: Schema,
        *,
        schema_encoding: str = "ros2msg",
        encoding: str = "cdr",
        info: Mapping[str, str] | None = None,
    ) -> int:
        """Number of the channel `topic`; the first chunk with one of its messages announces it."""
        if topic not in self._channels:
            key = f"{schema.name}\0{schema_encoding}\0{schema.text}"
            if key not in self._schemas:
                number, data = len(self._schemas) + 1, schema.text.encode()
                head = struct.pack("<H", number) + _text(schema.name) + _text(schema_encoding)
                self._schemas[key] = number, _record(Opcode.SCHEMA, head, struct.pack("<I", len(data)), data)
            schema_number, schema_record = self._schemas[key]
            number = len(self._channels) + 1
            head = struct.pack("<HH", number, schema_number)
            content = _record(Opcode.CHANNEL, head, _text(topic), _text(encoding), _texts(info or {}))
            self._channels[topic] = _Channel(number, schema, content, schema_record)
        return self._channels[topic].number

    def count(self, topic: str) -> int:
        """Messages of `topic` in the file."""
        channel = self._channels.get(topic)
        return 0 if channel is None else self._counts.get(channel.number, 0)

    def write_chunk(self, messages: Messages) -> None:
        """Write a chunk with its message indexes."""
        if not len(messages.records):
            return
        used = np.unique(messages.channel)
        fresh = [
            channel for channel in self._channels.values() if channel.number in used and not channel.written
        ]
        announced: set[bytes] = {item.schema_record for item in self._channels.values() if item.written}
        head: list[bytes] = []
        for channel in fresh:
            if channel.schema_record not in announced:
                announced.add(channel.schema_record)
                head.append(channel.schema_record)
            head.append(channel.record)
        plain = b"".join([*head, *messages.records])
        packed = self._compressor.compress(plain)
        times = (int(messages.log_time.min()), int(messages.log_time.max()))
        chunk = _record(
            Opcode.CHUNK,
            struct.pack("<QQQI", *times, len(plain), zlib.crc32(plain)),
            _text("zstd"),
            struct.pack("<Q", len(packed)),
            packed,
        )
        sizes = np.fromiter(map(len, messages.records), dtype=np.int64, count=len(messages.records))
        starts = sum(map(len, head)) + np.cumsum(sizes) - sizes
        parts, index_offsets, counts = [chunk], {}, {}
        at = self.offset + len(chunk)
        for number in used.tolist():
            mine = messages.channel == number
            entries = np.stack([messages.log_time[mine], starts[mine]], axis=1).astype("<u8").tobytes()
            index = _record(Opcode.MESSAGE_INDEX, struct.pack("<HI", number, len(entries)), entries)
            index_offsets[number], counts[number] = at, int(mine.sum())
            parts.append(index)
            at += len(index)
        offsets = b"".join(struct.pack("<HQ", *item) for item in index_offsets.items())
        chunk_index = _record(
            Opcode.CHUNK_INDEX,
            struct.pack("<QQQQI", *times, self.offset, len(chunk), len(offsets)),
            offsets,
            struct.pack("<Q", at - self.offset - len(chunk)),
            _text("zstd"),
            struct.pack("<QQ", len(packed), len(plain)),
        )
        self._write(b"".join(parts))
        self._chunks.append(chunk_index)
        for channel in fresh:
            channel.written = True
        for number, count in counts.items():
            self._counts[number] = self._counts.get(number, 0) + count
        first, last = self._times or times
        self._times = (min(first, times[0]), max(last, times[1]))

    def finish(self) -> None:
        """Write the end of the data, the summary and the footer, and close."""
        written = [channel for channel in self._channels.values() if channel.written]
        schemas = list(dict.fromkeys(channel.schema_record for channel in written))
        counted = (schemas, self._counts, self._attachments, self._metadata, self._chunks)
        times = self._times or (0, 0)
        head = struct.pack("<QHIIIIQQ", sum(self._counts.values()), *map(len, counted), *times)
        counts = b"".join(struct.pack("<HQ", *item) for item in self._counts.items())
        statistics = _record(Opcode.STATISTICS, head, struct.pack("<I", len(counts)), counts)
        summary_start = self.offset + 9 + 4
        groups: list[tuple[Opcode, list[bytes]]] = [
            (Opcode.SCHEMA, schemas),
            (Opcode.CHANNEL, [channel.record for channel in written]),
            (Opcode.STATISTICS, [statistics]),
            (Opcode.CHUNK_INDEX, self._chunks),
            (Opcode.ATTACHMENT_INDEX, self._attachments),
            (Opcode.METADATA_INDEX, self._metadata),
        ]
        summary, offsets = b"", b""
        for opcode, records in groups:
            if records:
                start = summary_start + len(summary)
                group = b"".join(records)
                summary += group
                offsets += _record(Opcode.SUMMARY_OFFSET, struct.pack("<BQQ", opcode, start, len(group)))
        footer = struct.pack("<BQQQ", Opcode.FOOTER, 20, summary_start, summary_start + len(summary))
        body = summary + offsets + footer
        end = _record(Opcode.DATA_END, struct.pack("<I", 0))
        self._write(end + body + struct.pack("<I", zlib.crc32(body)) + MAGIC)
        os.fsync(self._file.fileno())
        self._file.close()

    def abandon(self) -> None:
        """Close without an end, as a crash would."""
        self._file.close()

    def _write(self, data: bytes) -> None:
        left = memoryview(data)
        try:
            while left:
                left = left[self._file.write(left) :]
            if self._fsync:
                os.fsync(self._file.fileno())
        except OSError as error:
            self._cut()
            raise DataError(
                f"session log {self.path} cannot be written beyond byte {self.offset}: {error.strerror}; "
                "what was recorded before is kept, free space on the disk before the next motion"
            ) from error
        self.offset += len(data)

    def _cut(self) -> None:
        with contextlib.suppress(OSError):
            self._file.truncate(self.offset)
            self._file.seek(self.offset)
