"""Load data over the link, to the KRL program of this project."""

from __future__ import annotations

import pytest

from fri.errors import ConfigurationError, RefusedError, RobotError
from lwr_driver.control import Job, Word
from lwr_driver.driver import Driver, LinkSettings
from runner.experiment_file import Payload
from runner.laboratory import free_port
from runner.preflight import load_data
from sim_backend.process import EmulatorProcess
from tests.lwr_driver.driver_rig import arm


def test_load_data_reach_the_controller_and_too_heavy_ones_do_not() -> None:
    port = free_port("127.0.0.1")
    settings = {"fri.program": "lwr_identification", "fri.period_ms": 5}
    link = LinkSettings(address="127.0.0.1", port=port, lock_step=True, handshake="lwr_identification")
    payload = Payload("block", 3.34, (0.0, -0.066, 0.144), (0.01, 0.0, 0.0, 0.02, 0.0, 0.03))
    with (
        EmulatorProcess(fri_port=port, settings=settings, hosting=True) as emulator,
        Driver(arm(), link, host=emulator.host) as driver,
    ):
        driver.connect()
        driver.set_load(*load_data(arm(), payload))
        load = emulator.status()["load"]
        assert load["mass"] == pytest.approx(3.34)
        assert load["com"] == pytest.approx([0.0, -0.066, 0.144], abs=1e-6)
        assert load["inertia"] == pytest.approx([0.01, 0.0, 0.0, 0.02, 0.0, 0.03])
        with pytest.raises(ConfigurationError, match=r"mass 20 kg is outside 0 to 14 kg"):
            driver.set_load(20.0)
        with pytest.raises(ConfigurationError, match=r"looks like mm, write \[0, -0.066, 0.144\]"):
            driver.set_load(3.34, (0.0, -66.0, 144.0))
        assert emulator.status()["load"]["mass"] == pytest.approx(3.34)
        driver.set_load(*load_data(arm(), None))
        assert emulator.status()["load"]["mass"] == 0.0
        driver.wait_quality()
        driver.enter_command()
        with pytest.raises(RobotError, match="cannot change in mode hold"):
            driver.set_load(1.0)


def test_no_command_mode_with_other_load_data_than_announced() -> None:
    port = free_port("127.0.0.1")
    settings = {"fri.program": "lwr_identification", "fri.period_ms": 5}
    link = LinkSettings(address="127.0.0.1", port=port, lock_step=True, handshake="lwr_identification")
    with (
        EmulatorProcess(fri_port=port, settings=settings, hosting=True) as emulator,
        Driver(arm(), link, host=emulator.host) as driver,
    ):
        driver.connect()
        driver.wait_quality()
        driver.expect_load(0.0)
        emulator.pendant.set_load(2.0, (0.0, 0.0, 0.178))
        driver.monitor(20)
        with pytest.raises(RefusedError, match=r"2 kg at \(0, 0, 100\) mm.*announced: none.*pendant"):
            driver.enter_command()
        # It was not even asked for.
        assert driver._need(driver._control).words[Word.JOB] == Job.CYCLES
        # Changed on the way to command mode: it is left again.
        emulator.pendant.set_load(0.0)
        driver.monitor(20)
        emulator.pendant.schedule("set_load", after_cycles=2, mass=2.0, com=[0.0, 0.0, 0.1])
        with pytest.raises(RefusedError, match="2 kg"):
            driver.enter_command()
        assert driver.state().mode == "mirror"
        emulator.pendant.set_load(0.0)
        driver.monitor(20)
        driver.enter_command()


def test_other_programs_take_none() -> None:
    driver = Driver(arm(), LinkSettings(address="127.0.0.1", handshake="stanford"))
    assert not driver.sets_load
    with pytest.raises(ConfigurationError, match="takes no load data; enter them at the pendant"):
        driver.set_load(1.0)
