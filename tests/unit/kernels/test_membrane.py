"""Thin triangles: force, tangent, patch test, stress and a glued layer (docs/theory/membrane.md)."""

import numpy as np
import pytest
import warp as wp

from softwarp import meshing
from softwarp.kernels.algebra import lanes
from softwarp.kernels.elements import membrane, spectral
from softwarp.plan.soft import rest_geometry
from softwarp.solvers.workspace import rows
from tests.cases import lame, random_rotation

YOUNGS, NU, THICKNESS = 2.0e6, 0.35, 4.0e-4
VARIANTS = [("scalar", "float64"), ("scalar", "float32"), ("lanes", "float32")]
FIRST = 2  # elements of another kind in front


def sheet(cells=(4, 3), size=(0.04, 0.03), jitter=0.0, rng=None):
    """An irregular flat sheet: nodes (node, 3) in z = 0, triangles, and which nodes lie on its rim."""
    nx, ny = cells
    j, i = (index.ravel() for index in np.indices((ny + 1, nx + 1)))
    nodes = np.stack([i * size[0] / nx, j * size[1] / ny, np.zeros(i.size)], axis=1)
    rim = (i == 0) | (i == nx) | (j == 0) | (j == ny)
    if jitter:
        nodes[~rim, :2] += jitter * rng.uniform(-1.0, 1.0, ((~rim).sum(), 2))
    low = ((i + (nx + 1) * j)[(i < nx) & (j < ny)])[:, None]
    triangles = np.vstack([low + [0, 1, nx + 2], low + [0, nx + 2, nx + 1]])
    return nodes, triangles, rim


class Membrane:
    """Triangles in the workspace of one solver variant."""

    def __init__(self, nodes, triangles, positions, variant=("scalar", "float64"), nu=NU, youngs=YOUNGS):
        self.geometry = meshing.membrane_geometry(nodes, triangles, THICKNESS)
        self.variant = lanes.variant(*variant)
        self.triangles = self.geometry.triangles
        self.count = len(self.triangles)
        self.positions = np.asarray(positions).reshape(-1, len(nodes), 3)
        self.worlds = len(self.positions)
        self.packs, self.lanes = rows.shape(self.variant, self.worlds)
        array = lambda values: wp.array(values, dtype=self.variant.real, device="cpu")  # noqa: E731
        self.model = [
            wp.array(self.triangles, dtype=wp.int32, device="cpu"),
            wp.zeros(self.count, dtype=wp.int32, device="cpu"),
            array(self.geometry.gradient),
            array(self.geometry.volume),
        ]
        self.fields = [self.rows(np.full((self.worlds, 1), value)).S for value in (youngs, nu)]
        self.fields.append(self.rows(self.positions.reshape(self.worlds, -1)).S)

    def rows(self, values):
        result = rows.allocate(self.variant, self.worlds, values.shape[1], "cpu")
        memory = result.real.numpy()
        for world in range(self.worlds):
            memory[world // self.lanes, :, world % self.lanes] = values[world]
        result.real.assign(memory)
        return result

    def launch(self, kernel, inputs, count):
        out = rows.allocate(self.variant, self.worlds, count, "cpu")
        dim = self.variant.dim(out.S.shape[0], self.count)
        wp.launch(kernel, dim, inputs=[*inputs, *self.fields], outputs=[out.S], device="cpu")
        return np.moveaxis(out.real.numpy(), 1, 2).reshape(-1, count)[: self.worlds]

    def force(self):
        """dE/dx [N], (world, node, 3)."""
        kernel = membrane.kernels(self.variant, True).triangle_force
        values = self.launch(kernel, [FIRST, *self.model], 12 * (FIRST + self.count))
        element = values.reshape(self.worlds, -1, 4, 3)[:, FIRST:]
        assert (element[:, :, 3] == 0.0).all()
        total = np.zeros((self.worlds, *self.positions.shape[1:]))
        for world in range(self.worlds):
            np.add.at(total[world], self.triangles.ravel(), element[world, :, :3].reshape(-1, 3))
        return total

    def blocks(self, project):
        """Dense element matrices (world, tri, 9, 9) from the stored lower blocks."""
        kernel = membrane.kernels(self.variant, project).triangle_stiffness
        values = self.launch(kernel, [FIRST, *self.model], 90 * (FIRST + self.count))
        return dense(values.reshape(self.worlds, -1, 10, 3, 3)[:, FIRST:], 3)

    def stress(self):
        """S xx, xy, yy [Pa], (world, tri, 3)."""
        kernel = membrane.kernels(self.variant, True).triangle_stress
        return self.launch(kernel, self.model[:3], 3 * self.count).reshape(self.worlds, self.count, 3)

    def energy(self):
        """Energies [J] by NumPy, (world,)."""
        corner = self.positions[:, self.triangles]
        F = np.einsum("wtbi,tbj->wtij", corner[:, :, 1:] - corner[:, :, :1], self.geometry.gradient.reshape(-1, 2, 2))
        E = 0.5 * (np.swapaxes(F, 2, 3) @ F - np.eye(2))
        trace = np.trace(E, axis1=2, axis2=3)
        psi = YOUNGS / (2.0 * (1.0 + NU)) * (E**2).sum(axis=(2, 3)) + 0.5 * YOUNGS * NU / (1.0 - NU**2) * trace**2
        return (psi * self.geometry.volume).sum(axis=1)


def dense(blocks, corners):
    """Full symmetric element matrices from the blocks a >= b, (..., 3 corners, 3 corners)."""
    K = np.zeros((*blocks.shape[:-3], corners, 3, corners, 3))
    for a in range(corners):
        for b in range(a + 1):
            block = blocks[..., (a * (a + 1)) // 2 + b, :, :]
            K[..., a, :, b, :] = block
            K[..., b, :, a, :] = np.swapaxes(block, -1, -2)
    return K.reshape(*blocks.shape[:-3], 3 * corners, 3 * corners)


def assemble(size, elements, matrices):
    """Global matrix (3 size, 3 size) of element matrices."""
    K = np.zeros((3 * size, 3 * size))
    for nodes, matrix in zip(elements, matrices, strict=True):
        index = (3 * nodes[:, None] + np.arange(3)).ravel()
        K[np.ix_(index, index)] += matrix
    return K


def deformed(rng, nodes, amount=0.15):
    """Nodes turned in space, stretched and shaken by ``amount`` of the element size."""
    F = np.eye(3) + amount * rng.standard_normal((3, 3))
    return nodes @ F.T @ random_rotation(rng).T + 0.01 * amount * rng.standard_normal(nodes.shape)


def test_force_is_energy_gradient(rng):
    """Catalogue 1.1: central differences in float64, 1e-7 of the force."""
    nodes, triangles, _ = sheet(jitter=0.002, rng=rng)
    x, d, step = deformed(rng, nodes), rng.standard_normal(nodes.shape), 1e-7
    case = Membrane(nodes, triangles, [x, x + step * d, x - step * d])
    energy = case.energy()
    slope = (energy[1] - energy[2]) / (2.0 * step)
    assert abs(slope - (case.force()[0] * d).sum()) < 1e-7 * np.linalg.norm(case.force()[0]) * np.linalg.norm(d)


def test_tangent_is_derivative_of_force(rng):
    """Catalogue 1.1: 1e-6, in compression too; each element matrix is symmetric."""
    nodes, triangles, _ = sheet(jitter=0.002, rng=rng)
    for _ in range(3):
        x, d, step = deformed(rng, nodes), rng.standard_normal(nodes.shape), 1e-7
        case = Membrane(nodes, triangles, [x, x + step * d, x - step * d])
        force = case.force()
        matrices = case.blocks(project=False)[0]
        K = assemble(len(nodes), case.triangles, matrices)
        product = (K @ d.ravel()).reshape(-1, 3)
        error = (force[1] - force[2]) / (2.0 * step) - product
        assert np.linalg.norm(error) < 1e-6 * np.linalg.norm(product)
        assert np.abs(matrices - np.swapaxes(matrices, 1, 2)).max() < 1e-12 * np.abs(matrices).max()


def test_projected_tangent_is_semidefinite_and_exact_in_tension(rng):
    """Smallest eigenvalue above -1e-12 of the largest in any state; equal to the exact tangent where S >= 0."""
    nodes, triangles, _ = sheet(jitter=0.002, rng=rng)
    states = [deformed(rng, nodes, 0.3) for _ in range(6)]
    case = Membrane(nodes, triangles, states)
    values = np.linalg.eigvalsh(case.blocks(project=True))
    assert (values[..., 0] > -1e-12 * values[..., -1]).all()
    assert (np.linalg.eigvalsh(case.blocks(project=False))[..., 0] < -1e-3 * values[..., -1]).any()
    taut = Membrane(nodes, triangles, [nodes @ np.diag([1.3, 1.1, 1.0]) @ random_rotation(rng).T])
    exact = taut.blocks(project=False)
    np.testing.assert_allclose(taut.blocks(project=True), exact, atol=1e-12 * np.abs(exact).max())
    rest = Membrane(nodes, triangles, [nodes])
    np.testing.assert_allclose(rest.blocks(project=True), rest.blocks(project=False), atol=1e-6)
    slack = Membrane(nodes, triangles, [0.9 * nodes])
    without = dense_material(slack)
    np.testing.assert_allclose(slack.blocks(project=True)[0], without, atol=1e-10 * np.abs(without).max())


def dense_material(case):
    """B'CB alone: the exact tangent less its geometric part, from the stress that the kernel reports."""
    matrices = case.blocks(project=False)[0].reshape(-1, 3, 3, 3, 3).copy()
    g = case.geometry.gradient.reshape(-1, 2, 2)
    g = np.concatenate([-g.sum(axis=1, keepdims=True), g], axis=1)
    xx, xy, yy = case.stress()[0].T
    S = np.stack([np.stack([xx, xy], axis=1), np.stack([xy, yy], axis=1)], axis=1)
    geometric = np.einsum("tai,tij,tbj->tab", g, S, g) * case.geometry.volume[:, None, None]
    for c in range(3):
        matrices[:, :, c, :, c] -= geometric
    return matrices.reshape(-1, 9, 9)


def test_rigid_motion_is_force_free(rng):
    """Catalogue 1.5: 1e-10 Y h^2 with the element size h."""
    nodes, triangles, _ = sheet(jitter=0.002, rng=rng)
    moved = nodes @ random_rotation(rng).T + [0.3, -0.2, 0.1]
    assert np.abs(Membrane(nodes, triangles, [moved]).force()).max() < 1e-10 * YOUNGS * 0.01**2


def test_turning_turns_the_force(rng):
    """f(Q x) = Q f(x)."""
    nodes, triangles, _ = sheet(jitter=0.002, rng=rng)
    x, Q = deformed(rng, nodes), random_rotation(rng)
    force = Membrane(nodes, triangles, [x, x @ Q.T]).force()
    np.testing.assert_allclose(force[1], force[0] @ Q.T, atol=1e-12 * np.abs(force).max())


def test_patch(rng):
    """Catalogue 1.4: with a linear field on the rim the inner nodes are in balance on it; the stress is constant."""
    nodes, triangles, rim = sheet(jitter=0.002, rng=rng)
    F = np.array([[1.1, 0.2, 0.0], [-0.05, 1.05, 0.0], [0.1, -0.3, 1.0]])
    case = Membrane(nodes, triangles, [nodes @ F.T])
    force = case.force()[0]
    assert np.abs(force[~rim]).max() < 1e-12 * np.abs(force).max()
    gradient = case.geometry.gradient.reshape(-1, 2, 2)
    edges = nodes[case.triangles][:, 1:] - nodes[case.triangles][:, :1]
    axes = np.einsum("tbi,tbj->tij", edges, gradient)  # rest axes of each triangle in space, (tri, 3, 2)
    xx, xy, yy = case.stress()[0].T
    local = np.stack([np.stack([xx, xy], axis=1), np.stack([xy, yy], axis=1)], axis=1)
    S = axes @ local @ np.swapaxes(axes, 1, 2)
    np.testing.assert_allclose(S, np.broadcast_to(S[:1], S.shape), atol=1e-10 * np.abs(S).max())


def test_uniaxial_stress():
    """P = Y a (a^2 - 1)/2 at the stretch a, free sides at the stretch sqrt(1 - nu (a^2 - 1)): no force there."""
    nodes, triangles, _ = sheet()
    for stretch in (0.8, 1.1, 1.4):
        lateral = np.sqrt(1.0 - NU * (stretch**2 - 1.0))
        force = Membrane(nodes, triangles, [nodes * [stretch, lateral, 1.0]]).force()[0]
        end = nodes[:, 0] > 0.039
        expected = 0.5 * YOUNGS * stretch * (stretch**2 - 1.0) * THICKNESS * 0.03
        np.testing.assert_allclose(force[end, 0].sum(), expected, rtol=1e-12)
        assert np.abs(force[:, 1]).max() < 1e-12 * abs(expected)


def test_glued_layer_stiffens_a_bar():
    """nu = 0, pulled along x: k = (Y_b A + Y t s) / L, A = 1 cm^2 and s = 4 cm the perimeter; small strain, 1e-10.

    Element matrices of tets and triangles at rest are summed in one matrix, as the solver does.
    """
    length, side, body_youngs = 0.04, 0.01, 1.0e5
    mesh = meshing.box((length, side, side), (4, 2, 2))
    skin = mesh.surface()
    normal = np.cross(mesh.nodes[skin[:, 1]] - mesh.nodes[skin[:, 0]], mesh.nodes[skin[:, 2]] - mesh.nodes[skin[:, 0]])
    sides = skin[np.abs(normal[:, 0]) < 1e-12]
    layer = Membrane(mesh.nodes, sides, [mesh.nodes], nu=0.0)
    solid = assemble(len(mesh.nodes), mesh.tets, tet_matrices(mesh, body_youngs, 0.0))
    start, end = mesh.nodes[:, 0] < 1e-9, mesh.nodes[:, 0] > length - 1e-9
    section, perimeter = side**2, 4.0 * side
    for K, expected in (
        (solid, body_youngs * section / length),
        (
            solid + assemble(len(mesh.nodes), layer.triangles, layer.blocks(project=True)[0]),
            (body_youngs * section + YOUNGS * THICKNESS * perimeter) / length,
        ),
    ):
        u = np.zeros(mesh.nodes.shape)
        u[end, 0] = 1.0
        held = np.zeros(mesh.nodes.shape, dtype=bool)
        held[start | end, 0] = True
        held[mesh.nodes[:, 1] < 1e-9, 1] = True
        held[mesh.nodes[:, 2] < 1e-9, 2] = True
        free = ~held.ravel()
        u.ravel()[free] = np.linalg.solve(K[np.ix_(free, free)], -(K[free] @ u.ravel()))
        reaction = (K @ u.ravel()).reshape(-1, 3)[end, 0].sum()
        np.testing.assert_allclose(reaction, expected, rtol=1e-10)


def tet_matrices(mesh, youngs, nu):
    """Element matrices (tet, 12, 12) of the St. Venant-Kirchhoff solid at rest, from the solver's kernel."""
    variant = lanes.variant("scalar", "float64")
    gradient, volume, _ = rest_geometry(mesh.nodes, mesh.tets)
    mu, lam = lame(youngs, nu)
    integers = [wp.array(values, dtype=wp.int32, device="cpu") for values in (np.arange(len(mesh.tets)), mesh.tets)]
    body = wp.zeros(len(mesh.tets), dtype=wp.int32, device="cpu")
    reals = [wp.array(values, dtype=wp.float64, device="cpu") for values in (gradient, volume)]
    flat = [np.reshape(values, (1, -1, 1)) for values in ([mu], [lam], [0.0], mesh.nodes)]
    fields = [wp.array(values, dtype=wp.float64, device="cpu") for values in flat]
    fields[-1] = fields[-1].reshape((1, -1))
    out = rows.allocate(variant, 1, 90 * len(mesh.tets), "cpu")
    kernel = spectral.kernels(variant, "st_venant_kirchhoff", False).tet_stiffness
    inputs = [*integers, body, *reals, body[:1], *fields]
    wp.launch(kernel, (1, len(mesh.tets)), inputs=inputs, outputs=[out.S], device="cpu")
    return dense(out.real.numpy().reshape(-1, 10, 3, 3), 4)


@pytest.mark.parametrize("variant", VARIANTS[1:])
def test_variants_agree(rng, variant):
    """float32 against float64, scalar and in lanes: 1e-4 of the largest value at 15 % strain."""
    nodes, triangles, _ = sheet(jitter=0.002, rng=rng)
    states = [deformed(rng, nodes) for _ in range(11)]
    exact, single = Membrane(nodes, triangles, states), Membrane(nodes, triangles, states, variant)
    np.testing.assert_allclose(single.force(), exact.force(), atol=1e-4 * np.abs(exact.force()).max())
    reference = exact.blocks(project=True)
    np.testing.assert_allclose(single.blocks(project=True), reference, atol=1e-4 * np.abs(reference).max())
    np.testing.assert_allclose(single.stress(), exact.stress(), atol=1e-4 * np.abs(exact.stress()).max())


def test_lanes_equal_scalar_to_rounding(rng):
    """1e-6 of the largest value."""
    nodes, triangles, _ = sheet(jitter=0.002, rng=rng)
    states = [deformed(rng, nodes) for _ in range(9)]
    one, eight = (Membrane(nodes, triangles, states, variant) for variant in VARIANTS[1:])
    np.testing.assert_allclose(eight.force(), one.force(), atol=1e-6 * np.abs(one.force()).max())
    matrices = one.blocks(project=True)
    np.testing.assert_allclose(eight.blocks(project=True), matrices, atol=1e-6 * np.abs(matrices).max())


@pytest.mark.parametrize("variant", VARIANTS)
def test_flat_and_collapsed_triangles_give_finite_numbers(variant):
    """At rest, where both principal stresses are equal, and shrunk to a point."""
    nodes, triangles, _ = sheet()
    case = Membrane(nodes, triangles, [nodes, 0.0 * nodes], variant)
    assert np.isfinite(case.force()).all()
    assert np.isfinite(case.blocks(project=True)).all()
