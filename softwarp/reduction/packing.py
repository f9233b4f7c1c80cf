"""Modes in few bytes: whole multiples of a length, of one half of the body where modes are their own mirror images.

A mode that hardly moves needs few digits. Its unit is the number that an amplitude as large as in the training motion
makes a step of 0.1 um of, or of what else is asked for; differences from node to node are kept, byte by byte, so that a
file compresses them. Rounding leaves modes orthonormal to their largest unit only: Gram and Schmidt with the nodes'
masses, when a file is read, make them so to the last bits, whatever the file holds.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softwarp.reduction.basis import orthonormal

FloatArray = NDArray[np.float64]
RESOLUTION = 1e-7  # m
COARSEST = 2e-3  # largest unit of a mode, whose displacements are about 1, at ``RESOLUTION``
MIRRORED = 1e-6  # of the body's size: how far a node's mirror image may be off
MIRROR = np.array([1.0, -1.0, 1.0])  # the plane y = 0


def images(nodes: NDArray[np.floating[Any]], sign: NDArray[np.floating[Any]] = MIRROR) -> NDArray[np.int64]:
    """Every node's mirror image, (node,).

    Args:
        nodes: At rest [m], (node, 3).
        sign: Of the coordinates, -1 for the one that the mirror turns round.

    Raises:
        ValueError: If a node has none.
    """
    from scipy.spatial import cKDTree

    apart, image = cKDTree(nodes).query(nodes * sign)
    if apart.max() > MIRRORED * np.ptp(nodes, axis=0).max():
        raise ValueError(
            f"symmetric: node {int(apart.argmax())} has no mirror image; the nearest is {apart.max():g} m off"
        )
    return np.asarray(image, dtype=np.int64)


def halves(displacements: FloatArray, nodes: NDArray[np.floating[Any]]) -> FloatArray:
    """Even parts of displacements under the mirror, then their odd parts, (2 state, node, 3).

    Args:
        displacements: (state, node, 3).
        nodes: At rest [m], (node, 3).

    Raises:
        ValueError: If a node has no mirror image.
    """
    mirrored = displacements[:, images(nodes)] * MIRROR
    return np.concatenate([0.5 * (displacements + mirrored), 0.5 * (displacements - mirrored)])


def pack(
    modes: FloatArray,
    sizes: Sequence[float] | None,
    nodes: NDArray[np.floating[Any]],
    resolution: float = RESOLUTION,
) -> dict[str, NDArray[Any]]:
    """Modes as arrays that compress well.

    Args:
        modes: (mode, node, 3).
        sizes: How large their amplitudes are [m], (mode,); None keeps the same digits of all.
        nodes: At rest [m], (node, 3).
        resolution: What a displacement is rounded to, of the amplitudes in ``sizes`` [m].
    """
    unit = np.full(len(modes), COARSEST * 1e-2)
    if sizes is not None:
        coarsest = COARSEST * resolution / RESOLUTION
        unit = np.minimum(resolution / np.maximum(np.asarray(sizes, dtype=np.float64), 1e-30), coarsest)
    unit = np.maximum(unit, np.abs(modes).max(axis=(1, 2)) / 2**30)
    parity = _parity(modes, nodes, unit)
    kept = np.flatnonzero(images(nodes) >= np.arange(len(nodes))) if parity.all() else np.arange(len(nodes))
    whole = np.rint(modes[:, kept] / unit[:, None, None]).astype(np.int64).transpose(0, 2, 1)
    steps = np.diff(whole, axis=2, prepend=0)
    folded = np.ascontiguousarray((steps << 1) ^ (steps >> 63), dtype="<u4")  # numbers near 0 of either sign are small
    planes = folded.view(np.uint8).reshape(*folded.shape, 4)
    return {"unit": unit, "parity": parity, "planes": np.ascontiguousarray(np.moveaxis(planes, -1, 0))}


def unpack(
    unit: FloatArray,
    parity: NDArray[np.int8],
    planes: NDArray[np.uint8],
    nodes: FloatArray,
    rigid: FloatArray,
    share: FloatArray,
) -> FloatArray:
    """Rigid modes, then those of ``pack``, orthonormal in mass, (mode, node, 3).

    Args:
        unit: Of the modes, (mode,).
        parity: 1 for modes that are their own mirror images, -1 for those that are so turned round, 0 for others.
        planes: Bytes, (4, mode, 3, node).
        nodes: At rest [m], (node, 3).
        rigid: Rigid modes, which come first, (mode, node, 3).
        share: Of the mass, at every node, (node,).
    """
    folded = np.ascontiguousarray(np.moveaxis(planes, 0, -1)).view("<u4")[..., 0].astype(np.int64)
    whole = np.cumsum((folded >> 1) ^ -(folded & 1), axis=2)
    modes = stored = (whole * unit[:, None, None]).transpose(0, 2, 1)
    if parity.all():
        image = images(nodes)
        half = np.flatnonzero(image >= np.arange(len(nodes)))
        modes = np.empty((len(unit), len(nodes), 3))
        modes[:, image[half]] = stored * MIRROR * parity[:, None, None]
        modes[:, half] = stored
    weight, modes = np.sqrt(share)[:, None], np.concatenate([rigid, modes])
    flat = orthonormal((weight * modes).reshape(len(modes), -1))
    return flat.reshape(modes.shape) / weight


def _parity(modes: FloatArray, nodes: NDArray[np.floating[Any]], unit: FloatArray) -> NDArray[np.int8]:
    """What the mirror does to every mode, to a rounding: 1 nothing, -1 turns it round, 0 anything else."""
    found = np.zeros(len(modes), dtype=np.int8)
    try:
        image = images(nodes)
    except ValueError:
        return found
    mirrored = modes[:, image] * MIRROR
    for sign in (1, -1):
        found[np.abs(mirrored - sign * modes).max(axis=(1, 2)) <= unit] = sign
    return found
