"""Reduced robots: the option ``reduced`` of every environment."""

from __future__ import annotations

from softwarp.advice import nearest
from softwarp.builder import ModelBuilder
from softwarp.model.handles import SoftBody
from softwarp.reduction import Reduction


def reduce_body(builder: ModelBuilder, path: str) -> None:
    """Let the body that a file of ``softwarp reduce`` was made for move in its modes.

    Raises:
        ReductionFileError: If there is no such file, or it holds no reduction.
        ValueError: If the scene has no such body, or the file belongs to another mesh.
    """
    reduction = Reduction.load(path)
    names = [body.name for body in builder.bodies]
    if reduction.name not in names:
        raise ValueError(
            f"{path}: it reduces body {reduction.name!r}, which the scene lacks; {nearest(reduction.name, names)}"
        )
    builder.reduce(SoftBody(names.index(reduction.name)), reduction)
