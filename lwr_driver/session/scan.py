"""The reading side of an MCAP file: its whole records from front to back.

Nothing relies on the summary at the end, so the file of a killed recorder reads like any other. The messages
of a chunk are found through the message indexes after it. These are checked against the data and replaced by
a walk through the records if missing or wrong.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Generator, Iterator
from dataclasses import dataclass
from typing import Any, BinaryIO

import numpy as np
import zstandard
from numpy.typing import NDArray

from fri.errors import DataError
from lwr_driver.configuration import as_path
from lwr_driver.session.container import FOOTER_SIZE, MAGIC, MESSAGE_HEAD, Opcode

_LARGEST_CHUNK = 1 << 28
_LOGS_NAMED = 5
_LOOSE_BYTES = 4 << 20
_HEAD = np.dtype(
    [
        ("opcode", "u1"),
        ("length", "<u8"),
        ("channel", "<u2"),
        ("sequence", "<u4"),
        ("log_time", "<u8"),
        ("publish_time", "<u8"),
    ]
)
assert _HEAD.itemsize == MESSAGE_HEAD.size
_LARGEST_TIME = np.uint64(2**63 - 1)


@dataclass(frozen=True)
class SchemaRecord:
    """A message definition in the file."""

    name: str
    encoding: str
    data: bytes


@dataclass(frozen=True)
class ChannelRecord:
    """A channel of the file."""

    number: int
    schema: SchemaRecord | None
    topic: str
    encoding: str
    info: dict[str, str]


@dataclass(frozen=True)
class Block:
    """The messages of one chunk, or of a run of messages outside chunks, in the order of the file.

    data : uint8, plain bytes; starts, sizes : (n,) place of each message, without its head
    channel, sequence, log_time, publish_time : (n,) int64
    """

    offset: int
    data: NDArray[np.uint8]
    starts: NDArray[np.int64]
    sizes: NDArray[np.int64]
    channel: NDArray[np.int64]
    sequence: NDArray[np.int64]
    log_time: NDArray[np.int64]
    publish_time: NDArray[np.int64]

    def message(self, row: int) -> bytes:
        """The bytes of message `row`."""
        start = int(self.starts[row])
        return self.data[start : start + int(self.sizes[row])].tobytes()

    def gather(self, rows: NDArray[np.int64], size: int) -> NDArray[np.uint8]:
        """The messages `rows`, all of `size` bytes, as (n, size) uint8."""
        # Items of plain bytes, so every byte is copied.
        windows: NDArray[Any] = np.ndarray(
            (len(self.data) - size + 1,), dtype=f"V{size}", buffer=self.data.data, strides=(1,)
        )
        return windows[self.starts[rows]].view(np.uint8).reshape(len(rows), size)


class _Cut(Exception):
    """The file ends here, or continues with nonsense."""


class _Damage(Exception):
    """A whole record with damaged content."""


class Scan:
    """One pass over a file; the other attributes are complete after the last of `blocks`.

    closed : the file ends with a footer; bytes_unread : bytes behind the last whole record
    lost_from, lost_to : log times of a truncated chunk, if its head is readable
    skipped : damaged chunks and records left out, in words (only with `skip_damage`)
    """

    def __init__(self, path: str | os.PathLike[str], *, skip_damage: bool = False) -> None:
        self.path = as_path(path, "session log")
        self.profile = ""
        self.channels: dict[int, ChannelRecord] = {}
        self.metadata: list[tuple[str, dict[str, str]]] = []
        self.attachments: dict[str, tuple[str, int, bytes]] = {}
        self.closed = False
        self.whole = False
        self.bytes_unread = 0
        self.lost_from: int | None = None
        self.lost_to: int | None = None
        self.skipped: list[str] = []
        self._skip_damage = skip_damage
        self._schemas: dict[int, SchemaRecord] = {}
        self._decompressor = zstandard.ZstdDecompressor()

    def blocks(self) -> Iterator[Block]:
        """The messages, chunk by chunk. DataError if the file is no MCAP or a chunk within it is damaged."""
        if self.path.is_dir():
            logs = ", ".join(log.name for log in sorted(self.path.glob("*.mcap"))[:_LOGS_NAMED])
            advice = f"its session logs by name: {logs}" if logs else "a session log (.mcap); it holds none"
            raise DataError(f"{self.path}: is a folder; give {advice}")
        try:
            size = self.path.stat().st_size
            file = open(self.path, "rb")  # noqa: SIM115 - closed below, also when the caller stops early
        except OSError as error:
            raise DataError(f"{self.path}: cannot be read: {error.strerror}") from error
        with file:
            try:
                yield from self._blocks(file, size)
            except OSError as error:
                raise DataError(f"{self.path}: cannot be read: {error}") from error

    def _blocks(self, file: BinaryIO, size: int) -> Iterator[Block]:
        start = file.read(len(MAGIC))
        if start != MAGIC:
            what = "is empty" if not start else "is not an MCAP file: its first bytes are not the MCAP magic"
            raise DataError(f"{self.path}: {what}; give a session log (.mcap)")
        self.closed = self._footer(file, size)
        file.seek(len(MAGIC))
        end = size - len(MAGIC) if self.closed else size
        at = whole = len(MAGIC)
        chunk: tuple[int, bytes] | None = None
        index: list[bytes] = []
        loose: list[bytes] = []
        loose_bytes, loose_at = 0, at
        damage: tuple[int, str] | None = None
        try:
            while at < end:
                opcode, length = self._head(file, at, end)
                if chunk is not None and opcode != Opcode.MESSAGE_INDEX:
                    damage = yield from self._chunk(chunk, index, damage)
                    chunk, index = None, []
                if loose and (opcode != Opcode.MESSAGE or loose_bytes > _LOOSE_BYTES):
                    yield self._loose(loose_at, loose)
                    loose, loose_bytes = [], 0
                if opcode == Opcode.DATA_END:
                    whole, self.whole = end, True
                    break
                content = file.read(length)
                if len(content) < length:
                    raise _Cut
                if opcode == Opcode.CHUNK:
                    chunk = (at, content)
                elif opcode == Opcode.MESSAGE_INDEX:
                    index.append(content)
                elif opcode == Opcode.MESSAGE:
                    loose_at = loose_at if loose else at
                    loose.append(struct.pack("<BQ", opcode, length) + content)
                    loose_bytes += len(loose[-1])
                else:
                    self._record(opcode, content, at)
                at = whole = at + 9 + length
        except _Cut:
            pass
        if chunk is not None:
            damage = yield from self._chunk(chunk, index, damage)
        if loose:
            yield self._loose(loose_at, loose)
        if damage is not None:
            if self.closed or self.whole:
                raise self._damaged(*damage)
            whole = damage[0]
        self.bytes_unread = 0 if self.whole else size - whole

    def _footer(self, file: BinaryIO, size: int) -> bool:
        if size < len(MAGIC) + FOOTER_SIZE:
            return False
        file.seek(size - FOOTER_SIZE)
        tail = file.read(FOOTER_SIZE)
        return tail.endswith(MAGIC) and struct.unpack_from("<BQ", tail) == (Opcode.FOOTER, 20)

    def _head(self, file: BinaryIO, at: int, end: int) -> tuple[int, int]:
        head = file.read(9)
        if len(head) < 9:
            raise _Cut
        opcode, length = struct.unpack("<BQ", head)
        if opcode == 0:
            raise _Cut
        if length > end - at - 9:
            if opcode == Opcode.CHUNK:
                times = file.read(16)
                if len(times) == 16:
                    first, last = struct.unpack("<QQ", times)
                    if 0 < first <= last < 2**63:
                        self.lost_from, self.lost_to = first, last
            raise _Cut
        return opcode, length

    def _damaged(self, at: int, what: str) -> DataError:
        return DataError(
            f"{self.path}: the chunk at byte {at} is damaged: {what}; "
            "`lwr-run recover` keeps the chunks around it and says what is lost"
        )

    def _chunk(
        self, chunk: tuple[int, bytes], index: list[bytes], damage: tuple[int, str] | None
    ) -> Generator[Block, None, tuple[int, str] | None]:
        """Yields the block of a chunk; returns the damage not yet followed by a good chunk."""
        at, content = chunk
        try:
            data = self._decompress(content)
            block = self._block(at, data, index)
        except _Damage as error:
            if self._skip_damage:
                self.skipped.append(f"chunk at byte {at}{_span(content)}: {error}")
                return damage
            if damage is not None:
                raise self._damaged(*damage) from error
            return (at, f"{error}{_span(content)}")
        if damage is not None:
            raise self._damaged(*damage)
        yield block
        return damage

    def _decompress(self, content: bytes) -> bytes:
        try:
            size, crc, length = struct.unpack_from("<QII", content, 16)
            compression = content[32 : 32 + length].decode()
            (packed_size,) = struct.unpack_from("<Q", content, 32 + length)
        except (struct.error, UnicodeDecodeError) as error:
            raise _Damage("its head makes no sense") from error
        packed = memoryview(content)[40 + length :]
        if len(packed) < packed_size or size > _LARGEST_CHUNK:
            raise _Damage(f"{packed_size} packed and {size} plain bytes cannot be")
        packed = packed[:packed_size]
        try:
            if compression == "":
                data = bytes(packed)
            elif compression == "zstd":
                if zstandard.frame_content_size(packed) not in (-1, size):
                    raise _Damage("its size contradicts itself")
                data = self._decompressor.decompress(packed, max_output_size=size) if size else b""
            elif compression == "lz4":
                data = _lz4(packed, size)
            else:
                raise DataError(
                    f"{self.path}: chunk compression {compression!r} is unknown; use zstd, lz4 or none"
                )
        except (zstandard.ZstdError, RuntimeError, ValueError, MemoryError) as error:
            if isinstance(error, DataError):
                raise
            raise _Damage(f"it cannot be unpacked ({error})") from error
        if len(data) != size:
            raise _Damage(f"it unpacks to {len(data)} bytes instead of {size}")
        if crc and zlib.crc32(data) != crc:
            raise _Damage("its checksum does not match")
        return data

    def _block(self, at: int, data: bytes, index: list[bytes]) -> Block:
        plain = np.frombuffer(data, dtype=np.uint8)
        starts = self._indexed(data, plain, index)
        if starts is None:
            starts = self._walk(data, 0, len(data), at)
        return self._messages(at, plain, starts)

    def _messages(self, at: int, plain: NDArray[np.uint8], starts: NDArray[np.int64]) -> Block:
        heads = _heads(plain, starts)
        if len(heads) and max(heads["log_time"].max(), heads["publish_time"].max()) > _LARGEST_TIME:
            raise _Damage("it holds a time beyond the year 2262")
        return Block(
            offset=at,
            data=plain,
            starts=starts + _HEAD.itemsize,
            sizes=heads["length"].astype(np.int64) - (_HEAD.itemsize - 9),
            channel=heads["channel"].astype(np.int64),
            sequence=heads["sequence"].astype(np.int64),
            log_time=heads["log_time"].astype(np.int64),
            publish_time=heads["publish_time"].astype(np.int64),
        )

    def _indexed(self, data: bytes, plain: NDArray[np.uint8], index: list[bytes]) -> NDArray[np.int64] | None:
        """Starts of the message records by the indexes; None unless these account for every byte."""
        parts = []
        for content in index:
            if (
                len(content) < 6
                or (len(content) - 6) % 16
                or len(content) - 6 != struct.unpack_from("<I", content, 2)[0]
            ):
                return None
            parts.append(np.frombuffer(content, dtype="<u8", offset=6)[1::2])
        if not parts:
            return None
        places = np.sort(np.concatenate(parts))
        if not len(places) or int(places[-1]) + _HEAD.itemsize > len(data):
            return None
        starts = places.astype(np.int64)
        heads = _heads(plain, starts)
        if (heads["opcode"] != Opcode.MESSAGE).any() or heads["length"].max() > len(data):
            return None
        ends = starts + 9 + heads["length"].astype(np.int64)
        before = np.concatenate([[0], ends])
        after = np.concatenate([starts, [len(data)]])
        between = after - before
        if (between < 0).any() or (heads["length"] < _HEAD.itemsize - 9).any():
            return None
        for row in np.flatnonzero(between).tolist():
            if len(self._walk(data, int(before[row]), int(after[row]), 0)):
                return None
        return starts

    def _walk(self, data: bytes, start: int, stop: int, at: int) -> NDArray[np.int64]:
        """Starts of the message records between two places, by a walk; it reads schemas and channels too."""
        starts = []
        while start < stop:
            if start + 9 > stop:
                raise _Damage(f"it ends within a record at byte {start}")
            opcode, length = struct.unpack_from("<BQ", data, start)
            if length > stop - start - 9 or opcode == 0:
                raise _Damage(f"record 0x{opcode:02x} of {length} bytes at byte {start} does not fit into it")
            if opcode == Opcode.MESSAGE:
                if length < _HEAD.itemsize - 9:
                    raise _Damage(f"message record of {length} bytes at byte {start} is too short")
                starts.append(start)
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self._record(opcode, data[start + 9 : start + 9 + length], at)
            start += 9 + length
        return np.array(starts, dtype=np.int64)

    def _loose(self, at: int, records: list[bytes]) -> Block:
        sizes = np.array([len(record) for record in records], dtype=np.int64)
        if (sizes < _HEAD.itemsize).any():
            raise DataError(f"{self.path}: message record near byte {at} is too short")
        try:
            return self._messages(
                at, np.frombuffer(b"".join(records), dtype=np.uint8), np.cumsum(sizes) - sizes
            )
        except _Damage as error:
            raise DataError(f"{self.path}: messages near byte {at}: {error}") from error

    def _record(self, opcode: int, content: bytes, at: int) -> None:
        try:
            self._take_record(opcode, content, at)
        except DataError as error:
            if not self._skip_damage:
                raise
            self.skipped.append(str(error).removeprefix(f"{self.path}: "))

    def _take_record(self, opcode: int, content: bytes, at: int) -> None:
        try:
            reader = _Fields(content)
            if opcode == Opcode.HEADER:
                self.profile = reader.text()
            elif opcode == Opcode.SCHEMA:
                number = reader.number("<H")
                self._schemas[number] = SchemaRecord(reader.text(), reader.text(), reader.bytes("<I"))
            elif opcode == Opcode.CHANNEL:
                number, schema = reader.number("<H"), reader.number("<H")
                self.channels[number] = ChannelRecord(
                    number, self._schemas.get(schema), reader.text(), reader.text(), reader.texts()
                )
            elif opcode == Opcode.METADATA:
                self.metadata.append((reader.text(), reader.texts()))
            elif opcode == Opcode.ATTACHMENT:
                time, _ = reader.number("<Q"), reader.number("<Q")
                name, media_type, data = reader.text(), reader.text(), reader.bytes("<Q")
                crc = reader.number("<I")
                if crc and zlib.crc32(content[:-4]) != crc:
                    raise DataError(
                        f"{self.path}: attachment {name!r} at byte {at} is damaged: checksum does not match"
                    )
                self.attachments.setdefault(name, (media_type, time, data))
        except (struct.error, UnicodeDecodeError, IndexError) as error:
            raise DataError(
                f"{self.path}: record 0x{opcode:02x} at byte {at} makes no sense: {error}"
            ) from error


class _Fields:
    """Reads the fields of a record in turn."""

    def __init__(self, content: bytes) -> None:
        self._content = content
        self._at = 0

    def number(self, code: str) -> int:
        value = struct.unpack_from(code, self._content, self._at)[0]
        self._at += struct.calcsize(code)
        return int(value)

    def bytes(self, code: str) -> bytes:
        length = self.number(code)
        if length > len(self._content) - self._at:
            raise IndexError(f"{length} bytes announced, {len(self._content) - self._at} there")
        self._at += length
        return self._content[self._at - length : self._at]

    def text(self) -> str:
        return self.bytes("<I").decode()

    def texts(self) -> dict[str, str]:
        inner = _Fields(self.bytes("<I"))
        values = {}
        while inner._at < len(inner._content):
            key = inner.text()
            values[key] = inner.text()
        return values


def _heads(plain: NDArray[np.uint8], starts: NDArray[np.int64]) -> NDArray[Any]:
    if not len(starts):
        return np.zeros(0, dtype=_HEAD)
    windows: NDArray[Any] = np.ndarray(
        (len(plain) - _HEAD.itemsize + 1,), dtype=f"V{_HEAD.itemsize}", buffer=plain.data, strides=(1,)
    )
    return windows[starts].view(_HEAD)


def _span(content: bytes) -> str:
    if len(content) < 16:
        return ""
    first, last = struct.unpack_from("<QQ", content)
    return f" (log time {first / 1e9:.3f} s to {last / 1e9:.3f} s)"


def _lz4(packed: memoryview, size: int) -> bytes:
    import lz4.frame  # type: ignore[import-untyped]  # mcap's own dependency, for logs of other tools

    decompressor = lz4.frame.LZ4FrameDecompressor()
    data: bytes = decompressor.decompress(packed, max_length=size)
    if not decompressor.eof and not decompressor.needs_input:
        raise _Damage(f"it unpacks to more than {size} bytes")
    return data
