"""Settings of an identification: the keys of `--settings FILE`, and corrections of the payloads' metadata."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from fri.errors import ConfigurationError
from fri.quantities import Name, within
from ident.dynamics.structure import Coulomb, Coupling
from ident.estimation.essential import EssentialSettings
from ident.estimation.identification import IdentificationSettings
from ident.estimation.identify import estimator_factory
from ident.estimators import ESTIMATORS, CovarianceSettings
from ident.estimators.names import AUTO
from ident.model import DynamicModel
from ident.rows.filters import SignalSettings
from lwr_driver.configuration import find, parse, read_mapping
from lwr_driver.places import Place
from lwr_driver.session import Session
from runner.computer import software

_Positive = Annotated[float, within(0.0, 1e12, above=True)]


@dataclass(frozen=True)
class EstimatorOptions:
    """Options of the estimators; None leaves an estimator its own default."""

    tuning: _Positive | None = None
    memory_s: Annotated[float, within(0.0, 1e6, "s", above=True)] | None = None
    relative_noise: _Positive | None = None
    prior_strength: Literal["evidence", "cross_validation"] | _Positive | None = None
    prior_metric: Literal["pullback", "entropic", "euclidean"] | None = None
    prior_std: _Positive | None = None


@dataclass(frozen=True)
class CoulombSettings:
    """The function in place of sign(qd): "data" takes the one that predicts best."""

    kind: Literal["data", "sign", "deadband", "tanh"] = "data"
    width: Annotated[float, within(0.0, 100.0, "rad/s")] = 0.0

    def __post_init__(self) -> None:
        _ = self.law

    @property
    def law(self) -> Coulomb | None:
        """The law, None for a choice from the data."""
        return None if self.kind == "data" else Coulomb(self.kind, self.width)


@dataclass(frozen=True)
class IdentifySettings:
    """Content of a settings file of `lwr-run identify`."""

    without: tuple[Name, ...] = ()
    couplings: tuple[tuple[Name, Name], ...] = ()
    coulomb: CoulombSettings = field(default_factory=CoulombSettings)
    resonance_hz: Annotated[float, within(0.0, 1e5, "Hz", above=True)] | None = None
    estimator: EstimatorOptions = field(default_factory=EstimatorOptions)
    covariance: CovarianceSettings = field(default_factory=CovarianceSettings)
    signals: SignalSettings = field(default_factory=SignalSettings)
    essential: EssentialSettings | None = field(default_factory=EssentialSettings)

    @classmethod
    def load(cls, name: str | Path) -> IdentifySettings:
        """Read a settings file. ConfigurationError with file, key, value, limit and advice."""
        path = find(name)
        return parse(cls, read_mapping(path), path)

    def __post_init__(self) -> None:
        for first, second in self.couplings:
            if first == second:
                raise ConfigurationError(
                    f"`couplings` has {first} twice in a pair; name two joints, such as [A5, A6]"
                )

    def identification(
        self, model: int, estimator: str, *, file: str | Path = "settings"
    ) -> IdentificationSettings:
        """The settings for `ident`, with the model and the estimator of the command line. file : for errors."""
        given = {name: value for name, value in vars(self.estimator).items() if value is not None}
        for name, value in given.items():
            if estimator == AUTO or name not in ESTIMATORS[estimator].options:
                takers = [other for other, kind in ESTIMATORS.items() if name in kind.options]
                place = Place.of(file).line_of("estimator").line_of(name)
                raise ConfigurationError(
                    f"{place}: `estimator.{name}` is {value}, an option of {' and '.join(takers)}, not of {estimator}; "
                    f"leave the key out or choose --estimator {takers[0]}"
                )
        return IdentificationSettings(
            model=model,
            signals=self.signals,
            estimator=estimator_factory(estimator, **given) if given else estimator,
            covariance=self.covariance,
            without=self.without,
            couplings=tuple(map(Coupling, self.couplings)),
            coulomb=self.coulomb.law,
            resonance_hz=self.resonance_hz,
            essential=self.essential,
        )


_LEAST_BLOCKS, _LEAST_ROWS = 8, 10
# Keys of a settings file whose values are judged by the sessions alone, by the word in the message.
_LATE = {
    "without": ("without",),
    "couplings": ("couplings",),
    "keep": ("essential", "keep"),
    "drop": ("essential", "drop"),
    "stiffness_nm_rad": ("signals", "stiffness_nm_rad"),
}


@contextmanager
def of_file(settings: str | None) -> Iterator[None]:
    """Errors of a settings file that show with the sessions, with file and line."""
    try:
        yield
    except ConfigurationError as error:
        message = str(error)
        keys = next((keys for word, keys in _LATE.items() if message.startswith(f"`{word}`")), None)
        if settings is None or keys is None:
            raise
        path = find(settings)
        place = Place.of(path)
        for key in keys:
            place = place.line_of(key)
        if str(place) == str(path):  # of an option of the command line
            raise
        raise type(error)(f"{place}: {message}") from error


def check_spans(
    sessions: Sequence[Session], wanted: IdentificationSettings, file: str | Path = "settings"
) -> None:
    """Raise ConfigurationError for times in a settings file that the sessions are too short for."""
    durations = [session.duration_s for session in sessions]
    longest, total, signals = max(durations), sum(durations), wanted.signals
    checks = (
        (
            ("signals", "rate_hz"),
            signals.rate_hz is not None and signals.rate_hz * longest < _LEAST_ROWS,
            f"{signals.rate_hz} Hz makes fewer than {_LEAST_ROWS} rows of the longest session, {longest:.3g} s; "
            "raise it",
        ),
        (
            ("signals", "edge_s"),
            signals.edge_s is not None and 2.0 * signals.edge_s >= longest,
            f"{signals.edge_s} s at either end leave nothing of the longest session, {longest:.3g} s; lower it",
        ),
        (
            ("covariance", "block_s"),
            wanted.covariance.block_s is not None and wanted.covariance.block_s * _LEAST_BLOCKS > total,
            f"{wanted.covariance.block_s} s is more than an eighth of all sessions, {total:.3g} s, and fewer than "
            f"{_LEAST_BLOCKS} blocks tell no deviation; lower it to {total / _LEAST_BLOCKS:.2g} or less",
        ),
    )
    for keys, wrong, said in checks:
        if wrong:
            place = Place.of(file)
            for key in keys:
                place = place.line_of(key)
            raise ConfigurationError(f"{place}: `{keys[0]}`: `{keys[1]}`: {said}")


def announced(
    sessions: Sequence[Session], payloads: Sequence[str], typed: Sequence[Path] = ()
) -> list[Session]:
    """The sessions with the payloads given as `FILE=NAME[:KG]` in place of their metadata.

    typed : the recordings of the sessions as named by the user, whose sessions may be imports of another name.
    """
    corrected = list(sessions)
    files = [{str(session.path), session.path.name} for session in sessions]
    for path, names in zip(typed, files, strict=False):
        names |= {str(path), path.name}
    known = ", ".join(path.name for path in (typed or [session.path for session in sessions]))
    for text in payloads:
        file, mark, payload = text.rpartition("=")
        name, _, mass = payload.partition(":")
        places = [k for k, names in enumerate(files) if file in names]
        if not mark or not name or len(places) != 1:
            raise ConfigurationError(
                f"--payload {text!r}: write FILE=NAME or FILE=NAME:KG with one of the files {known}"
            )
        session = corrected[places[0]]
        metadata = {key: value for key, value in session.metadata.items() if key != "payload_mass"}
        metadata["payload"] = name
        if mass:
            try:
                value = float(mass)
            except ValueError:
                value = math.nan
            if not 0.0 < value < math.inf:
                raise ConfigurationError(
                    f"--payload {text!r}: {mass!r} is no mass in kg; give a positive number, or FILE=NAME without one"
                )
            metadata["payload_mass"] = str(value)
        corrected[places[0]] = dataclasses.replace(session, metadata=metadata)
    return corrected


def named_model(model: DynamicModel, robot: str, files: Mapping[str, str] | None = None) -> DynamicModel:
    """The identified model with the name of the robot, and this software in its provenance.

    files : SHA-256 of the files of the experiment by path, for the provenance.
    """
    origin = {"software": software()} | ({"files": dict(files)} if files else {})
    return dataclasses.replace(model, robot=robot, provenance={**model.provenance, **origin})
