from __future__ import annotations

from typing import cast

from ident.diagnosis.candidates import Candidate, Trial
from ident.diagnosis.evidence import Score
from ident.diagnosis.selection import _same_moment
from ident.effects import EFFECTS


def push(time: float, duration: float, session: float = 1.0) -> Trial:
    shape = {"time": time, "duration": duration, "session": session, "link": 5.0}
    return Trial(Candidate(EFFECTS["contact"], -1), shape, cast(Score, None), {})


def test_what_a_push_leaves_while_it_lasts_is_no_second_one() -> None:
    first = push(4.0, 1.0)
    assert _same_moment(push(4.4, 0.3), first)
    assert _same_moment(push(4.7, 0.3), first)
    assert not _same_moment(push(6.0, 0.3), first)
    assert not _same_moment(push(4.0, 1.0, session=2.0), first)
    load = Trial(
        Candidate(EFFECTS["payload_change"], -1), {"time": 4.0, "session": 1.0}, cast(Score, None), {}
    )
    assert not _same_moment(load, first)
