"""Repair of the session log of a killed recorder."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fri.errors import ConfigurationError, DataError
from lwr_driver.configuration import as_path
from lwr_driver.session.container import MESSAGE_HEAD, Container, Messages, Opcode
from lwr_driver.session.messages import Schema
from lwr_driver.session.scan import Block, ChannelRecord, Scan
from lwr_driver.session.session import stamp


@dataclass(frozen=True)
class Recovery:
    """Result of `recover`.

    needed : whether the file was broken at all
    messages : messages of each topic in the recovered file
    bytes_unread : unreadable bytes at the end of the broken file
    lost : one sentence for each loss
    """

    path: Path
    out: Path
    needed: bool
    messages: Mapping[str, int]
    bytes_unread: int
    lost: tuple[str, ...]

    def __str__(self) -> str:
        if not self.needed:
            return f"{self.path} is whole; {self.out} is a copy of its messages"
        counts = ", ".join(f"{count} on {topic}" for topic, count in self.messages.items())
        return "\n".join([f"{self.out} holds {counts}", *(f"lost: {line}" for line in self.lost)])


def recover(path: str | Path, out: str | Path | None = None) -> Recovery:
    """Write everything readable in the broken session log `path` into the whole file `out`.

    out : default is `NAME.recovered.mcap` beside `path`; an existing file is refused

    Damaged chunks are left out and named. A missing `session_end` is added with exit status `fail`. The
    result is read back and its message counts compared before it gets its name. DataError if nothing can be
    recovered.
    """
    path = as_path(path, "session log")
    out = path.with_suffix(".recovered.mcap") if out is None else as_path(out, "recovered session log")
    if out.exists():
        raise ConfigurationError(f"{out} exists already; name another file or remove it")
    scan = Scan(path, skip_damage=True)
    with replacing(out) as partial:
        container = Container(partial, library=f"lwr-identification recover of {path.name}")
        try:
            counts = copy_messages(scan, container)
            if not counts:
                raise DataError(f"{path}: no whole message can be read; there is nothing to recover")
            lost = _lost(scan)
            ended = any(name == "session_end" for name, _ in scan.metadata)
            if not ended:
                reason = "the recorder died; recovered: " + "; ".join(lost)
                end = {
                    "exit_status": "fail",
                    "reason": reason,
                    "samples": str(counts.get("/joint_states", 0)),
                }
                container.describe("session_end", {**end, "missed": "unknown"})
            container.finish()
        finally:
            container.abandon()
        _verify(partial, counts)
    return Recovery(path, out, bool(lost) or not scan.closed, counts, scan.bytes_unread, lost)


def copy_messages(
    scan: Scan,
    container: Container,
    *,
    metadata: Mapping[str, str] | None = None,
    added: Messages | None = None,
) -> dict[str, int]:
    """Copy attachments, metadata and messages of `scan` chunk by chunk, by log time within each.

    metadata : replaces the record `session`
    added : further messages, put into chunks by their log times

    Returns the number of copied messages of each topic.
    """
    counts: dict[str, int] = {}
    described = False
    for block in scan.blocks():
        if not described:
            described = True
            _copy_head(scan, container, metadata)
        channels = {number: scan.channels.get(number) for number in np.unique(block.channel).tolist()}
        messages = _messages(block, channels, container)
        if added is not None and len(block.log_time):
            now, added = added.split(int(block.log_time.max()))
            messages = messages.merged(now)
        container.write_chunk(messages)
        for number, channel in channels.items():
            if channel is not None:
                count = int((block.channel == number).sum())
                counts[channel.topic] = counts.get(channel.topic, 0) + count
    if not described:
        _copy_head(scan, container, metadata)
    if added is not None:
        container.write_chunk(added)
    for name, values in scan.metadata:
        if name != "session":
            container.describe(name, values)
    return counts


@contextlib.contextmanager
def replacing(out: Path) -> Iterator[Path]:
    """A file to write beside `out`: it takes the name `out` in one step, or vanishes on an error."""
    partial = out.with_name(f".{out.name}.{os.getpid()}.partial")
    partial.unlink(missing_ok=True)
    try:
        yield partial
        os.replace(partial, out)
    finally:
        partial.unlink(missing_ok=True)


def _copy_head(scan: Scan, container: Container, metadata: Mapping[str, str] | None) -> None:
    session = [values for name, values in scan.metadata if name == "session"]
    if metadata is not None or session:
        container.describe("session", metadata if metadata is not None else session[-1])
    for name, (media_type, time, data) in scan.attachments.items():
        container.attach(name, data, media_type, time)


def _messages(block: Block, channels: Mapping[int, ChannelRecord | None], container: Container) -> Messages:
    numbers = {}
    for number, channel in channels.items():
        if channel is not None:
            schema = channel.schema
            numbers[number] = container.channel(
                channel.topic,
                Schema(schema.name if schema else "", schema.data.decode(errors="replace") if schema else ""),
                schema_encoding=schema.encoding if schema else "",
                encoding=channel.encoding,
                info=channel.info,
            )
    rows = [
        row
        for row in np.argsort(block.log_time, kind="stable").tolist()
        if int(block.channel[row]) in numbers
    ]
    records = [
        MESSAGE_HEAD.pack(
            Opcode.MESSAGE,
            MESSAGE_HEAD.size - 9 + int(block.sizes[row]),
            numbers[int(block.channel[row])],
            int(block.sequence[row]),
            int(block.log_time[row]),
            int(block.publish_time[row]),
        )
        + block.message(row)
        for row in rows
    ]
    channel_numbers = np.array([numbers[int(block.channel[row])] for row in rows], dtype=np.int64)
    return Messages(records, channel_numbers, block.log_time[rows])


def _lost(scan: Scan) -> tuple[str, ...]:
    lost = list(scan.skipped)
    if scan.bytes_unread:
        lost.append(f"{scan.bytes_unread} bytes at the end of the file")
    if scan.lost_from is not None and scan.lost_to is not None:
        seconds = (scan.lost_to - scan.lost_from) * 1e-9
        lost.append(f"the chunk that was cut, {seconds:.3f} s of log time from {stamp(scan.lost_from)}")
    if not any(name == "session_end" for name, _ in scan.metadata):
        lost.append("what the recorder had not yet written when it died, 0.5 s at most")
    return tuple(lost)


def _verify(path: Path, counts: Mapping[str, int]) -> None:
    scan = Scan(path)
    found: dict[str, int] = {}
    for block in scan.blocks():
        for number, count in zip(*np.unique(block.channel, return_counts=True), strict=True):
            topic = scan.channels[int(number)].topic
            found[topic] = found.get(topic, 0) + int(count)
    if found != dict(counts) or not scan.closed:
        raise DataError(f"{path}: the recovered file reads back as {found} instead of {dict(counts)}")
