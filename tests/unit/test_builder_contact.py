"""What ``add_contact`` and ``finalize`` refuse, and overlaps that a scene may start with."""

import numpy as np
import pytest

import softwarp as sw
from tests.contact_cases import pair, run


def test_deep_overlap_is_refused() -> None:
    """Bodies that overlap by more than a radius at the start: an error with their names and the depth."""
    builder = sw.ModelBuilder()
    a = builder.add_rigid(sw.Sphere(0.1), density=1000, name="left ball")
    b = builder.add_rigid(sw.Sphere(0.1), density=1000, pose=(0.05, 0, 0), name="right ball")
    builder.add_contact(a, b)
    with pytest.raises(ValueError, match=r"left ball.*right ball.*0\.15 m"):
        builder.finalize()


def test_shallow_overlap_is_pushed_apart() -> None:
    """1 cm of overlap shrinks at the recovery speed, then with the recovery time, and throws nothing into the air."""
    options = {"recovery_speed": 0.2, "recovery_time": 0.02}
    sim, body, _ = pair(sw.Plane(), sw.Sphere(0.05), (0, 0, 0.04), options=options)
    heights = [float(sim.body_pose[0, body, 2])]
    for _ in range(40):
        run(sim, 1)
        heights.append(float(sim.body_pose[0, body, 2]))
    rises = np.diff(heights)
    assert rises.max() == pytest.approx(0.002, rel=1e-6)
    assert heights[-1] == pytest.approx(0.05, abs=1e-6)
    assert max(heights) < 0.05 + 1e-9


def test_unknown_parts_and_values_are_named() -> None:
    """Parts that do not exist, pairs given twice, laws outside their ranges: errors that say which."""
    builder = sw.ModelBuilder()
    ground = builder.add_rigid(sw.Plane(), kinematic=True)
    ball = builder.add_rigid(sw.Sphere(0.1), density=1000, pose=(0, 0, 1), name="ball")
    bare = builder.add_rigid(mass=1.0, inertia=(1, 1, 1), name="bare")
    with pytest.raises(ValueError, match="rigid body 7 does not exist; the builder has 3"):
        builder.add_contact(ball, type(ball)(7))
    with pytest.raises(ValueError, match=r"0 \.\. -1"):
        builder.add_contact(ball, 3)
    for wrong, value in (
        ("mu", -0.1),
        ("mu", np.nan),
        ("restitution", 1.5),
        ("compliance", -1.0),
        ("contact_distance", np.inf),
    ):
        with pytest.raises(ValueError, match=f"'ball - .*{wrong}"):
            builder.add_contact(ball, ground, **{wrong: value})
    builder.add_contact(ball, ground)
    with pytest.raises(ValueError, match="exists already"):
        builder.add_contact(ground, ball)
    model = builder.finalize()
    with pytest.raises(ValueError, match="no contact pair"):
        sw.Simulation(model).contact_force(ball, bare)
    with pytest.raises(ValueError, match="contact_capacity"):
        builder.finalize(contact_capacity=0)
    builder.add_contact(bare, ball)
    with pytest.raises(ValueError, match="'bare' has no shape"):
        builder.finalize()


def test_planes_cannot_touch_each_other() -> None:
    builder = sw.ModelBuilder()
    a = builder.add_rigid(sw.Plane(), kinematic=True, name="floor")
    b = builder.add_rigid(sw.Plane(), kinematic=True, name="wall", pose=(0, 0, 0, 0, np.sin(0.5), 0, np.cos(0.5)))
    builder.add_contact(a, b)
    with pytest.raises(ValueError, match="floor and wall"):
        builder.finalize()
