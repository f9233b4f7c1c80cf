"""Where contacts are expected: near the other part most of them, and nowhere that does not move."""

import numpy as np
import pytest

import softwarp as sw
from softwarp import meshing
from softwarp.plan.compile import _layouts
from softwarp.plan.contact import SOFT_CONTACTS
from softwarp.plan.touching import NEAR, expected_touch

MATERIAL = sw.Corotational(1e5, 0.4)


def bar(builder: sw.ModelBuilder, below: float = 0.0) -> int:
    """A bar of 20 x 2 x 2 cells that is held at one end."""
    mesh = meshing.box((0.6, 0.06, 0.06), (20, 2, 2))
    body = builder.add_tets(
        meshing.TetMesh(mesh.nodes - [0.0, 0.0, below], mesh.tets, "bar"), material=MATERIAL, density=1000.0
    )
    builder.fix(body, box=((-1.0, -1.0, -1.0), (1e-6, 1.0, 1.0)))
    return body


def expected(builder: sw.ModelBuilder) -> np.ndarray:
    parts = _layouts(builder.scene)
    return expected_touch(builder.scene, parts.soft, parts.frames)


def test_most_are_near_the_other_part() -> None:
    """A block under the end of a bar: three quarters at the nodes nearest to it, the others all over the skin."""
    builder = sw.ModelBuilder()
    body = bar(builder)
    block = builder.add_rigid(sw.Box((0.1, 0.1, 0.1)), kinematic=True, pose=(0.57, 0.03, -0.051))
    builder.add_contact(body, block)
    touch = expected(builder)
    x = builder.bodies[body].mesh.nodes
    nodes, frames = touch[: len(x)], touch[len(x) :]
    assert touch.sum() == pytest.approx(1.0)
    assert not frames.any()
    assert not nodes[x[:, 0] == 0.0].any()  # held
    inside = ((x > 1e-6) & (x < np.array([0.6, 0.06, 0.06]) - 1e-6)).all(axis=1)
    assert not nodes[inside].any()
    away = np.linalg.norm(np.maximum(np.abs(x - [0.57, 0.03, -0.051]) - 0.05, 0.0), axis=1)
    skin = (x[:, 0] > 0.0) & ~inside
    near = skin & (away <= np.sort(away[skin])[SOFT_CONTACTS - 1])
    assert nodes[near].sum() == pytest.approx(NEAR + (1.0 - NEAR) * near.sum() / skin.sum())
    np.testing.assert_allclose(nodes[skin & ~near], (1.0 - NEAR) / skin.sum())


def test_all_count_alike_where_all_are_as_near() -> None:
    """On a turned floor, and where a bar touches itself."""
    for turned in (True, False):
        builder = sw.ModelBuilder()
        body = bar(builder)
        if turned:  # about x by a quarter: the bar lies inside the half space
            pose = (0.0, 0.1, 0.0, np.sqrt(0.5), 0.0, 0.0, -np.sqrt(0.5))
            builder.add_contact(body, builder.add_rigid(sw.Plane(), kinematic=True, pose=pose))
        else:
            builder.add_contact(body, body)
        touch = expected(builder)
        assert np.unique(touch[touch > 0.0].round(9)).size == 1


def test_both_ends_of_soft_parts_and_rods_count() -> None:
    """Two bars have an end of every contact each; so have a bar and a rod, whose rotations have none."""
    builder = sw.ModelBuilder()
    upper, lower = bar(builder), bar(builder, below=0.1)
    builder.add_contact(upper, lower)
    touch, count = expected(builder), len(builder.bodies[upper].mesh.nodes)
    assert touch[:count].sum() == pytest.approx(1.0)
    assert touch[count:].sum() == pytest.approx(1.0)
    rod = builder.add_rod(np.linspace([0.0, 0.03, 0.1], [0.6, 0.03, 0.1], 11), radius=0.005, youngs=1e6)
    builder.add_contact(upper, rod)
    touch = expected(builder)
    assert touch.sum() == pytest.approx(2.0)
    assert touch[2 * count :].sum() == pytest.approx(0.5)
    assert not touch[2 * count + 1 :: 2].any()
