"""Wrong channels: signs, units, gains, clocks and labels, checked before identification."""

from __future__ import annotations

from ident.screening.doubts import Doubt
from ident.screening.screen import require_sound, screen, without_dead

__all__ = ["Doubt", "require_sound", "screen", "without_dead"]
