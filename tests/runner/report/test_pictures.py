"""The pictures of the documents, as `make screenshot` takes them."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import Browser

ROOT = Path(__file__).parents[3]


@pytest.fixture
def take() -> ModuleType:
    spec = importlib.util.spec_from_file_location("take", ROOT / "docs/images/take.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_without_a_folder_the_default_experiment_is_run(
    take: ModuleType, finished: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    commands: list[list[str]] = []
    taken: list[Any] = []

    def run(command: list[str], **named: Any) -> None:
        commands.append(command)
        Path(command[-1]).symlink_to(finished)

    monkeypatch.setattr(take.subprocess, "run", run)
    monkeypatch.setattr(take.shutil, "which", lambda name: name)
    monkeypatch.setattr(take, "preview_html", lambda planned: planned.title)
    monkeypatch.setattr(take, "take", lambda *arguments: taken.append(arguments))
    monkeypatch.setattr(take, "take_replay", lambda *arguments: taken.append(arguments))
    monkeypatch.setattr(take, "sync_playwright", lambda: MagicMock())
    take.main([])
    assert commands == [[sys.executable, "-m", "runner.cli", "experiment", "--yes", "--out", commands[0][-1]]]
    _, report, _, target = taken[0]
    assert (report.name, target) == ("report.html", ROOT / "docs/images")
    assert taken[1][2] == target


@pytest.mark.long
def test_the_pictures_are_not_blank(
    take: ModuleType, finished: Path, chrome: Browser, tmp_path: Path
) -> None:
    preview = tmp_path / "preview.html"
    preview.write_text(take.preview_html(take.planned_motion(str(finished))), encoding="utf-8")
    take.take(chrome, finished / "report.html", preview, tmp_path)
    for name in ("report.png", "report_torque.png", "preview.png"):
        pixels = np.asarray(Image.open(tmp_path / name).convert("RGB")).reshape(-1, 3)
        assert len(np.unique(pixels, axis=0)) > 100, name
