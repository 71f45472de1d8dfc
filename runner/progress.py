"""How far an experiment has come, kept beside its logs so that an aborted one can go on."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from fri.errors import DataError
from runner.experiment_file import Payload
from runner.payload import Rest

__all__ = ["Progress"]

NAME = "progress.json"


@dataclass
class Progress:
    """Finished sessions with the arm's state at rest after each, and the uids of all attempts at each."""

    path: Path
    origin: Path | None = None
    finished: dict[str, dict[str, list[float]]] = field(default_factory=dict)
    attempts: dict[str, list[str]] = field(default_factory=dict)

    @classmethod
    def load(cls, folder: Path) -> Progress:
        """Progress of the experiment in `folder`, fresh where there is none; DataError where it is broken."""
        path = folder / NAME
        if not path.exists():
            return cls(path)
        try:
            content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
            origin = Path(content["origin"]) if content["origin"] else None
            return cls(path, origin, dict(content["finished"]), dict(content["attempts"]))
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise DataError(
                f"{path}: cannot be read: {error}; delete it to start the experiment anew"
            ) from error

    @classmethod
    def create(cls, folder: Path, origin: Path) -> Progress:
        """Begin the progress of an experiment whose file lies in `origin`, with the files that it names."""
        progress = cls(folder / NAME, origin)
        progress._save()
        return progress

    def rest(self, session: str, payload: Payload | None) -> Rest:
        """The arm at rest after a finished session."""
        entry = self.finished[session]
        return Rest(np.asarray(entry["q"]), np.asarray(entry["tau"]), payload)

    def begin(self, session: str, log: Path, uid: str) -> tuple[str, str]:
        """Count an attempt at a session; an earlier unfinished log is kept under a name of its own.

        Returns the uid of this attempt, which begins with `uid`, and that of the attempt before it or "".
        """
        earlier = self.attempts.setdefault(session, [])
        if log.exists():
            number = max(len(earlier), 1)
            while (kept := log.with_name(f"{log.stem}.attempt-{number}{log.suffix}")).exists():
                number += 1
            log.rename(kept)
        parent = earlier[-1] if earlier else ""
        earlier.append(f"{uid}-{len(earlier) + 1}")
        self._save()
        return earlier[-1], parent

    def finish(self, session: str, rest: Rest) -> None:
        """Mark a session as finished."""
        self.finished[session] = {"q": rest.q.tolist(), "tau": rest.tau.tolist()}
        self._save()

    def _save(self) -> None:
        content = {"origin": str(self.origin or ""), "finished": self.finished, "attempts": self.attempts}
        draft = self.path.with_suffix(".json.new")
        with draft.open("w", encoding="utf-8") as stream:
            json.dump(content, stream, indent=1)
            stream.flush()
            os.fsync(stream.fileno())
        draft.replace(self.path)
