"""Speed of the emulator in lock step, socket included, as a multiple of real time on one core.

    python -m benchmarks.emulator_speed
    python -m benchmarks.emulator_speed --periods 1 --seconds 60 --two-cores

The PC's end is a few lines of its own (receive, add a sine to the setpoint, send), so that the emulator is
measured and not the driver. Both processes share one core unless told otherwise. On a machine that is busy
with other things the wall time says little; the last column is what both need of a processor.
"""

from __future__ import annotations

import math
import os
import socket
import struct
import time

import click
import numpy as np

from fri.packets import CMD_OFFSETS, MSR, MSR_OFFSETS, MSR_SIZE, new_cmd
from sim_backend.process import EmulatorProcess


class PlainClient:
    """Answers as fast as Python can; moves all joints as soon as command mode is on."""

    def __init__(self) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.socket.settimeout(10.0)
        self.port = self.socket.getsockname()[1]
        self._received = bytearray(MSR_SIZE)
        command = new_cmd()
        command["cmd_flags"] = 1
        command["krl_int"][14:16] = 10
        self._command = bytearray(command.tobytes())
        self._start: tuple[float, ...] | None = None
        self._steps = 0

    def run(self, packets: int, period_s: float) -> int:
        """Answer `packets` packets; how many of them were in command mode."""
        received, command = self._received, self._command
        setpoint = struct.Struct("<14f")
        position = struct.Struct("<7f")
        head = struct.Struct("<H")
        state_at, position_at = MSR_OFFSETS["state"], CMD_OFFSETS["jnt_pos"]
        commanding = 0
        for count in range(packets):
            _, sender = self.socket.recvfrom_into(received)
            both = setpoint.unpack_from(received, MSR_OFFSETS["cmd_jnt_pos"])
            now = tuple(both[i] + both[i + 7] for i in range(7))
            if received[state_at] == 2:
                if self._start is None:
                    self._start = now
                commanding += 1
                self._steps += 1
                # From rest: one minus cosine, 0.3 Hz.
                moved = 0.15 * (1.0 - math.cos(2.0 * math.pi * 0.3 * self._steps * period_s))
                now = tuple(value + moved for value in self._start)
            head.pack_into(command, 0, count & 0xFFFF)
            command[2:4] = received[0:2]
            position.pack_into(command, position_at, *now)
            self.socket.sendto(command, sender)
        return commanding


def cpu_s(pid: int) -> float:
    """Processor time that a process has used [s]."""
    with open(f"/proc/{pid}/stat") as file:
        fields = file.read().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


@click.command()
@click.option("--periods", default="1,2,5", help="FRI cycles in ms, separated by commas.")
@click.option("--seconds", default=20.0, help="Virtual time measured at each.")
@click.option("--config", default="emulator/default.yaml")
@click.option("--two-cores", is_flag=True, help="Let the PC's end have a core of its own.")
def main(periods: str, seconds: float, config: str, two_cores: bool) -> None:
    if not two_cores:
        # Inherited by the emulator.
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    click.echo(
        "period     cycles  wall/cycle   x real time   cpu/cycle: emulator  client   x real time of both"
    )
    for period_ms in (int(text) for text in periods.split(",")):
        client = PlainClient()
        period_s = period_ms * 1e-3
        with EmulatorProcess(config, fri_port=client.port, period_ms=period_ms) as emulator:
            client.run(600, period_s)
            assert emulator.pid is not None
            packets = round(seconds / period_s)
            own, cpu, wall = time.process_time(), cpu_s(emulator.pid), time.perf_counter()
            commanding = client.run(packets, period_s)
            wall = time.perf_counter() - wall
            cpu, own = cpu_s(emulator.pid) - cpu, time.process_time() - own
            assert commanding == packets, emulator.status()["events"]
        last = np.frombuffer(client._received, MSR)[0]
        assert last["state"] == 2
        click.echo(
            f"{period_ms:4d} ms  {packets:7d}  {wall / packets * 1e6:8.0f} us  {seconds / wall:12.1f}"
            f"  {cpu / packets * 1e6:16.0f} us  {own / packets * 1e6:4.0f} us  {seconds / (cpu + own):20.1f}"
        )


if __name__ == "__main__":
    main()
