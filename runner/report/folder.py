"""Results of an experiment, read from its folder, with measured and computed torque of each session."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from fri.errors import ConfigurationError, DataError, LwrError
from ident.dynamics.structure import Side
from ident.estimation.scores import Predictor, Score, SessionScore, score_session
from ident.estimation.validate import mounted, predictor, prepared_session, signals_for
from ident.model import DynamicModel
from ident.model.model_file import read_model
from ident.rows.filters import ParallelFilter, SignalSettings, median_step
from ident.rows.prepared import Passage
from lwr_driver.session import Session, read_session
from lwr_driver.session.spool import spans, stored, stored_together
from runner.file_names import DIAGNOSIS, MODEL, SUMMARY
from runner.published import is_published_arm

Floats = NDArray[np.float64]

_ATTENUATION_DB = 40.0
_RATE_PER_CUTOFF = 2.5
_COLUMNS = ("time", "torque", "error", "q", "qd", "grid", "measured", "computed")


@dataclass(frozen=True, eq=False)
class Curves:
    """One session and side (`joint`, `motor`, `difference`), over the span of the estimate.

    joint_names : n joints. payload : name, None for the bare arm.
    time (m,) [s], torque, error, q, qd (m, n) : every sample as logged [Nm]; error is measured minus computed.
    raw_velocity : (m, n) differences of the logged positions [rad/s]; empty (m, 0) on the motor side.
    grid (k,) [s], measured, computed (k, n) : torque and its prediction, both through the same low-pass [Nm].
    cutoff_hz : of the low-pass. whole : the computed-torque test of the session. unseen : held-out session.
    """

    session: str
    file: str
    side: Side
    payload: str | None
    joint_names: tuple[str, ...]
    cutoff_hz: float
    time: Floats
    torque: Floats
    error: Floats
    q: Floats
    qd: Floats
    raw_velocity: Floats
    grid: Floats
    measured: Floats
    computed: Floats
    whole: SessionScore
    unseen: bool = False

    @property
    def label(self) -> str:
        """Session and side in words."""
        return f"{self.session}, {self.side} torque{', held out' if self.unseen else ''}"

    @property
    def scores(self) -> tuple[Score, ...]:
        """The test by joint."""
        return tuple(score for score in self.whole.scores if score.side == self.side)

    @property
    def relative(self) -> float:
        """The torque error of all joints."""
        return float(self.whole.relative[self.side])


def curves(
    model: DynamicModel,
    session: Session,
    name: str,
    *,
    settings: SignalSettings | None = None,
    unseen: bool = False,
) -> list[Curves]:
    """Curves of a session for each side common to model and session.

    settings : of the signals; default those of the model. unseen : held out.
    """
    payload = mounted(model, session)
    prepared = prepared_session(model, session, settings, blocks=not model.remembers)
    predict = predictor(model, payload)
    scored = score_session(
        prepared,
        predict,
        model.structure.sides,
        session,
        "identified model",
        units=model.structure.chain.torque_units,
    )
    chosen = session.select(model.structure.chain.joint_names)
    found = []
    for side in model.structure.sides:
        if side not in scored.relative or side == "difference":
            continue
        parts = (_part(passage, side, predict, prepared.cutoff_hz) for passage in prepared.passages)
        whole = stored_together(part for part in parts if part)
        if not whole:
            continue
        columns = dict(zip(_COLUMNS, whole, strict=True))
        time = columns["time"]
        found.append(
            Curves(
                session=name,
                file=session.path.name,
                side=side,
                payload=payload,
                joint_names=prepared.joint_names,
                cutoff_hz=prepared.cutoff_hz,
                raw_velocity=_velocity(chosen, time) if side == "joint" else np.empty((len(time), 0)),
                whole=scored,
                unseen=unseen,
                **columns,
            )
        )
    return found


def _part(passage: Passage, side: Side, predict: Predictor, cutoff_hz: float) -> list[Floats]:
    """The `_COLUMNS` of one passage, without the samples that it shares with its neighbours; none without a torque."""
    channel = passage.joint if side == "joint" else passage.motor
    if channel is None or not len(passage.rows) or not channel.torque.shape[1]:
        return []
    computed = predict(channel, side)
    begin, end = passage.core
    # A block goes on where the one before it ends.
    first = begin if passage.continues else passage.rows[0]
    last = end if end < np.inf else passage.rows[-1]
    inside = (channel.times >= first) & (channel.times <= last) & passage.own(channel.times)
    step = median_step(channel.times)
    cutoff = min(cutoff_hz, 0.2 / step)
    grid = np.arange(first, last, 1.0 / (_RATE_PER_CUTOFF * cutoff))
    low_pass = ParallelFilter(channel.times, grid, cutoff, _ATTENUATION_DB)
    found = [
        channel.times[inside],
        channel.torque[inside],
        (channel.torque - computed)[inside],
        channel.q[inside],
        channel.qd[inside],
        grid,
        low_pass.apply(channel.torque),
        low_pass.apply(computed),
    ]
    passage.release()
    return found


def _velocity(session: Session, time: Floats) -> Floats:
    """(m, n) differences of the logged positions [rad/s] at the times of the channel."""
    joint = session.joint
    clock = joint.publish_time if np.ptp(joint.publish_time) > 0 else joint.log_time
    seconds = (clock - clock[0]) * 1e-9
    middle = 0.5 * (seconds[1:] + seconds[:-1])

    def at(times: Floats) -> Floats:
        k = np.clip(np.searchsorted(middle, times), 0, len(middle) - 1)
        return np.asarray(
            (joint.position[k + 1] - joint.position[k]) / (seconds[k + 1] - seconds[k])[:, None]
        )

    return stored(at(time[some]) for some in spans(len(time)))


@dataclass(frozen=True)
class ResultFolder:
    """Results of one experiment. Missing parts (no model, no diagnosis) are None or empty.

    path : the folder; summary : content of summary.json.
    """

    path: Path
    summary: Mapping[str, Any]

    @classmethod
    def load(cls, path: str | Path) -> ResultFolder:
        """Read `summary.json` of a folder. ConfigurationError if there is none, DataError if it is broken."""
        folder = Path(path)
        file = folder / SUMMARY
        if not file.is_file():
            raise ConfigurationError(
                f"{folder}: holds no summary.json; name the folder of an experiment, the last line of the output of "
                "`lwr-run experiment`"
            )
        try:
            content = json.loads(file.read_text(encoding="utf-8"))
            if not isinstance(content, dict) or "exit_status" not in content:
                raise ValueError("no `exit_status`")
        except (OSError, ValueError) as error:
            raise DataError(
                f"{file}: is no summary of an experiment: {error}; run the experiment again"
            ) from error
        return cls(folder, content)

    @cached_property
    def model(self) -> DynamicModel | None:
        """The identified model, or None."""
        file = self.path / MODEL
        return read_model(file) if file.is_file() else None

    @cached_property
    def published_arm(self) -> bool:
        """Whether the published tables are of this kind of arm."""
        return self.model is None or is_published_arm(self.model.structure.chain)

    @cached_property
    def sessions(self) -> dict[str, Session]:
        """The readable session logs by name of the session."""
        found: dict[str, Session] = {}
        for entry in self.summary.get("sessions", []):
            file = self.path / entry["file"]
            try:
                session = read_session(file)
            except (LwrError, OSError):
                continue
            announced = {**session.metadata, **entry.get("metadata", {})}
            found[entry["name"]] = replace(session, metadata=announced)
        return found

    @property
    def unread(self) -> tuple[str, ...]:
        """Names of the sessions with a missing or broken log."""
        return tuple(e["name"] for e in self.summary.get("sessions", []) if e["name"] not in self.sessions)

    @property
    def diagnosis_folder(self) -> Path:
        """Folder of the diagnosis files: `diagnosis`, or the folder itself."""
        own = self.path / "diagnosis"
        return own if (own / DIAGNOSIS).is_file() else self.path

    @cached_property
    def diagnosis(self) -> Mapping[str, Any] | None:
        """Content of diagnosis.json, or None. DataError if it is broken."""
        file = self.diagnosis_folder / DIAGNOSIS
        if not file.is_file():
            return None
        try:
            content: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise DataError(f"{file}: cannot be read: {error}; run `lwr-run diagnose` again") from error
        return content

    @cached_property
    def preflights(self) -> dict[str, list[dict[str, Any]]]:
        """Conditions checked before the motion, by session."""
        texts = {name: one.attachments.get("preflight.json") for name, one in self.sessions.items()}
        return {name: json.loads(text) for name, text in texts.items() if text is not None}

    @cached_property
    def curves(self) -> tuple[Curves, ...]:
        """Measured and computed torque by session and side: held-out sessions last, loaded ones first."""
        if self.model is None:
            return ()
        settings = signals_for(self.model)
        found = []
        for entry in self.summary["sessions"]:
            session = self.sessions.get(entry["name"])
            if session is not None and entry["exit_status"] == "success":
                unseen = bool(entry.get("validation"))
                try:
                    found += curves(self.model, session, entry["name"], settings=settings, unseen=unseen)
                except DataError:
                    # Listed with its reason under `unscored` of the summary.
                    continue
        return tuple(sorted(found, key=lambda one: (one.unseen, one.payload is None, one.session, one.side)))

    @cached_property
    def _experiment(self) -> Mapping[str, Any] | None:
        text = self.text("experiment.yaml")
        content = yaml.safe_load(text) if text is not None else None
        return content if isinstance(content, dict) else None

    @property
    def emulated(self) -> bool:
        """Whether the arm was the built-in emulator's."""
        return self._experiment is not None and self._experiment.get("backend", "emulator") == "emulator"

    @property
    def lock_step(self) -> bool:
        """Whether the emulator waited for each answer; reply times are then meaningless."""
        return self.emulated and bool((self._experiment or {}).get("lock_step", True))

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Joints of the arm in kinematic order."""
        if self.sessions:
            return next(iter(self.sessions.values())).joint_names
        return tuple(next(iter(self.summary.get("torque_rms", {}).values()), ()))

    def text(self, name: str) -> str | None:
        """Text of a file of the folder, or None."""
        file = self.path / name
        return file.read_text(encoding="utf-8", errors="replace") if file.is_file() else None
