"""Factors of the modulus, element by element."""

import numpy as np
import pytest

import softwarp as sw
from softwarp import meshing


@pytest.mark.parametrize("element", ["p1", "p2"])
def test_factors_of_the_modulus_are_those_of_another_material(element):
    """All alike they are a modulus, and mass stays; materials in a row are springs in a row: sum of F L / (E A)."""

    def stretch(youngs, stiffness):
        x = np.linspace(0.0, 0.1, 5)
        nodes = np.array([(a, b, c) for a in x for b in (0.0, 0.02) for c in (0.0, 0.02)])
        cells = []
        for i in range(4):
            a = 4 * i
            cube = [a, a + 1, a + 2, a + 3, a + 4, a + 5, a + 6, a + 7]
            for p, q in ((1, 3), (3, 2), (2, 6), (6, 4), (4, 5), (5, 1)):
                cells.append((cube[0], cube[p], cube[q], cube[7]))
        cells = np.array(cells)
        volume = meshing.tet_volumes(nodes, cells)
        cells[volume < 0.0] = cells[volume < 0.0][:, [0, 2, 1, 3]]
        builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
        body = builder.add_tets(
            nodes,
            cells,
            material=sw.Corotational(youngs, 0.0),
            density=1000.0,
            element=element,
            stiffness=None if stiffness is None else np.repeat(stiffness, 6),
        )
        builder.fix(body, box=((-1e-9, -1.0, -1.0), (1e-9, 1.0, 1.0)))
        builder.add_traction(body, (100.0, 0.0, 0.0), box=((0.1 - 1e-9, -1.0, -1.0), (0.1 + 1e-9, 1.0, 1.0)))
        builder.add_marker(body, (0.1, 0.0, 0.0))
        sim = sw.Simulation(builder.finalize(1, "cpu", "float64"))
        mass = float(sim.model.node_volume.numpy().sum())
        assert sim.solve_static().converged.all()
        return float(sim.marker_x[0, 0, 0]) - 0.1, mass

    plain, mass = stretch(2.0e5, None)
    assert plain == pytest.approx(100.0 / 2.0e5 * 0.1, rel=1e-6)
    alike, same_mass = stretch(1.0e5, np.full(4, 2.0))
    assert alike == pytest.approx(plain, rel=1e-9) and same_mass == mass
    row, _ = stretch(1.0e5, np.array([1.0, 1.0, 2.0, 4.0]))
    assert row == pytest.approx(100.0 / 1.0e5 * 0.025 * (1.0 + 1.0 + 0.5 + 0.25), rel=1e-6)


@pytest.mark.parametrize(
    "bad",
    [
        np.ones(3),
        -np.ones(720),
        np.full(720, np.nan),
        np.ones((720, 3)),
        "soft",
        {},
        np.ones(720, dtype=complex),
        np.full(720, 1e300),
    ],
)
def test_factors_are_refused(bad):
    with pytest.raises(ValueError, match="stiffness must be positive and finite, of shape"):
        sw.ModelBuilder().add_tets(
            meshing.diamond("coarse"),
            material=sw.Corotational(1.0e5, 0.45),
            density=1000.0,
            element="p2",
            stiffness=bad,
        )
