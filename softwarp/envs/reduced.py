"""Reduced robots: the option ``reduced`` of every environment."""

from __future__ import annotations

from softwarp.advice import nearest
from softwarp.builder import ModelBuilder
from softwarp.model.handles import SoftBody
from softwarp.reduction import Reduction, read_about


def reduce_body(builder: ModelBuilder, path: str) -> None:
    """Let the body that a file of ``softwarp reduce`` was made for move in its modes.

    Raises:
        ReductionFileError: If there is no such file, or it holds no reduction.
        ValueError: If the scene has no such body, or the file belongs to another mesh.
    """
    name, names = read_about(path)["name"], [body.name for body in builder.bodies]
    if name not in names:
        raise ValueError(f"{path}: it reduces body {name!r}, which the scene lacks; {nearest(name, names)}")
    number = names.index(name)
    builder.reduce(SoftBody(number), Reduction.load(path, builder.bodies[number].mesh))
