"""A model as files of other software, the format chosen by the ending of the file name."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from fri.errors import ConfigurationError, LwrError
from ident.formats.code import Program, sensor_errors, to_c, to_numpy
from ident.formats.description import drives_left_out, left_out, motors_unknown, to_mjcf, to_urdf
from ident.formats.read_back import check_c, check_mjcf, check_numpy, check_urdf
from ident.formats.standard import StandardModel, standard_model
from ident.model.model_file import Model, as_model, write_checked

FORMATS = {".urdf": "URDF", ".xml": "MJCF", ".c": "C", ".py": "numpy"}
"""Name of the format by ending of the file name."""


def export(
    model: Model,
    *outputs: str | os.PathLike[str],
    payload: str | None = None,
    name: str = "arm",
    overwrite: bool = False,
) -> StandardModel:
    """Write a model to files: `.urdf`, `.xml` (MJCF), `.c` (C99) or `.py` (numpy inverse dynamics).

    model : a model or the path of its file. payload : of the model, mounted; None for the bare arm.
    name : of the arm in MJCF; first part of the names of the C functions. overwrite : replace existing files.

    Returns the exported numbers, with `title` and `notes`. URDF and MJCF need physically consistent bodies, the
    nearest ones where the estimate is not; the notes say so. C and numpy hold those effects of the model that follow
    from the present motion; the notes name the others.
    Each file is read back and computed with before it takes its name; C is compiled where there is a compiler.
    Raises ConfigurationError for an unknown ending, payload or model, and for a file that exists or cannot be
    written; nothing is written unless all endings are known. Raises DataError for a file of other torques than
    the model's; the other files are written.
    """
    paths = []
    for output in outputs:
        if not isinstance(output, (str, os.PathLike)):
            raise ConfigurationError(f"output {output!r:.60} is no path; give a file name such as 'arm.urdf'")
        paths.append(Path(output))
    if not paths:
        raise ConfigurationError("no output given; name at least one file, such as 'arm.urdf'")
    for path in paths:
        if path.suffix not in FORMATS:
            known = ", ".join(f"{ending} ({kind})" for ending, kind in FORMATS.items())
            raise ConfigurationError(f"output {path}: the ending says the format; known: {known}")
        if path.exists() and not overwrite:
            raise ConfigurationError(f"output {path} exists; choose another name or allow to overwrite it")
    source = as_model(model)
    plain = bodies = standard_model(source, payload=payload)
    descriptions = [path.name for path in paths if path.suffix in (".urdf", ".xml")]
    programs = [path.name for path in paths if path.suffix not in (".urdf", ".xml")]
    notes: list[str] = []
    carried = source
    if descriptions:
        bodies = standard_model(source, payload=payload, consistent=True)
        notes += bodies.without(bodies.effects, ", ".join(descriptions))
        for kind, ending in (("URDF", ".urdf"), ("MJCF", ".xml")):
            if own := [path.name for path in paths if path.suffix == ending]:
                notes += left_out(bodies, kind, ", ".join(own))
        notes += motors_unknown(bodies, ", ".join(descriptions))
        notes += [drives_left_out(bodies, path.name) for path in paths if path.suffix == ".urdf"]
    if programs and source.effects:
        program = Program.of(plain)
        carried = replace(source, effects=program.carried)
        notes += plain.without(program.missing, ", ".join(programs))
        notes += sensor_errors(plain, ", ".join(programs))
    writers = {
        ".urdf": lambda: to_urdf(bodies),
        ".xml": lambda: to_mjcf(bodies, name=name),
        ".c": lambda: to_c(plain, name),
        ".py": lambda: to_numpy(plain),
    }
    checks: dict[str, Callable[[str], object]] = {
        ".urdf": lambda text: check_urdf(text, bodies),
        ".xml": lambda text: check_mjcf(text, bodies),
        ".c": lambda text: notes.append(check_c(text, carried, payload, name)),
        ".py": lambda text: check_numpy(text, carried, payload),
    }
    written, failed = [], []
    for path in paths:
        try:
            write_checked(path, writers[path.suffix](), checks[path.suffix], keep_draft=False)
            written.append(path.name)
        except LwrError as error:
            failed.append(error)
    if failed:
        others = f" (written: {', '.join(written)})" if written else ""
        raise type(failed[0])("; ".join(map(str, failed)) + others) from failed[0]
    return replace(bodies, notes=(*bodies.notes, *filter(None, notes)))
