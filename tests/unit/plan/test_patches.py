"""Elements in patches: every one once, its corners as far apart as its nodes are, and fewer rows than by elements."""

import numpy as np
import pytest

from softwarp import meshing
from softwarp.model.codes import CHUNK_ROWS
from softwarp.plan.patches import chunks

BLOCK = meshing.box((0.06, 0.04, 0.03), (6, 4, 3))


def kinds(part):
    """Some tets and surface triangles of a block."""
    draws = np.random.default_rng(3)
    tets, faces = BLOCK.tets, BLOCK.surface()
    return [of[np.sort(draws.permutation(len(of))[: int(part * len(of))])] for of in (tets, faces)]


@pytest.mark.parametrize("part", [1.0, 0.2])
def test_chunks_hold_every_element_once_with_its_corners(part):
    given = kinds(part)
    found = chunks(given)
    for kind, corners in enumerate(given):
        there = np.concatenate([chunk.elements[kind] for chunk in found])
        assert sorted(there) == list(range(len(corners)))
        for chunk in found:
            assert 3 * len(chunk.node) <= CHUNK_ROWS
            apart = BLOCK.nodes[chunk.node] - BLOCK.nodes[chunk.against]
            place = np.concatenate([apart, np.zeros((1, 3))])[chunk.corners[kind]]
            own = BLOCK.nodes[corners[chunk.elements[kind]]]
            np.testing.assert_allclose(place - place[:, :1], own - own[:, :1], atol=1e-15)
    rows = 3 * sum(len(chunk.node) for chunk in found)
    assert rows < (0.3 if part == 1.0 else 0.85) * (9 * len(given[0]) + 6 * len(given[1]))


def test_elements_apart_share_chunks():
    """Tets without common nodes: three rows for every later corner, as many tets to a chunk as there is room for."""
    tets = np.arange(4 * 40).reshape(40, 4)
    found = chunks([tets, np.empty((0, 3), dtype=np.int32)])
    assert sum(3 * len(chunk.node) for chunk in found) == 9 * 40
    assert len(found) == -(-40 // (CHUNK_ROWS // 9))


def test_a_body_without_elements_has_no_chunks():
    assert chunks([np.empty((0, 4), dtype=np.int32), np.empty((0, 3), dtype=np.int32)]) == []
