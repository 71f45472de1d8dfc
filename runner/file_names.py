"""Names of the files of results that several modules write or read."""

from __future__ import annotations

SUMMARY = "summary.json"
"""What a run did and found, in its folder."""
MODEL = "model.yaml"
"""The identified model, beside the summary."""
DIAGNOSIS = "diagnosis.json"
"""The findings, in the folder of a run or of a diagnosis of its own."""
DETAILS = "details.json"
"""What the pages show beyond the findings, beside them."""
DECISION = "decision.json"
"""The answers of discriminating experiments, beside the findings."""
