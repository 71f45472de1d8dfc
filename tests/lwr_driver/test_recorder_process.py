from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from fri.errors import ConfigurationError, DataError
from lwr_driver.recorder import Recorder, SessionRequest
from lwr_driver.ring import Ring
from lwr_driver.session import read_session
from lwr_driver.session.motor_torque import KrlMotorTorque
from tests.lwr_driver.session.session_samples import EPOCH, JOINTS, METADATA, URDF, rows

PATIENCE_S = 60.0


@pytest.fixture
def ring():
    with Ring.create(1024) as ring:
        yield ring


@pytest.fixture
def recorder(ring):
    with Recorder(ring) as recorder:
        yield recorder


def request(path, **options):
    options = {"virtual_epoch_ns": EPOCH, "phase_names": ("hold", "brake", "settle", "excitation"), **options}
    return SessionRequest(path, JOINTS, METADATA, **options)


def wait_until(condition):
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline
        os.sched_yield()


def publish(ring, data):
    for row in data:
        wait_until(lambda: ring.free > 0)
        ring.row[0] = row
        assert ring.publish()


def failure(recorder):
    """What `check` raises, once it does."""
    caught = []

    def raised():
        try:
            recorder.check()
        except DataError as error:
            caught.append(error)
        return caught

    wait_until(raised)
    return str(caught[0])


def test_sessions_one_after_the_other(tmp_path, ring, recorder):
    data = rows(3000)
    publish(ring, data[:100])
    recorder.open(request(tmp_path / "a.mcap", robot_description=URDF, motor_torque=KrlMotorTorque()))
    publish(ring, data[100:1600])
    first = recorder.close("success")
    publish(ring, data[1600:1700])
    recorder.open(request(tmp_path / "b.mcap"))
    publish(ring, data[1700:])
    second = recorder.close("abort", "the operator pressed Ctrl-C")
    recorder.check()
    assert (first.samples, first.exit_status, first.overruns) == (1500, "success", 0)
    assert (second.samples, second.exit_status) == (1300, "abort")
    for name, part in (("a.mcap", data[100:1600]), ("b.mcap", data[1700:])):
        session = read_session(tmp_path / name)
        np.testing.assert_array_equal(session.joint.position, part["msr"]["msr_jnt_pos"])
        np.testing.assert_array_equal(session.joint.sequence, part["sequence"])
        assert not session.missing.samples.get("/joint_states")
    assert read_session(tmp_path / "b.mcap").end["reason"] == "the operator pressed Ctrl-C"


def test_lock_step_gives_equal_files(tmp_path, ring, recorder):
    data = rows(1500)
    for name in ("a.mcap", "b.mcap"):
        recorder.open(request(tmp_path / name, robot_description=URDF, motor_torque=KrlMotorTorque()))
        publish(ring, data)
        recorder.close("success")
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()


def test_close_up_to_a_row(tmp_path, ring, recorder):
    data = rows(500)
    recorder.open(request(tmp_path / "a.mcap"))
    publish(ring, data)
    assert recorder.close("success", upto=ring.head).samples == 500
    with pytest.raises(DataError, match="no session is open"):
        recorder.close()


def test_file_that_cannot_be_created_is_an_error_of_the_caller(tmp_path, recorder):
    (tmp_path / "a.mcap").write_bytes(b"")
    with pytest.raises(ConfigurationError, match="exists already"):
        recorder.open(request(tmp_path / "a.mcap"))
    with pytest.raises(ConfigurationError, match="cannot be created"):
        recorder.open(request(tmp_path / "nowhere" / "a.mcap"))
    recorder.open(request(tmp_path / "b.mcap"))
    with pytest.raises(DataError, match="is still open"):
        recorder.open(request(tmp_path / "c.mcap"))


def test_robot_description_that_is_no_xml(tmp_path, recorder):
    with pytest.raises(ConfigurationError, match="robot description is not XML"):
        recorder.open(request(tmp_path / "a.mcap", robot_description="<robot>"))


def test_phases_named_in_the_open_session(tmp_path, ring, recorder):
    recorder.open(request(tmp_path / "a.mcap"))
    number = recorder.add_phases(["period 1"])
    data = rows(10)
    data["phase"] = number
    publish(ring, data)
    recorder.close()
    assert [phase.name for phase in read_session(tmp_path / "a.mcap").phases] == ["period 1"]


def test_killed_recorder_loses_half_a_second_at_most(tmp_path, ring):
    data = rows(2300)
    with Recorder(ring) as recorder:
        recorder.open(request(tmp_path / "a.mcap"))
        publish(ring, data)
        wait_until(lambda: recorder.lag == 0)
        os.kill(recorder.pid, signal.SIGKILL)
        message = failure(recorder)
        with pytest.raises(DataError, match="was killed by signal 9"):
            recorder.close()
    assert "was killed by signal 9" in message
    assert "lwr-run recover" in message
    session = read_session(tmp_path / "a.mcap")
    assert len(session.joint) >= 2300 - 500
    np.testing.assert_array_equal(session.joint.position, data["msr"]["msr_jnt_pos"][: len(session.joint)])


WRITER = """
import os, sys
from tests.lwr_driver.session.session_samples import rows
from lwr_driver.ring import Ring
ring = Ring.attach({name!r})
ring.start_writing()
for row in rows(700):
    ring.row[0] = row
    assert ring.publish()
print("done", flush=True)
sys.stdin.read()
"""


def writer(ring):
    code = WRITER.format(name=ring.name)
    return subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE)


def test_death_of_the_loop_ends_the_session(tmp_path, ring, recorder):
    recorder.open(request(tmp_path / "a.mcap"))
    loop = writer(ring)
    loop.stdout.readline()
    os.kill(loop.pid, signal.SIGKILL)  # not reaped: a zombie is dead, too
    message = failure(recorder)
    with pytest.raises(DataError, match=r"the FRI loop .* died"):
        recorder.add_phases(["too late"])
    recorded = recorder.close("success")
    loop.communicate()
    assert f"the FRI loop (process {loop.pid}) died" in message
    assert (recorded.exit_status, recorded.samples) == ("fail", 700)
    end = read_session(tmp_path / "a.mcap").end
    assert end["exit_status"] == "fail"
    assert "died" in end["reason"]


def test_silent_loop_ends_the_session(tmp_path, ring):
    with Recorder(ring, heartbeat_timeout_s=5.0) as recorder:
        recorder.open(request(tmp_path / "a.mcap"))
        publish(ring, rows(20))
        ring.start_writing()
        ring.beat(time.monotonic_ns() - 6 * 10**9)
        assert "has given no sign of life for 6" in failure(recorder)
        assert recorder.close().samples == 20


def test_silence_in_lock_step_is_no_fault(tmp_path, ring):
    with Recorder(ring, heartbeat_timeout_s=None) as recorder:
        recorder.open(request(tmp_path / "a.mcap"))
        ring.start_writing()
        ring.beat(1)
        publish(ring, rows(20))
        wait_until(lambda: recorder.lag == 0)
        assert recorder.close().exit_status == "success"


def test_loop_that_ends_on_purpose_is_no_fault(tmp_path, ring, recorder):
    recorder.open(request(tmp_path / "a.mcap"))
    ring.start_writing()
    publish(ring, rows(20))
    ring.stop_writing()
    assert recorder.close().exit_status == "success"


def test_interrupt_does_not_reach_the_recorder(tmp_path, ring, recorder):
    recorder.open(request(tmp_path / "a.mcap"))
    os.kill(recorder.pid, signal.SIGINT)
    publish(ring, rows(50))
    assert recorder.close().samples == 50


def test_termination_ends_the_session_in_order(tmp_path, ring, recorder):
    recorder.open(request(tmp_path / "a.mcap"))
    publish(ring, rows(50))
    wait_until(lambda: recorder.lag == 0)
    os.kill(recorder.pid, signal.SIGTERM)
    assert "SIGTERM" in failure(recorder)
    session = read_session(tmp_path / "a.mcap")
    assert len(session.joint) == 50
    assert session.end["exit_status"] == "fail"


ABANDON = """
import os, signal, sys
from tests.lwr_driver.session.session_samples import rows
from tests.lwr_driver.test_recorder_process import request, publish
from lwr_driver.recorder import Recorder
from lwr_driver.ring import Ring
from pathlib import Path
ring = Ring.create(1024)
recorder = Recorder(ring)
recorder.open(request(Path({path!r})))
publish(ring, rows(640))
print(recorder.pid, flush=True)
os.kill(os.getpid(), signal.SIGKILL)
"""


def state(pid):
    """Letter of the process state, empty if there is no such process."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return ""


def gone(pid):
    return state(pid) in ("", "Z")


def test_recorder_outlives_its_parent_only_to_end_the_session(tmp_path):
    path = tmp_path / "a.mcap"
    code = ABANDON.format(path=str(path))
    process = subprocess.run([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
    wait_until(lambda: gone(int(process.stdout)))
    session = read_session(path)
    assert len(session.joint) == 640
    assert session.end["exit_status"] == "fail"
    assert session.end["reason"] == "the process that drove the experiment died"


def test_stalled_recorder_costs_rows_that_are_counted(tmp_path, ring, recorder):
    recorder.open(request(tmp_path / "a.mcap"))
    data = rows(1500)
    os.kill(recorder.pid, signal.SIGSTOP)
    wait_until(lambda: state(recorder.pid) == "T")
    for row in data[:1400]:
        ring.row[0] = row
        ring.publish()
    os.kill(recorder.pid, signal.SIGCONT)
    publish(ring, data[1400:])
    recorded = recorder.close()
    session = read_session(tmp_path / "a.mcap")
    assert recorded.overruns == 1400 - 1024
    assert recorded.missed == session.joint.lost == 1400 - 1024
    assert session.end["overruns"] == str(1400 - 1024)


def test_stop_leaves_no_process_and_says_why_the_session_ended(tmp_path, ring):
    recorder = Recorder(ring)
    recorder.open(request(tmp_path / "a.mcap"))
    publish(ring, rows(10))
    recorder.stop()
    recorder.stop()
    assert gone(recorder.pid)
    end = read_session(tmp_path / "a.mcap").end
    assert (end["exit_status"], end["samples"]) == ("fail", "10")
    assert "stopped before the session was closed" in end["reason"]


def test_full_disk_is_reported_and_ends_the_session(tmp_path, ring, recorder):
    recorder.open(request(tmp_path / "a.mcap"))
    resource.prlimit(recorder.pid, resource.RLIMIT_FSIZE, (200_000, resource.RLIM_INFINITY))
    publish(ring, rows(2500))
    assert "cannot be written beyond byte" in failure(recorder)
    recorded = recorder.close("success")
    assert recorded.exit_status == "fail"
    assert "cannot be written beyond byte" in recorded.reason
    session = read_session(tmp_path / "a.mcap")
    assert len(session.joint) == recorded.samples > 0
    resource.prlimit(recorder.pid, resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    recorder.open(request(tmp_path / "b.mcap"))
    publish(ring, rows(100))
    assert recorder.close("success").samples == 100
    recorder.check()


def test_recorder_imports_nothing_heavy():
    heavy = "{'pinocchio', 'scipy', 'numba', 'ruckig'}"
    code = f"import sys, lwr_driver.recorder; print(*{heavy} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == ""
