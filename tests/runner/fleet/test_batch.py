"""A small fleet: one arm wears, one gets another sensor, one a payload; the others are healthy."""

from __future__ import annotations

import datetime
import json
import logging
import shutil
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from playwright.sync_api import Browser

from ident.diagnosis import Reference
from ident.estimation.channel_errors import EXACT_CHANNELS
from ident.estimation.identification import IdentificationSettings
from ident.estimation.identify import identify
from ident.model.dynamic_model import DynamicModel
from ident.model.model_file import read_model
from lwr_driver.session import SessionWriter, session_metadata
from runner.cli import main
from runner.fleet import FleetStore, fleet_trend
from runner.fleet.batch import Order, _identified, _write_day
from runner.fleet.days import ArmDay, find_days
from runner.fleet.store import ArmStore
from tests.fleet import Event, Fleet
from tests.ident.estimation_arm import Sensors, chain, session
from tests.ident.known_arm import truth_model  # noqa: F401  fixture
from tests.runner.report.view_rig import CONTRAST, NARROW, WIDE, flaws, opened

pytestmark = pytest.mark.slow

ARMS, DAYS = 5, 9
EVENTS = (
    Event(1, "wear", 4, joint=2, size=0.12),
    Event(2, "sensor", 5, joint=3, size=1.0),
    Event(3, "payload", 6),
)


@pytest.fixture(scope="module")
def fleet(truth_model: DynamicModel, tmp_path_factory: pytest.TempPathFactory) -> Fleet:  # noqa: F811
    fleet = Fleet(truth_model, tmp_path_factory.mktemp("fleet") / "logs", EVENTS, rate_hz=100.0)
    for arm in range(ARMS):
        for day in range(DAYS - 1):
            fleet.record(arm, day)
    return fleet


@pytest.fixture(scope="module")
def store(fleet: Fleet) -> FleetStore:
    (fleet.folder / "arm_00" / "2026-03-02" / "broken.mcap").write_bytes(b"no log")
    found = batch(fleet)
    assert found.exit_code == 0, found.output
    assert "broken.mcap: left out" in found.stderr
    return FleetStore(fleet.folder.parent / "store")


def batch(fleet: Fleet, *options: str):  # type: ignore[no-untyped-def]
    store = str(fleet.folder.parent / "store")
    return CliRunner().invoke(
        main, ["batch", str(fleet.folder), "--store", store, "--diagnose", "none", *options]
    )


def test_changes_are_found_on_their_day_and_nobody_else_is_accused(store: FleetStore) -> None:
    arms = {arm.arm: arm for arm in fleet_trend(store).arms}
    assert {name for name, arm in arms.items() if arm.changes} == {"LWR4+_arm_01", "LWR4+_arm_02"}
    worn = arms["LWR4+_arm_01"].changes
    assert {one.change.name for one in worn} <= {"Fcm2", "Fvm2"}
    assert any(one.change.earliest <= one.change.time <= one.change.latest for one in worn)
    assert min(one.day for one in worn) in {"2026-03-04", "2026-03-05", "2026-03-06"}
    (sensor,) = arms["LWR4+_arm_02"].changes
    assert (sensor.change.name, sensor.day, sensor.change.course) == ("offl3", "2026-03-06", "step")
    assert sensor.change.difference == pytest.approx(1.0, abs=0.05)
    assert arms["LWR4+_arm_03"].new_payloads == {"load": "2026-03-07"}


def test_a_further_day_is_the_only_work_and_copies_are_known(fleet: Fleet, store: FleetStore) -> None:
    before = {arm.name: arm.days() for arm in store.arms()}
    (path,) = fleet.record(0, DAYS - 1)
    (path.parent / "copy.mcap").write_bytes(path.read_bytes())
    found = batch(fleet, "--json")
    content = json.loads(found.stdout)
    assert [(one["arm"], one["day"]) for one in content["done"]] == [("LWR4+_arm_00", "2026-03-09")]
    assert len(content["repeated"]) == 1
    after = {arm.name: arm.days() for arm in store.arms()}
    assert after["LWR4+_arm_00"] == (*before["LWR4+_arm_00"], "2026-03-09")
    assert json.loads(batch(fleet, "--json").stdout)["done"] == []


def test_recordings_with_one_uid_are_no_copies(tmp_path: Path) -> None:
    for day in (1, 2):
        place = tmp_path / f"2026-03-0{day}"
        place.mkdir()
        stamps = np.arange(100) * 2_000_000 + day * 10**15
        metadata = session_metadata(robot="LWR4+", uid="one")
        with SessionWriter(place / "unloaded.mcap", ("A1",), metadata, start_ns=int(stamps[0])) as writer:
            writer.write_joint_states(stamps, np.zeros((100, 1)), np.zeros((100, 1)), publish_time=stamps)
    (tmp_path / "copy").mkdir()
    shutil.copy(tmp_path / "2026-03-01" / "unloaded.mcap", tmp_path / "copy")
    found = find_days([tmp_path])
    assert [day.day.isoformat() for day in found.days] == ["2026-03-01", "2026-03-02"]
    assert [path.parent.name for path in found.repeated] == ["copy"]


def test_a_task_leaves_the_loggers_of_its_process_as_they_were(tmp_path: Path) -> None:
    logger = logging.getLogger("ident")
    before = logger.level
    logger.setLevel(logging.INFO)
    day = ArmDay("arm", datetime.date(2026, 3, 1), (), 1)
    try:
        (told,) = _identified(tmp_path, day, Order(IdentificationSettings()))
        assert told.error == "no usable log"
        assert logger.level == logging.INFO
    finally:
        logger.setLevel(before)


def test_a_day_keeps_deviations_without_the_errors_of_the_channels(tmp_path: Path) -> None:
    settings = IdentificationSettings(model=1, essential=None)
    found = identify([session(motor=False, sensors=Sensors(joint=0.2))], chain(), settings)
    arm = ArmStore(tmp_path / "arm")
    _write_day(arm, ArmDay("arm", datetime.date(2026, 3, 1), ()), found)
    stored = {row["name"]: row["std"] for row in arm.read("parameters")}
    exact = found.estimate.covariances[EXACT_CHANNELS].std
    assert [stored[name] for name in found.base.names] == exact.tolist()
    assert np.all(exact < found.estimate.std)


def test_the_model_of_all_days_comes_from_the_factors_alone(fleet: Fleet, store: FleetStore) -> None:
    arm = store.arm("LWR4+_arm_04")
    model = read_model(arm.together)
    truth = np.mean([fleet.model(4, day).values for day in range(DAYS - 1)], axis=0)
    known = dict(zip(fleet.truth.names, truth, strict=True))
    std = dict(zip(model.names, np.sqrt(np.diag(model.covariance)), strict=True))
    z = np.array(
        [(v - known[n]) / std[n] for n, v in zip(model.names, model.values, strict=True) if n in known]
    )
    assert np.sqrt(np.mean(z**2)) < 2.5
    assert std["Fcm2"] / abs(known["Fcm2"]) > 0.003  # friction differs from day to day


def test_tables_are_read_by_pandas(store: FleetStore) -> None:
    pandas = pytest.importorskip("pandas")
    table = pandas.read_parquet(store.folder / "LWR4+_arm_00" / "parameters")
    assert set(table.columns) == {"arm", "day", "part", "name", "unit", "value", "std"}
    assert table.groupby("day").size().nunique() == 1


def test_trend_prints_and_writes_a_page(store: FleetStore, tmp_path: Path) -> None:
    page = tmp_path / "arm.html"
    found = CliRunner().invoke(
        main, ["trend", "LWR4+_arm_02", "--store", str(store.folder), "--out", str(page)]
    )
    assert found.exit_code == 0, found.output
    assert "offl3 since 2026-03-06" in found.output
    assert "offl3 since 2026-03-06" in page.read_text()
    whole = CliRunner().invoke(
        main, ["trend", "--store", str(store.folder), "--out", str(tmp_path / "all.html")]
    )
    assert "of 5 arms without a change" in whole.output
    unknown = CliRunner().invoke(main, ["trend", "nobody", "--store", str(store.folder)])
    assert unknown.exit_code == 2
    assert "LWR4+_arm_02" in unknown.output


def test_the_pages_of_a_trend_are_accessible_and_fit(
    store: FleetStore, tmp_path: Path, chrome: Browser
) -> None:
    for name, arm in (("fleet", []), ("arm", ["LWR4+_arm_02"])):
        page = tmp_path / f"{name}.html"
        done = CliRunner().invoke(main, ["trend", *arm, "--store", str(store.folder), "--out", str(page)])
        assert done.exit_code == 0, done.output
        with opened(chrome, page, NARROW) as seen:
            for width, height in (NARROW, WIDE):
                seen.page.set_viewport_size({"width": width, "height": height})
                assert seen.page.evaluate(CONTRAST) >= 4.5
                assert flaws(seen) == []


def test_days_are_diagnosed_against_the_healthy_days_before(
    truth_model: DynamicModel,  # noqa: F811
    tmp_path: Path,
) -> None:
    fleet = Fleet(truth_model, tmp_path / "logs", (Event(0, "wear", 2, joint=2, size=0.5),), rate_hz=100.0)
    for day in range(3):
        fleet.record(0, day)
    folder = tmp_path / "store"
    options = ["--store", str(folder), "--diagnose", "all", "--reference-days", "2"]
    assert CliRunner().invoke(main, ["batch", str(fleet.folder), *options]).exit_code == 0
    (store,) = FleetStore(folder).arms()
    reference = Reference.of(read_model(store.reference))
    assert reference.sets == 2
    assert reference.null
    assert reference.noise
    (found,) = store.read("findings")
    assert (found["cause"], found["joints"]) == ("wear", "2")
