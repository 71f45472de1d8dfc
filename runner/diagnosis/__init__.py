"""The diagnosis of sessions and experiments: gains, files, plots, look-alikes, discriminating experiments."""

from __future__ import annotations

from typing import TYPE_CHECKING

from fri.on_first_use import on_first_use

if TYPE_CHECKING:
    from runner.diagnosis.study import Study, arm_data, asked, chain_of, study

__all__ = ["Study", "arm_data", "asked", "chain_of", "study"]

# A report needs the files of a diagnosis, not the planner of its experiments.
__getattr__, __dir__ = on_first_use(globals(), {".study": __all__})
