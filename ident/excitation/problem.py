"""The planning problem as a file: arm, surroundings, present knowledge, objective, extent of the search."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from fri.errors import ConfigurationError
from fri.quantities import FileName, Name, Share, Version, entries, within
from ident.excitation.check import Workspace
from lwr_driver.arm.cell import PayloadShape
from lwr_driver.configuration import find, parse, read_mapping
from lwr_driver.extent import LONGEST_EXCITATION_S, Harmonics, Period, Periods
from lwr_driver.places import Place

_Bound = Annotated[float, within(0.0, 1e12, above=True)]
_Noise = Annotated[float, within(1e-6, 1000.0, "Nm")]
_Joint = Annotated[int, within(1, 100)]


@dataclass(frozen=True)
class MotionForm:
    """Parametrisation. fourier: equation (9); bspline: degree 5, `control_points` free ones (Rackl et al. 2012).

    period_s : base period T0, or duration of the spline [s]
    periods : repetitions of the motion in a session
    """

    type: Literal["fourier", "bspline"] = "fourier"
    period_s: Period = 20.0
    harmonics: Harmonics = 5
    control_points: Annotated[int, within(1, 60)] = 12
    periods: Periods = 1

    def __post_init__(self) -> None:
        duration = self.periods * self.period_s
        if not 0.0 < duration <= LONGEST_EXCITATION_S or self.periods < 1:
            raise ConfigurationError(
                f"{self.periods} periods of {self.period_s:g} s last {duration:g} s, above 0 to "
                f"{LONGEST_EXCITATION_S:g} s are planned; lower `periods` or `period_s`"
            )


@dataclass(frozen=True)
class Knowledge:
    """Present estimate of the dynamics: a `model.yaml`, or a file of standard parameters.

    payload : its name in this file; None if every session is unloaded
    relative_uncertainty : of each parameter (one standard deviation), for a file without covariance
    coverage : number of standard deviations covered by the torque limits
    noise_motor, noise_joint : standard deviation of each row [Nm]; empty: values consistent with the published Table 2
    samples : independent samples in each session, for the predicted deviations
    """

    file: FileName = "emulator/table2.yaml"
    payload: Name | None = "paper_load"
    relative_uncertainty: Annotated[float, within(0.0, 10.0)] = 0.1
    coverage: Annotated[float, within(0.0, 20.0)] = 3.0
    noise_motor: tuple[_Noise, ...] = ()
    noise_joint: tuple[_Noise, ...] = ()
    samples: Annotated[float, within(1.0, 1e6)] = 100.0


@dataclass(frozen=True)
class Objective:
    """The criterion to minimise, and bounds on other criteria.

    criterion : condition_number, d_optimality, mean_rsd, worst_rsd, or goal_attainment (equation (10))
    scaling : of the columns in condition numbers
    condition_at_most, mean_rsd_at_most, worst_rsd_at_most : bounds; None for no bound
    goal_condition, goal_wrist : g and k_tau of equation (10); without g the result of a search for the condition number
    alone is the goal (the paper's Remark 4)
    wrist : the two joints of equation (10), counted from 1
    """

    criterion: Literal["condition_number", "d_optimality", "mean_rsd", "worst_rsd", "goal_attainment"] = (
        "mean_rsd"
    )
    scaling: Literal["none", "columns", "parameters"] = "none"
    condition_at_most: _Bound | None = None
    mean_rsd_at_most: _Bound | None = None
    worst_rsd_at_most: _Bound | None = None
    goal_condition: _Bound | None = None
    goal_wrist: Annotated[float, within(0.0, 100.0, above=True)] = 0.9
    wrist: Annotated[tuple[_Joint, ...], entries(1, 100)] = (6, 7)


@dataclass(frozen=True)
class Prior:
    """A motion run earlier, from a plan or a recorded session; the new motion complements its information.

    plan : its plan file; sessions : the sessions recorded with it
    session : a session log, including its payload
    """

    plan: FileName | None = None
    session: FileName | None = None
    sessions: tuple[Literal["unloaded", "loaded"], ...] = ("unloaded", "loaded")

    def __post_init__(self) -> None:
        if (self.plan is None) == (self.session is None):
            raise ConfigurationError("a prior is either a `plan` or a `session`; give one of them")


@dataclass(frozen=True)
class Search:
    """Extent of the search. Seed and counts alone decide the result; a time limit makes it depend on the computer.

    starts : random starts; hops : perturbations tried afterwards; lanes : candidates perturbed at first
    searches : independent searches with seeds from `seed` on, the best of which counts; each is one task
    jobs : processes, through joblib with its configured backend (loky, dask, ray)
    """

    seed: Annotated[int, within(0, 2**32 - 1000)] = 1
    starts: Annotated[int, within(1, 100)] = 8
    hops: Annotated[int, within(0, 5000)] = 120
    lanes: Annotated[int, within(1, 100)] = 4
    searches: Annotated[int, within(1, 1000)] = 1
    jobs: Annotated[int, within(-1, 1024)] = 1
    time_limit_s: Annotated[float, within(0.1, 86400.0, "s")] | None = None

    def __post_init__(self) -> None:
        if self.starts < 1 or self.hops < 0 or self.lanes < 1:
            raise ConfigurationError(
                f"search of {self.starts} starts, {self.hops} hops, {self.lanes} lanes; "
                "at least 1, 0 and 1 are needed"
            )


@dataclass(frozen=True)
class PlanProblem:
    """The input of `plan`; each key of the file has a default but `name`.

    parameters : "base" (all base parameters), "model" (those of the estimate's file), or a list of names
    sessions : sessions recorded with the motion
    model : 1 joint rows, 2 motor and joint rows, 3 difference rows
    clearance_m : distance to keep; None: the cell's own margin. speed_scale : share of the velocity limits
    """

    name: Name
    schema_version: Version = 1
    arm: FileName = "lwr4plus.yaml"
    cell: FileName = "cell.yaml"
    payload_shape: PayloadShape | None = None
    motion: MotionForm = field(default_factory=MotionForm)
    knowledge: Knowledge = field(default_factory=Knowledge)
    parameters: str | tuple[Name, ...] = "base"
    sessions: Annotated[tuple[Literal["unloaded", "loaded"], ...], entries(1, 100)] = ("unloaded", "loaded")
    model: Literal[1, 2, 3] = 2
    objective: Objective = field(default_factory=Objective)
    workspace: Workspace = field(default_factory=Workspace)
    clearance_m: Annotated[float, within(0.0, 0.5, "m")] | None = None
    speed_scale: Share = 1.0
    prior: Annotated[tuple[Prior, ...], entries(0, 100)] = ()
    search: Search = field(default_factory=Search)
    source: Path | None = None

    def __repr__(self) -> str:
        form, search = self.motion, self.search
        detail = (
            f"n_f = {form.harmonics}" if form.type == "fourier" else f"{form.control_points} control points"
        )
        return "\n".join(
            [
                f"PlanProblem {self.name}: {self.arm}, {self.cell}, knowledge {self.knowledge.file}",
                f"  motion {form.type}, {form.period_s:g} s, {detail}, {form.periods} period(s)",
                f"  sessions {', '.join(self.sessions)}; model {self.model}; {len(self.prior)} prior motion(s)",
                f"  objective {self.objective.criterion}",
                f"  search seed {search.seed}, {search.starts} starts, {search.hops} hops",
            ]
        )

    def __post_init__(self) -> None:
        if not self.sessions:
            raise ConfigurationError("sessions is empty; list `unloaded`, `loaded` or both")
        if "loaded" in self.sessions and self.knowledge.payload is None:
            raise ConfigurationError("a loaded session is planned but `knowledge.payload` names no payload")
        if isinstance(self.parameters, str) and self.parameters not in ("base", "model"):
            raise ConfigurationError(f"parameters {self.parameters!r}: write base, model or a list of names")

    @classmethod
    def load(cls, name: str | Path) -> PlanProblem:
        """Read a problem file; ConfigurationError names file, key and remedy."""
        path = find(name)
        content = read_mapping(path)
        if "source" in content:
            raise ConfigurationError(f"{Place.of(path).line_of('source')}: unknown key `source`")
        problem = parse(cls, content, path)
        object.__setattr__(problem, "source", path)
        return problem
