"""Results that are kept: of the same arrays only, and of a few calls."""

import numpy as np

from softwarp import meshing
from softwarp.remembered import Remembered


def test_what_was_found_is_found_again_of_the_same_values_only() -> None:
    """By values, shapes and types; what was asked for longest ago is made again."""
    made: list[float] = []
    remembered: Remembered[float] = Remembered(2)

    def ask(array: np.ndarray, number: float = 1.0) -> float:
        return remembered(lambda: made.append(number) or float(array.sum()), array, number)

    x = np.arange(6.0)
    assert ask(x) == ask(x.copy()) == 15.0 and len(made) == 1
    ask(x, 2.0)
    ask(x)
    assert len(made) == 2
    ask(x.reshape(2, 3))  # the third one: that with 2.0 goes
    ask(x)
    assert len(made) == 3
    ask(x, 2.0)
    ask(x.astype(np.float32))
    assert len(made) == 5


def test_points_are_embedded_again_where_the_mesh_has_changed() -> None:
    """And who writes to what was found changes nothing for the next one."""
    mesh = meshing.box((0.1, 0.1, 0.1), (2, 2, 2))
    point = np.array([[0.03, 0.06, 0.05]])
    tet, weight = meshing.embed(mesh.nodes, mesh.tets, point)
    kept = weight.copy()
    weight[:] = tet[:] = 0
    again = meshing.embed(mesh.nodes, mesh.tets, point)
    np.testing.assert_array_equal(again[1], kept)
    moved = meshing.embed(mesh.nodes + 0.001, mesh.tets, point)
    assert np.abs(moved[1] - kept).max() > 1e-3
    np.testing.assert_allclose((moved[1][0, :, None] * (mesh.nodes + 0.001)[mesh.tets[moved[0][0]]]).sum(0), point[0])
