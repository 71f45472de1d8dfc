"""The table in the document is the stored result of the campaign."""

from __future__ import annotations

from pathlib import Path

from benchmarks.trust.__main__ import SECTIONS
from benchmarks.trust.table import Ledger

ROOT = Path(__file__).resolve().parents[2]


def test_results_in_the_document_are_those_of_the_campaign():
    ledger = Ledger(ROOT / "benchmarks/trust/results.json", 1)
    text = (ROOT / "docs/trust.md").read_text(encoding="utf-8")
    told = text.partition("<!-- results -->")[2].partition("<!-- end of results -->")[0]
    assert told.strip() == ledger.markdown(tuple(SECTIONS)).strip()
    assert {section for section, _ in ledger.lines} == set(SECTIONS)
