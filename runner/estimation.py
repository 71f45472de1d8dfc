"""Settings of an identification: the keys of `--settings FILE`, and corrections of the payloads' metadata."""

from __future__ import annotations

import dataclasses
import math
import typing
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from fri.errors import ConfigurationError
from ident.dynamics.structure import Coulomb, Coupling
from ident.estimation.essential import EssentialSettings
from ident.estimation.identify import AUTO, IdentificationSettings, estimator_factory
from ident.estimators import ESTIMATORS, CovarianceSettings
from ident.rows.filters import SignalSettings
from lwr_driver.configuration import find, parse, read_mapping
from lwr_driver.session import Session


@dataclass(frozen=True)
class EstimatorOptions:
    """Options of the estimators; None leaves an estimator its own default."""

    tuning: float | None = None
    memory_s: float | None = None
    relative_noise: float | None = None
    prior_strength: Literal["evidence", "cross_validation"] | float | None = None
    prior_metric: Literal["pullback", "entropic", "euclidean"] | None = None
    prior_std: float | None = None


@dataclass(frozen=True)
class CoulombSettings:
    """The function in place of sign(qd): "data" takes the one that predicts best."""

    kind: Literal["data", "sign", "deadband", "tanh"] = "data"
    width: float = 0.0

    def __post_init__(self) -> None:
        _ = self.law

    @property
    def law(self) -> Coulomb | None:
        """The law, None for a choice from the data."""
        return None if self.kind == "data" else Coulomb(self.kind, self.width)


@dataclass(frozen=True)
class IdentifySettings:
    """Content of a settings file of `lwr-run identify`. `KEYS` describes each key."""

    without: tuple[str, ...] = ()
    couplings: tuple[tuple[str, str], ...] = ()
    coulomb: CoulombSettings = field(default_factory=CoulombSettings)
    resonance_hz: float | None = None
    estimator: EstimatorOptions = field(default_factory=EstimatorOptions)
    covariance: CovarianceSettings = field(default_factory=CovarianceSettings)
    signals: SignalSettings = field(default_factory=SignalSettings)
    essential: EssentialSettings | None = field(default_factory=EssentialSettings)

    @classmethod
    def load(cls, name: str | Path) -> IdentifySettings:
        """Read a settings file. ConfigurationError with file, key, value, limit and advice."""
        path = find(name)
        content = read_mapping(path)
        settings = parse(cls, content, path)
        for key in KEYS:
            key.check(content, path)
        return settings

    def __post_init__(self) -> None:
        for first, second in self.couplings:
            if first == second:
                raise ConfigurationError(
                    f"`couplings` has {first} twice in a pair; name two joints, such as [A5, A6]"
                )

    def identification(self, model: int, estimator: str, *, file: str = "settings") -> IdentificationSettings:
        """The settings for `ident`, with the model and the estimator of the command line. file : for errors."""
        given = {name: value for name, value in vars(self.estimator).items() if value is not None}
        for name, value in given.items():
            if estimator == AUTO or name not in ESTIMATORS[estimator].options:
                takers = [other for other, kind in ESTIMATORS.items() if name in kind.options]
                raise ConfigurationError(
                    f"{file}: `estimator.{name}` is {value}, an option of {' and '.join(takers)}, not of {estimator}; "
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


@dataclass(frozen=True)
class Key:
    """A key of a settings file: unit, meaning and range.

    above, least, most : limits of a number; with `above` the upper limit is excluded too.
    otherwise : meaning of the default null.
    """

    name: str
    unit: str
    meaning: str
    above: float = -math.inf
    least: float = -math.inf
    most: float = math.inf
    otherwise: str = ""

    @property
    def default(self) -> str:
        """The default as in YAML, with the meaning of null."""
        value: Any = IdentifySettings()
        for part in self.name.split("."):
            value = getattr(value, part)
        if isinstance(value, (tuple, list)):
            return "[]"
        shown = "null" if value is None else f"{value:g}" if isinstance(value, float) else str(value).lower()
        return f"{shown}: {self.otherwise}" if self.otherwise else shown

    @property
    def range(self) -> str:
        """The allowed values as text."""
        kind: Any = IdentifySettings
        hint: Any = None
        for part in self.name.split("."):
            hint = typing.get_type_hints(kind)[part]
            kind = next((h for h in (hint, *typing.get_args(hint)) if dataclasses.is_dataclass(h)), kind)
        words = list(_words(hint))
        unlimited = self.above == self.least == -math.inf
        if unlimited and float in typing.get_args(hint):
            words.append("a number")
        if self.above > -math.inf:
            words.append(f"above {self.above:g}" + (f", below {self.most:g}" if self.most < math.inf else ""))
        elif self.most < math.inf:
            words.append(f"{self.least:g} to {self.most:g}")
        elif self.least > -math.inf:
            words.append(f"{self.least:g} or more")
        return " or ".join(words) if len(words) < 3 else ", ".join(words)

    def check(self, content: Mapping[str, Any], path: Path) -> None:
        """Refuse a number outside the range."""
        value: Any = content
        for part in self.name.split("."):
            value = value.get(part) if isinstance(value, Mapping) else None
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            return
        outside = value <= self.above or value < self.least or value > self.most
        if outside or (self.above > -math.inf and value == self.most):
            raise ConfigurationError(
                f"{path}: `{self.name}` is {value:g}, outside its range ({self.range}); leave the key out for the "
                f"default {self.default}"
            )


def _words(hint: Any) -> Iterator[str]:
    if typing.get_origin(hint) is Literal:
        yield from typing.get_args(hint)
    elif hint is bool:
        yield from ("true", "false")
    elif hint is not float:
        for part in typing.get_args(hint):
            yield from _words(part)


KEYS = (
    Key("without", "names", "parameters (`offm3`) or kinds (`Fvl`) left out of the model"),
    Key("couplings", "pairs of joints", "joints with coupled drives, such as `[[A5, A6]]`"),
    Key("resonance_hz", "Hz", "lowest resonance of the arm, for advice on cut-offs", above=0.0, otherwise="no advice"),
    Key("coulomb.kind", "", "function in place of sign(qd) in the Coulomb friction; `data`: the best predictor"),
    Key("coulomb.width", "rad/s", "width of `deadband` and `tanh`, above 0 for these", least=0.0),
    Key(
        "estimator.tuning", "standard deviations", "`huber`, `tukey`: threshold of the loss", above=0.0,
        otherwise="95 % efficiency at normal residuals",
    ),
    Key(
        "estimator.memory_s", "s", "`recursive`, `mixing`: time constant of the forgetting", above=0.0,
        otherwise="no forgetting, 30 s for `mixing`",
    ),
    Key(
        "estimator.relative_noise", "", "`tls`: error of a regressor column as a share of its rms", above=0.0,
        otherwise="0.001",
    ),
    Key(
        "estimator.prior_strength", "", "`map`, `physical`: weight of the URDF's inertials, or its choice by the data",
        above=0.0, otherwise="1",
    ),
    Key(
        "estimator.prior_metric", "", "`map`, `physical`: distance between a body and its prior",
        otherwise="pullback",
    ),
    Key(
        "estimator.prior_std", "", "`map`, `physical`: standard deviation of the URDF's inertials as a share of them",
        above=0.0, otherwise="0.2",
    ),
    Key("covariance.kind", "", "source of the standard deviations; `textbook` needs uncorrelated residuals"),
    Key("covariance.bandwidth_s", "s", "`hac`: largest lag", least=0.0, otherwise="from the data"),
    Key(
        "covariance.block_s", "s", "`jackknife`, `bootstrap`: length of a block", above=0.0,
        otherwise="twice the bandwidth",
    ),
    Key("covariance.draws", "", "`bootstrap`: number of draws", least=2),
    Key("covariance.seed", "", "`bootstrap`: seed of the draws", least=0),
    Key("signals.cutoff_hz", "Hz", "low-pass of the positions, -6 dB", above=0.0, otherwise="from the data"),
    Key("signals.order", "", "order of that low-pass, run forward and back", least=1),
    Key(
        "signals.decimate_hz", "Hz", "low-pass of the parallel decimation, at most `cutoff_hz`", above=0.0,
        otherwise="from the data",
    ),
    Key("signals.rate_hz", "Hz", "rate of the rows", above=0.0, otherwise="2.5 `decimate_hz`"),
    Key("signals.attenuation_db", "dB", "stop band of the parallel low-pass", above=0.0),
    Key("signals.average_periods", "", "average the periods of a periodic motion"),
    Key("signals.edge_s", "s", "time dropped at both ends of a stretch", least=0.0, otherwise="2 / `cutoff_hz`"),
    Key("signals.longest_bridge_s", "s", "longest gap closed by interpolation; longer gaps split a record", least=0.0),
    Key(
        "signals.reversal_s", "s", "time left out on either side of a joint's reversal", least=0.0,
        otherwise="from the data",
    ),
    Key("signals.standstill_rad_s", "rad/s", "speed below which the sign of friction is unknown", least=0.0),
    Key("signals.known_share", "", "least share of a row's filter on samples in use", least=0.0, most=1.0),
    Key("signals.outlier_scale", "standard deviations", "distance of outliers from the running median", above=0.0),
    Key("signals.motor_delay_s", "s", "delay of the motor torques"),
    Key("signals.delay_search_s", "s", "largest delay considered, both ways", above=0.0),
    Key(
        "signals.stiffness_nm_rad", "Nm/rad", "stiffness of the joints, one value each", above=0.0,
        otherwise="that of the arm file, else rigid joints",
    ),
    Key("essential.significance", "", "level of the F test of a parameter against zero", above=0.0, most=1.0),
    Key("essential.largest_loss_percent", "%", "growth of the residual by all eliminations together", least=0.0),
    Key("essential.keep", "names", "parameters or kinds that stay"),
    Key("essential.drop", "names", "parameters or kinds that go untested"),
)  # fmt: skip
"""Every key of a settings file. `essential: null` omits the search for essential parameters."""


def couplings(texts: Sequence[str]) -> tuple[Coupling, ...]:
    """Coupled pairs of joints, each as `A5:A6`."""
    found = []
    for text in texts:
        first, mark, second = text.partition(":")
        if not mark or not first or not second or first == second:
            raise ConfigurationError(f"--coupling {text!r} does not name two joints, such as A5:A6")
        found.append(Coupling((first, second)))
    return tuple(found)


def recorded_couplings(sessions: Sequence[Session]) -> tuple[str, ...]:
    """Coupled pairs of joints in the metadata of imported sessions, each as `A5:A6`."""
    return tuple(
        dict.fromkeys(pair for one in sessions for pair in one.metadata.get("couplings", "").split())
    )


def announced(sessions: Sequence[Session], payloads: Sequence[str]) -> list[Session]:
    """The sessions with the payloads given as `FILE=NAME[:KG]` in place of their metadata."""
    corrected = list(sessions)
    known = ", ".join(session.path.name for session in sessions)
    for text in payloads:
        file, mark, payload = text.rpartition("=")
        name, _, mass = payload.partition(":")
        places = [k for k, session in enumerate(sessions) if file in (str(session.path), session.path.name)]
        if not mark or not name or len(places) != 1:
            raise ConfigurationError(
                f"--payload {text!r}: write FILE=NAME or FILE=NAME:KG with one of the files {known}"
            )
        session = corrected[places[0]]
        metadata = {key: value for key, value in session.metadata.items() if key != "payload_mass"}
        metadata["payload"] = name
        if mass:
            try:
                metadata["payload_mass"] = str(float(mass))
            except ValueError:
                raise ConfigurationError(f"--payload {text!r}: {mass!r} is no mass in kg") from None
        corrected[places[0]] = dataclasses.replace(session, metadata=metadata)
    return corrected
