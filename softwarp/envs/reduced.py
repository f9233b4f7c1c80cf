"""Reduced robots: the option ``reduced`` of every environment."""

from __future__ import annotations

from softwarp.advice import nearest
from softwarp.builder import ModelBuilder
from softwarp.model.handles import SoftBody
from softwarp.reduction import Reduction, read_about


def reduce_body(builder: ModelBuilder, path: str, *, turning: bool = False) -> None:
    """Let the body that a file of ``softwarp reduce`` was made for move in its modes.

    Args:
        builder: Of the scene.
        path: Of the file.
        turning: Whether the task asks the body to turn as a whole.

    Raises:
        ReductionFileError: If there is no such file, or it holds no reduction.
        ValueError: If the scene has no such body, the file belongs to another mesh, or its modes cannot turn and are
            asked to.
    """
    name, names = read_about(path)["name"], [body.name for body in builder.bodies]
    if name not in names:
        raise ValueError(f"{path}: it reduces body {name!r}, which the scene lacks; {nearest(name, names)}")
    number = names.index(name)
    reduction = Reduction.load(path, builder.bodies[number].mesh)
    if turning and not reduction.turns:
        raise ValueError(
            f"{path}: its modes live in a fixed frame and cannot turn body {name!r}, which this task asks for; make it "
            "with softwarp reduce ... frame=floating"
        )
    builder.reduce(SoftBody(number), reduction)
