"""What was hidden in the emulated arm, as a part of the report."""

from __future__ import annotations

from html import escape

from ident.diagnosis.outcome.claims_in_words import capital
from runner.hiding.reveal import revealed
from runner.report.folder import ResultFolder
from runner.report.markup import Cell, paragraph, section, table


def hidden_section(results: ResultFolder) -> str:
    """Whether something was hidden in the emulated arm, and once revealed, what."""
    state = results.summary.get("hidden")
    if state is None:
        return ""
    if state == "sealed":
        shown = revealed(results.path)
        if shown is not None:
            rows: list[list[Cell]] = [list(row) for row in shown.rows()]
            head = ("parameter", "truth", "found", "error / std")
            parts = [paragraph(f"{capital(text)}.") for text in (shown.truth, shown.verdict)]
            label = "Hidden effect, truth and finding"
            return section("hidden", "The hidden effect", *parts, table(head, rows, label))
        return section(
            "hidden",
            "The hidden effect",
            paragraph(
                "An effect is hidden in the emulated arm. The diagnosis below says what can be found of it."
            ),
            f"<p><code>lwr-run experiment --reveal {escape(results.path.name)}</code> shows the truth beside it, here "
            "as well. Until then the true parameters of the arm are left out of this report.</p>",
        )
    if state == "nothing":
        text = (
            "Nothing was hidden in the emulated arm: what is found here is a property of the emulated arm itself, or a "
            "false finding."
        )
    else:
        text = "The emulator's settings name effects beyond the model (robot.effects): the diagnosis may find them."
    advice = (
        "<p><code>lwr-run experiment --hide SEED</code> hides an effect, to be found by the diagnosis.</p>"
    )
    return section("hidden", "Hidden effects", paragraph(text), advice)
