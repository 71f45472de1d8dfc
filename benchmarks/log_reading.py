"""CPU time of writing and reading a session log of 600 s at 1 kHz, beside the official reader on a slice.

    python -m benchmarks.log_reading [--seconds 600] [--slice 10]

Three channels of seven joints (measured, commanded, motor torques) as the recorder writes them. The official
reader decodes with `mcap-ros2-support` a slice of the same file; its time is scaled to the whole.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from lwr_driver.session import SessionWriter, read_session, session_metadata

JOINTS = ("A1", "A2", "E1", "A3", "A4", "A5", "A6")
EPOCH = 1_700_000_000 * 10**9
BATCH = 40  # rows, as the recorder drains them


@contextmanager
def cpu(times: dict[str, float], name: str) -> Iterator[None]:
    start = time.process_time()
    yield
    times[name] = time.process_time() - start


def write(path: Path, seconds: float) -> int:
    count = round(seconds * 1000)
    rng = np.random.default_rng(0)
    angle = np.arange(count)[:, None] * 1e-3 * np.arange(1, 8)
    position = (0.8 * np.sin(angle)).astype(np.float32)
    torque = (40 * np.cos(angle) + rng.normal(size=angle.shape)).astype(np.float32)
    motor = (torque + 5 * np.sign(np.cos(angle)) + rng.normal(size=angle.shape)).astype(np.float32)
    log_time = EPOCH + np.arange(count) * 1_000_000 + rng.integers(0, 50_000, size=count)
    with SessionWriter(path, JOINTS, session_metadata(robot="LWR4+")) as writer:
        for first in range(0, count, BATCH):
            rows = slice(first, first + BATCH)
            sequence = np.arange(first, min(first + BATCH, count))
            clock = {"publish_time": sequence * 1_000_000, "sequence": sequence}
            writer.write_joint_states(log_time[rows], position[rows], torque[rows], **clock)
            writer.write_joint_command(log_time[rows], position[rows], **clock)
            writer.write_motor_states(log_time[rows], motor[rows], **clock)
            writer.advance(int(log_time[rows][-1]))
    return count


def official(path: Path, seconds: float) -> tuple[int, float]:
    """Messages decoded in a slice, and a checksum of what they hold."""
    messages, total = 0, 0.0
    with open(path, "rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        stop = EPOCH + round(seconds * 1e9)
        for _, channel, record, message in reader.iter_decoded_messages(log_time_order=False):
            if record.log_time >= stop:
                break
            messages += 1
            if channel.topic == "/joint_states":
                total += message.effort[6]
    return messages, total


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=600.0)
    parser.add_argument("--slice", type=float, default=10.0)
    options = parser.parse_args()
    times: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "session.mcap"
        with cpu(times, "write"):
            count = write(path, options.seconds)
        size = path.stat().st_size
        with cpu(times, "read"):
            session = read_session(path)
        with cpu(times, "official"):
            messages, total = official(path, options.slice)
    sliced = session.joint.rows(EPOCH, EPOCH + round(options.slice * 1e9))
    if not np.isclose(sliced.effort[:, 6].sum(), total) or len(session.joint) != count or session.missing:
        raise SystemExit("the two readers disagree")
    scaled, each = times["official"] * 3 * count / messages, times["official"] / messages * 1e6
    print(f"{options.seconds:g} s at 1 kHz, 3 channels of 7 joints: {3 * count} messages")
    print(f"file            {size / 1e6:8.1f} MB    {size / (3 * count):6.1f} bytes a message")
    print(
        f"write           {times['write']:8.2f} s CPU {times['write'] / (3 * count) * 1e6:6.2f} us a message"
    )
    print(f"read            {times['read']:8.2f} s CPU {times['read'] / (3 * count) * 1e6:6.2f} us a message")
    print(f"official reader {scaled:8.2f} s CPU {each:6.2f} us a message (scaled from a slice)")
    print(f"ratio           {scaled / times['read']:8.1f}")


if __name__ == "__main__":
    main()
