"""Largest motions and planning jobs that a file may ask for; more would take hours, or more memory than there is."""

from __future__ import annotations

from typing import Annotated

from fri.quantities import within

LONGEST_EXCITATION_S = 1200.0
"""Longest exciting motion of a session [s]."""

Period = Annotated[float, within(0.5, 120.0, "s")]
Harmonics = Annotated[int, within(2, 30, note="rest at both ends needs two")]
Periods = Annotated[int, within(1, 1000)]
