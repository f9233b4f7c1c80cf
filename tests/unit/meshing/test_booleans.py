"""Unions, differences and intersections of surfaces."""

import importlib.util

import pytest
import trimesh

from softwarp import meshing
from softwarp.meshing import MeshError

ONE, TWO = trimesh.creation.box((0.2, 0.1, 0.1)), trimesh.creation.box((0.1, 0.1, 0.1))
TWO.apply_translation((0.1, 0.02, 0.02))
COMMON = 0.05 * 0.08 * 0.08


@pytest.mark.parametrize(
    ("operation", "volume"),
    [("union", 0.002 + 0.001 - COMMON), ("difference", 0.002 - COMMON), ("intersection", COMMON)],
)
def test_volumes(operation, volume):
    """Of two boxes that overlap by 0.05 x 0.08 x 0.08 m; the result can be filled."""
    pytest.importorskip("manifold3d")
    surface = getattr(meshing, operation)(ONE, TWO)
    assert surface.name == operation
    assert meshing.surface_volume(surface.nodes, surface.triangles) == pytest.approx(volume, rel=1e-6)
    assert meshing.tetrahedralize(surface, edge_length=0.01).volume == pytest.approx(volume, rel=0.05)


def test_a_difference_with_something_inside_leaves_a_cavity():
    pytest.importorskip("manifold3d")
    hole = trimesh.creation.icosphere(2, radius=0.03)
    solid = meshing.tetrahedralize(meshing.difference(ONE, hole), edge_length=0.01)
    assert solid.cavities["cavity 0"].volume == pytest.approx(hole.volume, rel=0.1)


def test_refusals(monkeypatch):
    far = TWO.copy()
    far.apply_translation((1.0, 0.0, 0.0))
    if importlib.util.find_spec("manifold3d") is not None:
        with pytest.raises(MeshError, match="the intersection of 2 surfaces is empty"):
            meshing.intersection(ONE, far)
        with pytest.raises(MeshError, match="'union, surface 1' is open"):
            meshing.union(ONE, (TWO.vertices, TWO.faces[1:]))
    with pytest.raises(MeshError, match="takes two surfaces or more, got 1"):
        meshing.union(ONE)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ImportError, match=r'needs the package manifold3d; .*"softwarp\[mesh\]"'):
        meshing.union(ONE, TWO)
