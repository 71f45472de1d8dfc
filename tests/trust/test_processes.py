"""The sections of the campaign that need processes, each with a few runs."""

from __future__ import annotations

import importlib
from dataclasses import dataclass

import pytest

from benchmarks.trust.__main__ import SECTIONS
from benchmarks.trust.table import Ledger


@dataclass(frozen=True)
class Options:
    seed: int = 5
    runs: int | None = 1
    seconds: float | None = 5.0
    only: int | None = None
    lines: str = ""
    periods_ms: tuple[int, ...] = (5,)
    say: object = print


def test_every_section_exists():
    for section in SECTIONS:
        assert callable(importlib.import_module(f"benchmarks.trust.{section}").campaign)


@pytest.mark.slow
def test_network_promises_hold():
    ledger = Ledger(None, 5)
    importlib.import_module("benchmarks.trust.network").campaign(ledger, Options())
    assert ledger.failed == 0, [line.failures for line in ledger.lines.values()]


@pytest.mark.long
@pytest.mark.parametrize("section", ["computer", "robot", "soak", "reaction", "clients"])
def test_a_few_runs_of_a_section(section):
    ledger = Ledger(None, 5)
    importlib.import_module(f"benchmarks.trust.{section}").campaign(ledger, Options())
    assert ledger.failed == 0, [line.failures for line in ledger.lines.values()]


def test_a_broken_off_campaign_goes_on(tmp_path):
    path = tmp_path / "trust.json"
    first = Ledger(path, 1)
    first.line("wire", "loss").count(["outside the limits"], "run 3")
    first.finish("wire", "0+200")
    again = Ledger(path, 1)
    assert again.has("wire", "0+200")
    assert not again.has("wire", "200+200")
    assert (again.line("wire", "loss").runs, again.failed) == (1, 1)
    assert "loss" in again.table("wire")
    other = Ledger(None, 1)
    other.line("computer", "Ctrl-C").count([])
    other.finish("computer", "Ctrl-C 0")
    again.join(other)
    assert again.has("computer", "Ctrl-C 0")
    with pytest.raises(SystemExit, match="computer Ctrl-C"):
        again.join(other)
    again.forget("wire")
    assert not again.has("wire", "0+200")
    with pytest.raises(SystemExit, match="seed 1"):
        Ledger(path, 2)
