"""From hexahedra of a scene to their arrays. Host only. Theory: docs/theory/hexahedral.md."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softwarp.meshing.hexes import CORNERS, SIGNS, node_volumes, shape_gradients, split
from softwarp.meshing.tets import tet_volumes
from softwarp.model.hexes import HexLayout, HexModel
from softwarp.plan.structure import Elements, Structure
from softwarp.scene.parts import Scene

IntArray = NDArray[np.int32]
FloatArray = NDArray[np.float64]
SAME = 1e-11  # of the longest edge: hexahedra that differ by less share a shape
GAUSS = SIGNS / np.sqrt(3.0), np.ones(len(SIGNS))  # points and weights in natural coordinates
_LINE = [(-np.sqrt(0.6), 5.0 / 9.0), (0.0, 8.0 / 9.0), (np.sqrt(0.6), 5.0 / 9.0)]
_CUBE = list(itertools.product(_LINE, repeat=3))
FINE = np.array([[x for x, _ in p] for p in _CUBE]), np.array([np.prod([w for _, w in p]) for p in _CUBE])
# Displacements of the modes of walls, zeta being across: z (1 - x^2), z (1 - y^2), x - x^3, y - y^3, x (1 - z^2) and
# y (1 - z^2), and the natural axis along which each one goes
WALL_MODES = {"bent_x": 0, "bent_y": 1, "lifted_x": 2, "lifted_y": 2, "swollen_x": 2, "swollen_y": 2}
PAIRS = [(a, b) for a in range(CORNERS) for b in range(a + 1)]


def hex_layout(scene: Scene, node_start: IntArray) -> HexLayout:
    """Number the hexahedra body after body."""
    found = [(i, b, b.hexes) for i, b in enumerate(scene.bodies) if b.hexes is not None]
    nodes, lumped = [np.empty((0, CORNERS), dtype=np.int32)], [np.empty((0, CORNERS))]
    factor, thin = [np.empty(0)], [np.empty(0, dtype=bool)]
    for i, spec, hexes in found:
        nodes.append(hexes + node_start[i])
        volumes = node_volumes(spec.mesh.nodes, hexes)
        if spec.lumping == "uniform":
            counts = np.bincount(hexes.ravel(), minlength=len(spec.mesh.nodes))
            volumes = (volumes.sum() / len(spec.mesh.nodes) / counts)[hexes]
        lumped.append(volumes)
        factor.append(np.ones(len(hexes)) if spec.stiffness is None else spec.stiffness)
        thin.append(np.zeros(len(hexes), dtype=bool) if spec.thin is None else spec.thin)
    return HexLayout(
        nodes=np.concatenate(nodes).astype(np.int32),
        body=np.repeat([i for i, _, _ in found], [len(part) for part in nodes[1:]]).astype(np.int32),
        lumped=np.concatenate(lumped),
        factor=np.concatenate(factor),
        thin=np.concatenate(thin),
    )


def hex_elements(layout: HexLayout) -> list[Elements]:
    """Hexahedra as elements; nothing without any."""
    return [Elements("hex", layout.nodes, np.arange(len(layout.nodes)))] if len(layout.nodes) else []


def hex_model(layout: HexLayout, nodes: FloatArray, found: Structure) -> HexModel | None:
    """Hexahedra and their shapes; None without any."""
    if len(layout.nodes) == 0:
        return None
    x = own_corners(nodes[layout.nodes])
    grid = SAME * np.abs(x).max()
    keys = np.column_stack([layout.body, layout.thin, np.round(x.reshape(len(x), -1) / grid)])
    _, first, shape = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    pieces = split(layout.nodes)
    return HexModel(
        layout=layout,
        hex_node=layout.nodes,
        hex_body=layout.body,
        hex_shape=shape.reshape(-1).astype(np.int32),
        hex_factor=layout.factor,
        hex_volume=node_volumes(nodes, layout.nodes).sum(axis=1),
        shape_body=layout.body[first],
        piece_node=pieces,
        piece_size=tet_volumes(nodes, pieces),
        **vars(shape_arrays(x[first], layout.thin[first])),
        **vars(hex_lists(layout, found)),
    )


@dataclass(frozen=True)
class HexLists:
    """Where blocks and forces go, under the names that ``HexModel`` declares."""

    entry_start: IntArray
    entry: IntArray
    hex_block: IntArray
    carried_block: IntArray
    carried_start: IntArray
    carried_entry: IntArray
    held_node: IntArray
    held_start: IntArray
    held_entry: IntArray


def hex_lists(layout: HexLayout, found: Structure) -> HexLists:
    """Lists of the structure of A."""
    kept = found.lists["hex"]
    block = np.repeat(np.arange(len(kept.start) - 1), np.diff(kept.start))
    element, a, b = kept.entry >> 6, (kept.entry >> 3) & 7, kept.entry & 7
    high, low = np.maximum(a, b), np.minimum(a, b)
    places = np.full((len(layout.nodes), len(PAIRS)), -1, dtype=np.int32)
    places[element, high * (high + 1) // 2 + low] = 2 * block + (a < b)
    return HexLists(
        entry_start=kept.start,
        entry=kept.entry,
        hex_block=places,
        carried_block=kept.carried.target,
        carried_start=kept.carried.start,
        carried_entry=kept.carried.entry,
        held_node=kept.held.target,
        held_start=kept.held.start,
        held_entry=kept.held.entry,
    )


def own_corners(x: FloatArray) -> FloatArray:
    """Corners of hexahedra (hex, 8, 3) from the first, in axes of their own: along xi at the centre, and near eta."""
    edges = np.einsum("nac,ak->nkc", x, SIGNS / 8.0)  # rows dx/dxi_k
    e1 = edges[:, 0] / np.linalg.norm(edges[:, 0], axis=1, keepdims=True)
    e3 = np.cross(e1, edges[:, 1])
    e3 /= np.linalg.norm(e3, axis=1, keepdims=True)
    axes = np.stack([e1, np.cross(e3, e1), e3], axis=1)
    return np.asarray(np.einsum("nkc,nac->nak", axes, x - x[:, :1]))


@dataclass(frozen=True)
class ShapeArrays:
    """Shapes, under the names that ``HexModel`` declares."""

    shape_x: FloatArray
    shape_gradient: FloatArray
    shape_mu: FloatArray
    shape_lam: FloatArray
    mode_mu: FloatArray
    mode_lam: FloatArray
    mode_ratio: FloatArray


def shape_arrays(x: FloatArray, thin: NDArray[np.bool_] | None = None) -> ShapeArrays:
    """Stiffness per Lame constant of corners and incompatible modes, for shapes with the corners ``x`` (shape, 8, 3).

    With K_uu, K_ui and K_ii linear in mu and lam, modes p that make p' K_ii p = mu + lam s diagonal leave

        K = K_uu - sum over modes of (mu a + lam b) (mu a + lam b)' / (mu + lam s).

    Args:
        x: Corners [m].
        thin: Which have the modes of walls, (shape,); none by default.
    """
    is_thin = np.zeros(len(x), dtype=bool) if thin is None else thin
    end, count = 3 * CORNERS, 15 if is_thin.any() else 9
    rows = {"mode_mu": (count, end), "mode_lam": (count, end), "mode_ratio": (count,)}
    result = {name: np.zeros((len(x), *shape)) for name, shape in rows.items()}  # modes that a shape has not stay 0
    result |= {name: np.zeros((len(x), len(PAIRS) * 9)) for name in ("shape_mu", "shape_lam")}
    for of_walls in np.unique(is_thin):
        chosen = np.flatnonzero(is_thin == of_walls)
        mu, lam = _work(x[chosen], bool(of_walls))
        root = np.linalg.inv(np.linalg.cholesky(mu[:, end:, end:]))
        ratio, turned = np.linalg.eigh(root @ lam[:, end:, end:] @ root.swapaxes(1, 2))
        modes, kept = root.swapaxes(1, 2) @ turned, ratio.shape[1]
        result["shape_mu"][chosen], result["shape_lam"][chosen] = _blocks(mu), _blocks(lam)
        result["mode_mu"][chosen, :kept] = (mu[:, :end, end:] @ modes).swapaxes(1, 2)
        result["mode_lam"][chosen, :kept] = (lam[:, :end, end:] @ modes).swapaxes(1, 2)
        result["mode_ratio"][chosen, :kept] = ratio
    gradient, volume = np.zeros((len(x), CORNERS, 3)), np.zeros(len(x))
    for point, share in zip(*GAUSS, strict=True):
        natural = shape_gradients(point)
        jacobian = x.transpose(0, 2, 1) @ natural
        weight = share * np.linalg.det(jacobian)
        gradient += weight[:, None, None] * (natural @ np.linalg.inv(jacobian))
        volume += weight
    flat = {name: array.reshape(len(x), -1) for name, array in result.items()}
    mean = (gradient / volume[:, None, None]).reshape(len(x), -1)
    return ShapeArrays(shape_x=x.reshape(len(x), -1), shape_gradient=mean, **flat)


def _work(x: FloatArray, of_walls: bool) -> tuple[FloatArray, FloatArray]:
    """Integrals of 2 eps_a : eps_b and of tr eps_a tr eps_b over corners and modes, both (shape, 24 + m, 24 + m)."""
    centre = x.transpose(0, 2, 1) @ shape_gradients(np.zeros(3))
    along = (centre / np.linalg.norm(centre, axis=1, keepdims=True)).swapaxes(1, 2)  # rows along xi_k
    count = 3 * CORNERS + 9 + len(WALL_MODES) * of_walls
    shear, trace = np.zeros((2, len(x), count, count))
    for point, share in zip(*(FINE if of_walls else GAUSS), strict=True):
        natural = shape_gradients(point)
        jacobian = x.transpose(0, 2, 1) @ natural
        weight = share * np.linalg.det(jacobian)
        # modes' gradients have the mean 0 with the Jacobian of the centre (Taylor et al. 1976)
        ratio = (share * np.linalg.det(centre) / weight)[:, None, None]
        back = ratio * np.linalg.inv(centre)
        scalars = np.concatenate([natural @ np.linalg.inv(jacobian), np.diag(-2.0 * point) @ back], axis=1)
        parts = np.einsum("nak,ij->naijk", scalars, np.eye(3)).reshape(len(x), 3 * CORNERS + 9, 3, 3)
        if of_walls:
            bent = _wall_gradients(point) @ back
            extra = np.einsum("nmi,nmk->nmik", along[:, list(WALL_MODES.values())], bent)
            parts = np.concatenate([parts, extra], axis=1)
        flat = (parts + parts.swapaxes(2, 3)).reshape(len(x), count, 9)
        sums = parts.trace(axis1=2, axis2=3)
        shear += 0.5 * weight[:, None, None] * (flat @ flat.swapaxes(1, 2))
        trace += weight[:, None, None] * sums[:, :, None] * sums[:, None]
    return shear, trace


def _wall_gradients(point: FloatArray) -> FloatArray:
    """Natural gradients of the modes of walls, less what would be a mean shear of the thickness, (mode, 3)."""
    x, y, z = point
    third = 1.0 / 3.0
    return np.array(
        [
            [-2.0 * x * z, 0.0, 1.0 - x * x],
            [0.0, -2.0 * y * z, 1.0 - y * y],
            [1.0 - 3.0 * x * x, 0.0, 0.0],
            [0.0, 1.0 - 3.0 * y * y, 0.0],
            [third - z * z, 0.0, -2.0 * x * z],
            [0.0, third - z * z, -2.0 * y * z],
        ]
    )


def stiffness(arrays: ShapeArrays, mu: float, lam: float) -> FloatArray:
    """K of shapes with incompatible modes [N/m], (shape, 24, 24)."""
    blocks = mu * arrays.shape_mu + lam * arrays.shape_lam
    result = np.zeros((len(blocks), CORNERS, 3, CORNERS, 3))
    for (a, b), block in zip(PAIRS, np.moveaxis(blocks.reshape(len(blocks), -1, 3, 3), 1, 0), strict=True):
        result[:, a, :, b] = block
        result[:, b, :, a] = block.swapaxes(1, 2)
    modes = (mu * arrays.mode_mu + lam * arrays.mode_lam).reshape(len(blocks), -1, 3 * CORNERS)
    weighted = modes / (mu + lam * arrays.mode_ratio)[..., None]
    size = 3 * CORNERS
    return np.asarray(result.reshape(-1, size, size) - modes.swapaxes(1, 2) @ weighted)


def _blocks(matrix: NDArray[Any]) -> FloatArray:
    """Blocks (a, b), a >= b, of the corners, row by row, (shape, 324)."""
    parts = [matrix[:, 3 * a : 3 * a + 3, 3 * b : 3 * b + 3].reshape(len(matrix), 9) for a, b in PAIRS]
    return np.concatenate(parts, axis=1)
