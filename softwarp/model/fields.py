"""How arrays relate to worlds: declarations with shapes and units, and the allocation made from them.

``shared`` arrays hold topology and rest geometry, one copy for all worlds. ``batched`` arrays have logical shape
``(world, row)``; where the world index lies in memory is decided here alone: contiguous per world on a CPU, fastest on
a GPU. A row counts scalars: item i of a vector quantity occupies rows 3 i, 3 i + 1, 3 i + 2.
"""

from __future__ import annotations

from dataclasses import Field, field, fields
from typing import Any

import warp as wp

from softwarp import checks
from softwarp.model import memory

__all__ = ["Declaration", "allocate", "batched", "declarations", "real_of", "shared"]


class Declaration(dict[str, Any]):
    """Metadata of one declared array: ``kind``, ``item``, ``width``, ``unit``, ``doc``, ``integer``, ``start``."""


def shared(item: str, *, unit: str = "1", doc: str = "") -> Any:
    """Declare an array that all worlds share; its first axis counts ``item``."""
    return field(metadata={"declaration": Declaration(kind="shared", item=item, unit=unit, doc=doc)})


def batched(
    item: str, *, width: int = 1, unit: str = "1", doc: str = "", integer: bool = False, start: str = ""
) -> Any:
    """Declare an array with a world axis and ``width`` rows for every ``item`` of the model.

    ``start`` names what a step reads of the state: the key in ``Shard.input`` of the array as the step finds it.
    """
    declaration = Declaration(kind="batched", item=item, width=width, unit=unit, doc=doc, integer=integer, start=start)
    return field(metadata={"declaration": declaration})


def declarations(container: Any) -> dict[str, Declaration]:
    """Declared arrays of a container class or instance, in order."""

    def declared(entry: Field[Any]) -> Declaration | None:
        return entry.metadata.get("declaration")

    return {entry.name: d for entry in fields(container) if (d := declared(entry)) is not None}


def real_of(precision: str) -> Any:
    """Warp scalar type of ``float32`` or ``float64``."""
    checks.choice(precision, "precision", ("float32", "float64"))
    return wp.float64 if precision == "float64" else wp.float32


def allocate(world_count: int, rows: int, dtype: Any, device: Any) -> wp.array:
    """Zeroed array of logical shape (world, row), in the memory order of the device."""
    if wp.get_device(device).is_cuda:
        return memory.zeros((rows, world_count), dtype, device).transpose([1, 0])
    return memory.zeros((world_count, rows), dtype, device)
