"""A model as files of other software, the format chosen by the ending of the file name."""

from __future__ import annotations

import os
from pathlib import Path

from fri.errors import ConfigurationError
from ident.formats.code import to_c, to_numpy
from ident.formats.description import to_mjcf, to_urdf
from ident.formats.standard import StandardModel, standard_model
from ident.model.model_file import Model, as_model

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
    nearest ones where the estimate is not; the notes say so.
    Raises ConfigurationError for an unknown ending, payload or model, and for a file that exists or cannot be
    written; nothing is written unless all endings are known.
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
    if any(path.suffix in (".urdf", ".xml") for path in paths):
        bodies = standard_model(source, payload=payload, consistent=True)
    writers = {
        ".urdf": lambda: to_urdf(bodies),
        ".xml": lambda: to_mjcf(bodies, name=name),
        ".c": lambda: to_c(plain, name),
        ".py": lambda: to_numpy(plain),
    }
    for path in paths:
        text = writers[path.suffix]()
        try:
            path.write_text(text, encoding="utf-8")
        except OSError as error:
            raise ConfigurationError(f"output {path} cannot be written: {error.strerror}") from error
    return bodies
