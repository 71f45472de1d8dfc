"""A session log with its layout for Rerun."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from fri.errors import ConfigurationError
from runner import rerun_log


class Recorder:
    """Stands for rerun and rerun.blueprint: keeps the calls."""

    def __init__(self) -> None:
        self.calls: list[tuple[str, tuple[Any, ...], dict[str, Any]]] = []

    def __getattr__(self, name: str) -> Any:
        def call(*given: Any, **named: Any) -> str:
            self.calls.append((name, given, named))
            return name

        return call


def test_log_and_layout_go_to_one_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rerun = Recorder()
    monkeypatch.setattr(rerun_log, "_rerun", lambda module: rerun)
    log = tmp_path / "loaded.mcap"
    log.touch()
    rerun_log.open_log(log, tmp_path / "loaded.rrd")
    calls = {name: (given, named) for name, given, named in rerun.calls}
    assert calls["init"][1] == {"recording_id": "loaded", "spawn": False}
    assert calls["save"] == ((str(tmp_path / "loaded.rrd"),), {"default_blueprint": "Blueprint"})
    assert calls["log_file_from_path"][0] == (str(log),)
    shown = [named["contents"][0] for name, _, named in rerun.calls if name == "TimeSeriesView"]
    assert shown == ["/joint_states/effort", "/motor_states/effort", "/joint_states/position"]


def test_a_wrong_path_is_refused_before_anything_is_opened(tmp_path: Path) -> None:
    done = CliRunner().invoke(rerun_log.main, [str(tmp_path / "none.mcap")])
    assert done.exit_code == 1
    assert "no such log" in done.output
    (tmp_path / "log.mcap").touch()
    with pytest.raises(ConfigurationError, match=r"ends in \.rrd"):
        rerun_log.open_log(tmp_path / "log.mcap", tmp_path / "log.html")


def test_without_rerun_the_advice_is_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "rerun.blueprint", None)
    with pytest.raises(ConfigurationError, match="pip install 'rerun-sdk"):
        rerun_log.layout()
