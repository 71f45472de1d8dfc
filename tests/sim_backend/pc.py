"""A PC's end of the link for the tests of the emulator: follows a trajectory whenever it may command."""

import contextlib
import threading

import numpy as np

from fri.handshake import StanfordHandshake
from fri.remote import RemoteEnd
from fri.states import Control
from sim_backend.configuration import load_configuration
from sim_backend.pendant import Pendant
from sim_backend.service import Service

QUICK = {"controller.settle_s": 0.2}


class Pc:
    """`run` answers packets; in command mode it sends `move(t)` added to where it began. Keeps what it
    received.
    """

    def __init__(self, port, move=None, restart=True):
        self.end = RemoteEnd("127.0.0.1", port)
        self.handshake = StanfordHandshake()
        self.move = move
        self.restart = restart
        self.measured = []
        self.states = []
        self.start = None
        self.k = 0
        self.stopped = False

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.end.close()

    def run(self, cycles, silence_s=3.0):
        """Answer until `cycles` packets were received; the number received, fewer if the link fell silent."""
        end = self.end
        for count in range(cycles):
            msr = end.receive(silence_s)
            if msr is None:
                return count
            self.measured.append(msr.tobytes())
            self.states.append(end.state)
            if end.commanding:
                if self.start is None:
                    self.start = (msr["cmd_jnt_pos"] + msr["cmd_jnt_pos_fri_offset"]).astype(float)
                    self.k = 0
                self.k += 1
                seconds = self.k * end.sample_time_s
                end.answer(self.start if self.move is None else self.start + self.move(seconds))
            else:
                if self.start is not None:
                    self.stopped = True
                self.start = None
                if self.stopped and not self.restart:
                    self.handshake.request_stop(end.command, end.msr)
                else:
                    self.handshake.request_start(end.command, end.msr, Control.POSITION)
                end.answer()
        return cycles


def gentle(seconds):
    """Smooth motion of all joints from rest, within every limit."""
    grown = min(1.0, seconds / 0.8)
    grown = grown**4 * (35 - 84 * grown + 70 * grown**2 - 20 * grown**3)
    return 0.08 * grown * np.sin(2 * np.pi * 0.4 * seconds) * np.ones(7)


@contextlib.contextmanager
def emulator(port, settings=None, seed=1, period_ms=2, config=None, lock_step=True):
    """An emulator in a thread of this process: far quicker to start than one of its own. Gives its
    pendant.
    """
    overrides = QUICK | {"seed": seed, "fri.period_ms": period_ms} | (settings or {})
    service = Service(load_configuration(config or "emulator/default.yaml", overrides), ("127.0.0.1", port))
    thread = threading.Thread(target=service.run, args=(lock_step,))
    thread.start()
    try:
        with Pendant(service.pendant.port) as pendant:
            yield pendant
    finally:
        service.stop()
        thread.join()
        service.close()
