"""Gradients of neo-Hookean tets in principal axes agree with those by invariants and Warp's differentiation."""

import numpy as np
import pytest
import warp as wp

from softwarp.kernels.algebra import lanes
from softwarp.kernels.elements import access, volumetric_adjoint
from softwarp.kernels.elements import adjoint as of_tets
from softwarp.solvers.workspace import rows

COUNT = 21  # tets, which fill no whole number of registers


@pytest.mark.parametrize("project", [False, True])
@pytest.mark.parametrize(
    "law",
    [
        "neo_hookean",
        *(pytest.param(law, marks=pytest.mark.slow) for law in volumetric_adjoint.LAWS if law != "neo_hookean"),
    ],
)
@pytest.mark.parametrize(
    ("precision", "close"), [("float64", 1e-9), pytest.param("float32", 2e-3, marks=pytest.mark.slow)]
)
def test_both_agree(precision: str, close: float, law: str, project: bool) -> None:
    """Strained so much that half of all tangents have negative eigenvalues, of every kind of mode."""
    variant, rng = lanes.variant("scalar", precision), np.random.default_rng(4)
    real = variant.real

    def held(values: np.ndarray) -> rows.Rows:
        made = rows.allocate(variant, 1, values.size, "cpu")
        made.real.assign(values.reshape(1, -1, 1))
        return made

    def table(values: np.ndarray, dtype: type = real) -> wp.array:
        return wp.array(values, dtype=dtype, device="cpu")

    shape = np.tile(np.eye(3), (COUNT, 1, 1)) + 0.35 * rng.standard_normal((COUNT, 3, 3))
    shape[np.linalg.det(shape) < 0.05] = np.eye(3)
    x = np.concatenate([np.zeros((COUNT, 1, 3)), shape.transpose(0, 2, 1)], axis=1)  # edges at rest are axes
    places, v, p = (held(a) for a in (x, rng.standard_normal(x.shape), rng.standard_normal(x.shape)))
    mu, lam, own, stiffness = (held(np.array([value])) for value in (3.0, 7.0, 0.0, 0.8))
    inputs = [table(np.arange(COUNT), wp.int32), table(np.arange(4 * COUNT).reshape(COUNT, 4), wp.int32)]
    inputs += [table(np.zeros(COUNT), wp.int32), table(np.tile(np.eye(3).ravel(), (COUNT, 1)))]
    inputs.append(table(rng.uniform(0.5, 1.5, COUNT)))
    found = []
    for is_new in (False, True):
        dim: tuple[int, ...]
        corner, parameter = (held(np.zeros(12 * COUNT)) for _ in range(2))
        if is_new:
            kernel = volumetric_adjoint.kernels(variant, law, project).tet_adjoint
            given = [*inputs, mu.S, lam.S, stiffness.S, places.S, v.S, p.S, 0.3]
            dim, outputs = (1, -(-COUNT // access.functions(variant).per_item)), [corner.S, parameter.S]
        else:
            kernel = of_tets.kernels(variant, law, project).tet_adjoint
            given = [*inputs, table(np.zeros(1), wp.int32), mu.real, lam.real, own.real, stiffness.real]
            given += [places.real, v.real, p.real, 0.3]
            dim, outputs = (1, COUNT, 1), [corner.real, parameter.real]
        wp.launch(kernel, dim=dim, inputs=given, outputs=outputs, device="cpu")
        of_parameters = parameter.real.numpy().reshape(COUNT, 12)[:, [0, 1, of_tets.PARAMETERS]]
        found.append((corner.real.numpy().reshape(COUNT, 12), of_parameters))
    for old, new in zip(*found, strict=True):
        scale = np.abs(old).max(axis=1, keepdims=True)
        assert (np.abs(new - old) <= close * scale).all()
