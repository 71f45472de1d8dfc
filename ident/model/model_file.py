"""`model.yaml`: writing and strict reading of a `DynamicModel`.

Layout (schema_version 1)::

    schema_version: 1
    robot: KUKA LWR4+
    model: {number: 2, sides: [motor, joint], payloads: [load], without: [], couplings: [], coulomb: {...}}
    conditions: [{payload: null, sides: [motor, joint]}, ...]     # of a base set: its sessions
    chain: {joints: [{name, link, kind, alpha, d, theta, r}, ...], gravity: [0, 0, -9.81]}
    parameters: [{name: ZZ2R, unit: kg m^2, value: 1.4, std: 0.014, kind: base}, ...]
    covariance: rows of the lower triangle, each a text of numbers, in the order of `parameters`
    provenance: {...}
    effects: []
    urdf: |  the text of the robot description, when there is one

Values keep all their digits; standard deviations and covariances ten. `provenance.signals` holds the signal
settings of the estimate (`ident.model.signals`).
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
import yaml

from fri.errors import ConfigurationError, DataError, LwrError
from ident.dynamics.base_set import BaseSet, numeric_base
from ident.dynamics.kinematics import Chain
from ident.dynamics.parameters import Floats
from ident.dynamics.structure import Condition, Coulomb, Coupling, ModelStructure, Side
from ident.model.covariance import DIGITS, nearest_covariance, rounded
from ident.model.dynamic_model import DynamicModel
from lwr_driver.configuration import parse, read_mapping
from lwr_driver.yaml_text import Dumper, yaml_content

Model: TypeAlias = DynamicModel | str | os.PathLike[str]
"""A model or the path of a model file."""

SCHEMA_VERSION = 1

_STD_TOLERANCE = 1e-6


@dataclass(frozen=True)
class _CoulombEntry:
    kind: Literal["sign", "deadband", "tanh"] = "sign"
    width: float = 0.0


@dataclass(frozen=True)
class _ModelEntry:
    number: int
    sides: tuple[Side, ...]
    payloads: tuple[str, ...] = ()
    without: tuple[str, ...] = ()
    couplings: tuple[tuple[str, str], ...] = ()
    coulomb: _CoulombEntry = field(default_factory=_CoulombEntry)


@dataclass(frozen=True)
class _ConditionEntry:
    payload: str | None
    sides: tuple[Side, ...]


@dataclass(frozen=True)
class _JointEntry:
    name: str
    link: str
    kind: Literal["revolute", "prismatic"]
    alpha: float
    d: float
    theta: float
    r: float


@dataclass(frozen=True)
class _ChainEntry:
    joints: tuple[_JointEntry, ...]
    gravity: tuple[float, float, float]
    base_placement: tuple[tuple[float, ...], ...] | None = None
    link_placements: tuple[tuple[tuple[float, ...], ...], ...] | None = None


@dataclass(frozen=True)
class _ParameterEntry:
    name: str
    unit: str
    value: float
    kind: Literal["base", "standard"]
    std: float | None = None


@dataclass(frozen=True)
class _File:
    schema_version: int
    robot: str
    model: _ModelEntry
    chain: _ChainEntry
    parameters: tuple[_ParameterEntry, ...]
    conditions: tuple[_ConditionEntry, ...] = ()
    covariance: tuple[str, ...] | None = None
    provenance: dict[str, Any] = field(default_factory=dict)
    effects: tuple[dict[str, Any], ...] = ()
    urdf: str | None = None


def write_model(model: DynamicModel, path: str | Path) -> None:
    """Write a model to `path` (YAML, UTF-8), replacing an existing file in one step.

    The file is read back first. Raises DataError for a model that does not survive, and ConfigurationError for
    a place that cannot be written.
    """
    write_checked(path, model_text(model), lambda text: _check_read(model, text))


def write_checked(
    path: str | Path, text: str, check: Callable[[str], object], *, keep_draft: bool = True
) -> None:
    """Write `text` (UTF-8) to `path` in one step, after `check` of the text as read back from the disk.

    check : raises LwrError for a file of no use; an existing file then stays, the draft lies beside it.
    keep_draft : whether the draft of such a file stays.
    """
    target = Path(path)
    draft = target.with_name(target.name + ".part")
    try:
        draft.write_text(text, encoding="utf-8")
        again = draft.read_text(encoding="utf-8")
    except OSError as error:
        raise ConfigurationError(
            f"{target} cannot be written: {error.strerror}; choose another place"
        ) from error
    try:
        check(again)
    except LwrError as error:
        if not keep_draft:
            draft.unlink(missing_ok=True)
        place = f" (draft: {draft.name})" if keep_draft else ""
        raise DataError(
            f"{target}: the file cannot be read back, so it was not put in place{place}: {error}"
        ) from error
    try:
        draft.replace(target)
    except OSError as error:
        raise ConfigurationError(
            f"{target} cannot be written: {error.strerror}; choose another place"
        ) from error


def _check_read(model: DynamicModel, text: str) -> None:
    """Compare the model of a file's text with the written one."""
    again = read_model(yaml_content(text))
    if again.names != model.names or not np.array_equal(again.values, model.values):
        raise DataError("the parameters read back differ from those written")
    if model_text(again) != text:
        raise DataError("the content read back differs from that written")


def model_text(model: DynamicModel) -> str:
    """The text of `model.yaml`."""
    structure = model.structure
    content: dict[str, Any] = {
        "schema_version": SCHEMA_VERSION,
        "robot": model.robot,
        "model": {
            "number": structure.model,
            "sides": list(structure.sides),
            "payloads": list(structure.payloads),
            "without": list(structure.without),
            "couplings": [list(coupling.joints) for coupling in structure.couplings],
            "coulomb": {"kind": structure.coulomb.kind, "width": float(structure.coulomb.width)},
        },
        "chain": structure.chain.to_dict(),
    }
    if model.base is not None:
        content["conditions"] = [
            {"payload": c.payload, "sides": list(structure.condition_sides(c))} for c in model.base.conditions
        ]
    covariance = None
    if model.covariance is not None:
        covariance = rounded(
            nearest_covariance(model.covariance, f"covariance of the model of {model.robot}")
        )
    content["parameters"] = _parameter_entries(model, covariance)
    if covariance is not None:
        content["covariance"] = [
            " ".join(f"{value:.{DIGITS}g}" for value in row[: k + 1]) for k, row in enumerate(covariance)
        ]
    content["provenance"] = _plain(model.provenance)
    content["effects"] = [_plain(effect) for effect in model.effects]
    if structure.chain.urdf is not None:
        content["urdf"] = structure.chain.urdf
    return yaml.dump(content, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=110)


def _parameter_entries(model: DynamicModel, covariance: Floats | None) -> list[dict[str, Any]]:
    entries = []
    for k, (name, unit, value) in enumerate(zip(model.names, model.units, model.values, strict=True)):
        entry: dict[str, Any] = {"name": name, "unit": unit, "value": float(value)}
        if covariance is not None:
            # The root of the written variance, so that a file read and written again stays the same.
            entry["std"] = float(rounded(np.sqrt(covariance[k, k])))
        entry["kind"] = model.kind
        entries.append(entry)
    return entries


def as_model(value: Model, name: str = "model") -> DynamicModel:
    """The model `value`, or the one in the file at this path. Raises ConfigurationError for another type."""
    if isinstance(value, DynamicModel):
        return value
    if isinstance(value, (str, os.PathLike)):
        return read_model(Path(value))
    raise ConfigurationError(
        f"`{name}` must be of type DynamicModel or the path of a model file, not {type(value).__name__} "
        f"{value!r:.60}; read one with `read_model`, or take `identify(...).model`"
    )


def read_model(source: str | Path | Mapping[str, Any]) -> DynamicModel:
    """Read a model from a file, or from its content as a mapping.

    Strict: unknown or missing keys, unknown names, wrong units and a covariance inconsistent with its standard
    deviations raise ConfigurationError with the file, the key and the remedy. A covariance that is not positive
    semi-definite becomes the nearest one (`nearest_covariance`).
    """
    if isinstance(source, Mapping):
        content, where = dict(source), "model"
    else:
        content, where = read_mapping(Path(source)), str(source)
    version = content.get("schema_version")
    if version != SCHEMA_VERSION:
        raise ConfigurationError(
            f"{where}: schema_version is {version!r}; this software reads {SCHEMA_VERSION}. "
            "Write the model again with its own software, or update this one"
        )
    file = parse(_File, content, where if isinstance(source, Mapping) else Path(source))
    try:
        return _model(file, content, where)
    except ConfigurationError as error:
        raise ConfigurationError(f"{where}: {error}") from error


def _model(file: _File, content: Mapping[str, Any], where: str) -> DynamicModel:
    structure = ModelStructure(
        Chain.from_dict(content["chain"], urdf=file.urdf),
        file.model.number,
        payloads=file.model.payloads,
        without=file.model.without,
        couplings=tuple(Coupling(joints) for joints in file.model.couplings),
        coulomb=Coulomb(file.model.coulomb.kind, file.model.coulomb.width),
        sides=file.model.sides,
    )
    kinds = sorted({entry.kind for entry in file.parameters})
    if len(kinds) != 1:
        raise ConfigurationError(
            f"`parameters` are of the kinds {kinds}; a model has parameters of exactly one kind"
        )
    base: BaseSet | None = None
    if kinds == ["base"]:
        if not file.conditions:
            raise ConfigurationError("`conditions` is missing; base parameters need to know their sessions")
        base = numeric_base(structure, [Condition(entry.payload, entry.sides) for entry in file.conditions])
    elif file.conditions:
        raise ConfigurationError("`conditions` belong to base parameters, and these are standard ones")
    model = DynamicModel(
        file.robot,
        structure,
        tuple(entry.name for entry in file.parameters),
        np.array([entry.value for entry in file.parameters]),
        None if file.covariance is None else _covariance(file.covariance, file.parameters, where),
        base,
        file.provenance,
        file.effects,
    )
    expected = structure.names if base is None else base.names
    for entry, unit, position in zip(file.parameters, model.units, model.positions, strict=True):
        if entry.name != expected[position]:
            raise ConfigurationError(
                f"`{entry.name}` is `{expected[position]}` under the conditions of this file; correct either"
            )
        if entry.unit != unit:
            raise ConfigurationError(f"`{entry.name}` has the unit {entry.unit!r}; expected {unit!r}")
    return model


def _covariance(rows: tuple[str, ...], entries: tuple[_ParameterEntry, ...], where: str) -> Floats:
    count = len(entries)
    if len(rows) != count:
        raise ConfigurationError(f"`covariance` has {len(rows)} rows for {count} parameters")
    lower = np.zeros((count, count))
    for k, row in enumerate(rows):
        try:
            numbers = np.array([float(part) for part in row.split()])
        except ValueError as error:
            raise ConfigurationError(f"`covariance[{k}]` holds an entry that is no number") from error
        if len(numbers) != k + 1:
            raise ConfigurationError(f"`covariance[{k}]` must hold {k + 1} numbers, found {len(numbers)}")
        if not np.all(np.isfinite(numbers)):
            bad = int(np.argmin(np.isfinite(numbers)))
            raise ConfigurationError(
                f"`covariance[{k}]` of {entries[k].name} with {entries[bad].name} (entry {bad + 1}) is {numbers[bad]}; "
                "all must be finite: write the model anew, or leave `covariance` and every `std` out"
            )
        lower[k, : k + 1] = numbers
    full = lower + np.tril(lower, -1).T
    std = np.sqrt(np.maximum(np.diag(full), 0.0))
    for k, entry in enumerate(entries):
        if entry.std is None or abs(entry.std - std[k]) > _STD_TOLERANCE * max(std[k], entry.std):
            raise ConfigurationError(
                f"`{entry.name}`: std {entry.std} is not the root {std[k]:.6g} of its covariance; "
                "the file was edited by hand: correct one of the two"
            )
    scale = np.where(std > 0.0, std, 1.0)
    correlation = full / np.outer(scale, scale)
    first, second = divmod(int(np.argmax(np.abs(correlation))), max(count, 1))
    # Beyond 2, the nearest possible correlation is further away than the whole scale is long.
    if abs(correlation[first, second]) > 2.0:
        raise ConfigurationError(
            f"`covariance` is not positive semi-definite: the correlation of {entries[first].name} and "
            f"{entries[second].name} is {correlation[first, second]:.3g}; a row was changed or lost"
        )
    return nearest_covariance(full, f"{where}: `covariance`")


def _plain(value: Any) -> Any:
    """Plain content for YAML: numpy numbers, arrays and paths are converted."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, np.generic):
        return value.item()
    return str(value) if isinstance(value, Path) else value


class _Dumper(Dumper):
    """Block style for the file, flow style for its rows, literal blocks for texts of several lines."""


def _text(dumper: yaml.SafeDumper, value: str) -> yaml.ScalarNode:
    style = "|" if "\n" in value else None
    return dumper.represent_scalar("tag:yaml.org,2002:str", value, style=style)


def _row(dumper: yaml.SafeDumper, value: dict[str, Any]) -> yaml.MappingNode:
    flat = all(not isinstance(item, (dict, list)) for item in value.values())
    return dumper.represent_mapping("tag:yaml.org,2002:map", value.items(), flow_style=flat or None)


def _list(dumper: yaml.SafeDumper, value: list[Any]) -> yaml.SequenceNode:
    flat = all(isinstance(item, (int, float, bool)) or item is None for item in value)
    short = all(isinstance(item, str) for item in value) and sum(map(len, value)) < 60
    return dumper.represent_sequence("tag:yaml.org,2002:seq", value, flow_style=flat or short or None)


_Dumper.add_representer(str, _text)
_Dumper.add_representer(dict, _row)
_Dumper.add_representer(list, _list)
