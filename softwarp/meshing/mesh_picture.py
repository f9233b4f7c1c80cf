"""Pictures of a solid: its surface, and a cut through the middle where each element has the colour of its angle."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from softwarp.io.atomic import atomic_path
from softwarp.meshing.lattice import Family, crossings
from softwarp.meshing.tets import FloatArray, IntArray, TetMesh, boundary, min_dihedral

TURN, TILT = 35.0, 25.0  # degree; of the view about the vertical and above the horizon
MARGIN = 0.06  # of a view that stays empty on each side
LINE = 0.7  # pixels from an edge within which it is drawn
PLAIN = np.array([0.72, 0.77, 0.84])
RAMP = np.array([[0.80, 0.16, 0.14], [0.97, 0.78, 0.30], [0.25, 0.55, 0.66]])  # at 0, HALF and twice that
HALF = 20.0  # degree
FORMATS = (".png", ".jpg", ".jpeg")


def write(mesh: TetMesh, path: Path, size: int) -> Path:
    """Write both views side by side; see ``SolidMesh.picture``.

    Raises:
        ValueError: If the file ends in no format of pictures.
    """
    from PIL import Image, ImageDraw

    if path.suffix.lower() not in FORMATS:
        raise ValueError(f"picture {path.name!r}: must end in {', '.join(FORMATS)}")
    turn, tilt = np.radians([TURN, TILT])
    right = np.array([np.cos(turn), np.sin(turn), 0.0])
    toward = np.array([np.sin(turn) * np.cos(tilt), -np.cos(turn) * np.cos(tilt), np.sin(tilt)])
    axes = np.stack([right, np.cross(toward, right), toward])
    low, high = mesh.bounds
    centre = 0.5 * (low + high)
    local = (mesh.nodes - centre) @ axes.T
    extent = float(np.abs(local[:, :2]).max()) * 2.0
    pixels = local * (size * (1.0 - 2.0 * MARGIN) / extent)

    angle = min_dihedral(mesh.nodes, mesh.tets)
    across = (mesh.nodes[mesh.tets].mean(axis=1) - centre) @ np.append(toward[:2], 0.0)
    views = []
    for kept, colored in ((np.ones(len(angle), dtype=bool), False), (across < 0.0, True)):
        skin, owner = boundary(mesh.tets[kept], mesh.name)
        corner = pixels[skin, :2]
        one, two = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
        ahead = one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0] > 0.0
        skin, owner = skin[ahead], owner[ahead]
        color = _colors(angle[kept][owner]) if colored else np.broadcast_to(PLAIN, (len(owner), 3))
        views.append(_view(pixels, skin, color, size))
    image = Image.fromarray(np.concatenate(views, axis=1))
    draw = ImageDraw.Draw(image)
    told = f"{mesh.name}: {len(mesh.nodes)} nodes, {len(mesh.tets)} tetrahedra"
    draw.text((12, 10), told, fill=(40, 40, 40))
    draw.text((size + 12, 10), f"smallest angle of an element: {angle.min():.1f} degrees at worst", fill=(40, 40, 40))
    for step in range(201):
        red, green, blue = (int(255.0 * c) for c in _colors(np.array([2.0 * HALF * step / 200.0]))[0])
        draw.line([(size + 12 + step, 28), (size + 12 + step, 36)], fill=(red, green, blue))
    draw.text((size + 12, 40), "0", fill=(40, 40, 40))
    draw.text((size + 190, 40), f"{2.0 * HALF:g}", fill=(40, 40, 40))
    with atomic_path(path) as scratch:
        image.save(scratch)
    return path


def _colors(angle: FloatArray) -> FloatArray:
    """Colours of smallest angles [degree], shape (n, 3)."""
    at = np.clip(angle / HALF, 0.0, 2.0)
    return np.stack([np.interp(at, [0.0, 1.0, 2.0], RAMP[:, k]) for k in range(3)], axis=-1)


def _view(pixels: FloatArray, triangles: IntArray, color: FloatArray, size: int) -> NDArray[np.uint8]:
    """One picture (size, size, 3) of triangles, seen against the third axis, with their edges."""
    lines = crossings(Family(np.eye(3), 0.0, 1.0), pixels, triangles)
    image = np.ones((size, size, 3))
    last = np.flatnonzero(np.append((lines.line[1:] != lines.line[:-1]).any(axis=1), True))  # nearest on each line
    line, triangle = lines.line[last], lines.triangle[last]
    corner = pixels[triangles[triangle]]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    light = np.array([0.35, 0.55, 0.76])
    shade = 0.45 + 0.55 * np.abs(normal @ light)
    edge = np.full(len(line), np.inf)
    for k in range(3):
        a, b = corner[:, k, :2], corner[:, (k + 1) % 3, :2]
        way = b - a
        apart = way[:, 0] * (line[:, 1] - a[:, 1]) - way[:, 1] * (line[:, 0] - a[:, 0])
        edge = np.minimum(edge, np.abs(apart) / np.maximum(np.linalg.norm(way, axis=1), 1e-12))
    shade = np.where(edge < LINE, 0.55 * shade, shade)
    column, row = line[:, 0] + size // 2, size // 2 - 1 - line[:, 1]
    inside = (column >= 0) & (column < size) & (row >= 0) & (row < size)
    image[row[inside], column[inside]] = (color[triangle] * shade[:, None])[inside]
    return np.asarray(255.0 * np.clip(image, 0.0, 1.0), dtype=np.uint8)
