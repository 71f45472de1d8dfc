"""Records of an MCAP file as bytes, after the MCAP specification (https://mcap.dev/spec)."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping
from enum import IntEnum

__all__ = [
    "FOOTER_SIZE",
    "MAGIC",
    "MESSAGE_HEAD",
    "Opcode",
    "attachment",
    "attachment_index",
    "channel",
    "chunk_index",
    "message_prefix",
    "metadata",
    "metadata_index",
    "record",
    "schema",
    "statistics",
    "text",
    "texts",
]

MAGIC = b"\x89MCAP0\r\n"

MESSAGE_HEAD = struct.Struct("<BQHIQQ")
"""Start of a message record: opcode, length, channel, sequence, log time, publish time; then the message."""

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


def record(opcode: Opcode, *parts: bytes) -> bytes:
    """A record of the given content."""
    content = b"".join(parts)
    return struct.pack("<BQ", opcode, len(content)) + content


def text(value: str) -> bytes:
    """A string with its length."""
    data = value.encode()
    return struct.pack("<I", len(data)) + data


def texts(values: Mapping[str, str]) -> bytes:
    """A map of strings with its length in bytes."""
    data = b"".join(text(key) + text(value) for key, value in values.items())
    return struct.pack("<I", len(data)) + data


def schema(number: int, name: str, encoding: str, data: bytes) -> bytes:
    """A schema record."""
    head = struct.pack("<H", number) + text(name) + text(encoding)
    return record(Opcode.SCHEMA, head, struct.pack("<I", len(data)), data)


def channel(number: int, schema_number: int, topic: str, encoding: str, info: Mapping[str, str]) -> bytes:
    """A channel record."""
    head = struct.pack("<HH", number, schema_number)
    return record(Opcode.CHANNEL, head, text(topic), text(encoding), texts(info))


def message_prefix(channel_number: int, size: int) -> bytes:
    """Head of a message record for a message of `size` bytes, counters and times zero."""
    return MESSAGE_HEAD.pack(Opcode.MESSAGE, MESSAGE_HEAD.size - 9 + size, channel_number, 0, 0, 0)


def attachment(name: str, media_type: str, data: bytes, time_ns: int) -> bytes:
    """An attachment record with its CRC."""
    content = struct.pack("<QQ", time_ns, time_ns) + text(name) + text(media_type)
    content += struct.pack("<Q", len(data)) + data
    return record(Opcode.ATTACHMENT, content, struct.pack("<I", zlib.crc32(content)))


def metadata(name: str, values: Mapping[str, str]) -> bytes:
    """A metadata record."""
    return record(Opcode.METADATA, text(name), texts(values))


def attachment_index(
    offset: int, length: int, times: tuple[int, int], size: int, name: str, media_type: str
) -> bytes:
    """Where an attachment stands; `times` are its log and create time."""
    head = struct.pack("<QQQQQ", offset, length, *times, size)
    return record(Opcode.ATTACHMENT_INDEX, head, text(name), text(media_type))


def metadata_index(offset: int, length: int, name: str) -> bytes:
    """Where a metadata record stands."""
    return record(Opcode.METADATA_INDEX, struct.pack("<QQ", offset, length), text(name))


def chunk_index(
    times: tuple[int, int],
    place: tuple[int, int],
    index_offsets: Mapping[int, int],
    index_length: int,
    compression: str,
    sizes: tuple[int, int],
) -> bytes:
    """Where a chunk stands: (first, last) log time, (offset, length), indexes, (packed, plain) size."""
    offsets = b"".join(struct.pack("<HQ", *item) for item in index_offsets.items())
    head = struct.pack("<QQQQI", *times, *place, len(offsets))
    return record(
        Opcode.CHUNK_INDEX,
        head,
        offsets,
        struct.pack("<Q", index_length),
        text(compression),
        struct.pack("<QQ", *sizes),
    )


def statistics(
    counts: Mapping[int, int],
    schemas: int,
    attachments: int,
    metadata_count: int,
    chunks: int,
    times: tuple[int, int],
) -> bytes:
    """Counts of the whole file; `counts` are the messages of each channel."""
    head = struct.pack(
        "<QHIIIIQQ", sum(counts.values()), schemas, len(counts), attachments, metadata_count, chunks, *times
    )
    data = b"".join(struct.pack("<HQ", *item) for item in counts.items())
    return record(Opcode.STATISTICS, head, struct.pack("<I", len(data)), data)
