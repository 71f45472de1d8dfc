"""The diagnosis under test, called as a program would call it: sessions and a healthy reference in, its own
file's content out. Nothing of a case but its logs goes in.
"""

from __future__ import annotations

import dataclasses
import tempfile
import time
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

from ident.diagnosis import ArmData, Reference, commission, diagnose
from ident.dynamics.kinematics import Chain
from ident.model.model_file import read_model, write_model
from lwr_driver.arm import Arm
from lwr_driver.session import read_session
from tests.hidden_physics.cases import Case, Sessions, Store, twin
from tests.hidden_physics.motions import SCHEDULES
from tests.hidden_physics.robots import Day, Encoder

__all__ = ["COMMISSIONING_DAYS", "REFERENCE", "commissioned", "diagnosed", "healthy_sets"]

COMMISSIONING_DAYS = 12
_FIRST_DAY, _ERA_DAYS = 5000, 100

REFERENCE = Path(__file__).parent / "reference.yaml"
"""The healthy arm with the link encoder, commissioned once: `python -m tests.hidden_physics.engine`."""


@cache
def _arm() -> tuple[Chain, ArmData]:
    arm = Arm.load()
    return Chain.from_urdf(arm.urdf), ArmData(arm.stiffness, arm.gear_ratio)


def healthy_sets(
    encoder: Encoder, days: int, schedules: Sequence[str] = SCHEDULES, era: int = 0
) -> list[Case]:
    """Healthy days to commission the arm on, each with the motions of one schedule."""
    first = _FIRST_DAY + _ERA_DAYS * era
    return [twin(schedules[number % len(schedules)], Day(first + number, encoder)) for number in range(days)]


def commissioned(
    store: Store,
    encoder: Encoder,
    days: int = COMMISSIONING_DAYS,
    schedules: Sequence[str] = SCHEDULES,
    *,
    folder: Path | None = None,
) -> Path:
    """Reference of the healthy arm as a model file, made once a folder, that of the store by default."""
    path = (folder or store.folder) / f"reference_{encoder}_{''.join(schedules)}_{days}.yaml"
    if path.is_file():
        return path
    chain, data = _arm()
    sets = []
    for case in healthy_sets(encoder, days, schedules, store.era):
        sets.append([read_session(path) for path in store.train(case)])
    reference = commission(sets, chain, arm=data)
    model = reference.model
    model = dataclasses.replace(model, provenance={**model.provenance, **reference.stored()})
    write_model(model, path)
    return path


def diagnosed(sessions: Sessions, reference: Path | None) -> tuple[dict[str, Any], float]:
    """Content of `diagnosis.json` with the doubted names, and the processor time that it took [s], reading the logs
    included."""
    chain, data = _arm()
    began = time.process_time()
    result = diagnose(
        [read_session(path) for path in sessions.train],
        chain,
        test=[read_session(path) for path in sessions.test],
        arm=data,
        reference=None if reference is None else Reference.of(read_model(reference)),
    )
    doubted = [finding.to_dict() for finding in result.doubted]
    return {**result.to_dict(), "doubted": doubted}, time.process_time() - began


def main() -> None:
    """Commission the arm anew, with 4 healthy days, and keep the reference beside this file."""
    with tempfile.TemporaryDirectory() as folder:
        REFERENCE.write_bytes(commissioned(Store(Path(folder)), "link", 4).read_bytes())


if __name__ == "__main__":
    main()
