"""Writes the tables of causes in docs/effects.md anew from `ident.effects`: python docs/effects_table.py."""

from __future__ import annotations

from pathlib import Path

from ident.effects import EFFECTS, Effect

PAGE = Path(__file__).with_name("effects.md")
MARK = "Joints are numbered 1 to 7 from the base.\n"
SIDES = {
    "motor": "In the drive: seen in the motor torque only",
    "joint": "On the link side: seen in both torques",
    "sensor": "In the joint torque sensor",
    "timing": "In the timing",
}


def row(name: str, effect: Effect) -> str:
    """One cause as a row of its table."""
    shown = [p for p in effect.parameters if p.name not in effect.hidden]
    parameters = ", ".join(f"{p.name} [{p.unit}]" if p.unit != "1" else p.name for p in shown)
    named = [*(["none"] if effect.plain else []), *(form.value for form in effect.known_forms)]
    forms = f"; form: {', '.join(named)}" if named else ""
    alike = ", ".join(f"`{cause}`" for cause in effect.confused_with)
    decides = effect.tell_apart.replace("joint {joint}", "the joint").replace("{joint}", "the joint")
    return f"| `{name}` | {effect.physics} | {parameters}{forms} | {alike} | {decides} |"


def tables() -> str:
    """All tables, side by side of the arm."""
    parts = []
    for side, title in SIDES.items():
        rows = [row(name, effect) for name, effect in EFFECTS.items() if effect.side == side]
        titles = ("cause", "physics", "parameters", "looks like", "discriminating experiment")
        head = f"| {' | '.join(titles)} |\n|{' --- |' * len(titles)}"
        parts.append(f"### {title}\n\n{head}\n" + "\n".join(rows) + "\n")
    return "\n".join(parts)


if __name__ == "__main__":
    text = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(text[: text.index(MARK) + len(MARK)] + "\n" + tables(), encoding="utf-8")
