"""Air chambers: volume, row, tangent and laws of control (catalogue 3.2; docs/theory/cavity.md)."""

from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp

from softwarp import meshing
from softwarp.kernels.algebra import lanes, team
from softwarp.kernels.rows import cavity
from softwarp.model.codes import CAVITY_CONTROLS, UNBOUNDED
from softwarp.solvers.workspace import rows

CUBE = np.array([[x, y, z] for z in (0.0, 1.0) for y in (0.0, 1.0) for x in (0.0, 1.0)])
OCTAHEDRON = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], dtype=float)
CUBE_TRIANGLES = meshing.box((1.0, 1.0, 1.0), (1, 1, 1)).surface()
OCTAHEDRON_TRIANGLES = np.array(
    [[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]]
)
VARIANTS = [("scalar", "float64"), ("scalar", "float32"), ("lanes", "float32")]


def blob(rng, cells=(3, 2, 2)):
    """A bumpy closed surface: the skin of a box with its vertices shifted."""
    mesh = meshing.box((0.03, 0.02, 0.02), cells)
    used, triangles = meshing.compact(mesh.nodes, mesh.surface())
    return used + 0.002 * rng.standard_normal(used.shape), triangles


class Chambers:
    """Closed surfaces on nodes of their own in the workspace of one solver variant.

    ``positions`` (world, node, 3) are the nodes; the points of the chambers are carried as ``point_node`` and
    ``point_weight`` say, by default one node each. One row and one point of another kind stand in front.
    """

    def __init__(self, triangles, positions, variant=("scalar", "float64"), point_node=None, point_weight=None):
        self.variant = lanes.variant(*variant)
        self.kernels = cavity.kernels(self.variant)
        self.worlds = len(positions)
        self.packs, self.lanes = rows.shape(self.variant, self.worlds)
        self.width = self.packs if self.variant.lanes > 1 else self.worlds
        if point_node is None:
            point_node = np.full((positions.shape[1], 4), -1)
            point_node[:, 0] = np.arange(positions.shape[1])
            point_weight = np.tile([1.0, 0.0, 0.0, 0.0], (len(point_node), 1))
        self.count = len(point_node)
        self.first_point, self.first_row = 1, 1
        self.node = self.array(np.vstack([[[-1] * 4], point_node]), wp.int32)
        self.weight = self.array(np.vstack([np.zeros((1, 4)), point_weight]))
        self.anchor = self.array(np.zeros((self.count + 1, 3)))
        start, ring = meshing.surface_rings(triangles, self.count)
        self.ring_start, self.ring = self.array(start, wp.int32), self.array(ring + 1, wp.int32)
        self.starts = self.array([1, self.count + 1], wp.int32)
        self.ends, opposite = meshing.surface_edges(triangles)
        self.opposite = self.array(opposite + 1, wp.int32)
        self.x = self.rows(positions.reshape(self.worlds, -1))
        self.point_x, self.point_gradient = self.empty(3 * self.count + 3), self.empty(3 * self.count + 3)
        self.volume = self.empty(2)
        self.measure()

    def array(self, values, dtype=None):
        return wp.array(np.asarray(values), dtype=dtype or self.variant.real, device="cpu")

    def empty(self, count):
        return rows.allocate(self.variant, self.worlds, count, "cpu")

    def rows(self, values):
        """Workspace array with one row of ``values`` (world, row) per world."""
        values = np.asarray(values, dtype=wp.dtype_to_numpy(self.variant.real))
        result = self.empty(values.shape[1])
        memory = result.real.numpy()
        for world in range(self.worlds):
            memory[world // self.lanes, :, world % self.lanes] = values[world]
        result.real.assign(memory)
        return result

    def read(self, array):
        """Values (world, row)."""
        return np.moveaxis(array.real.numpy(), 1, 2).reshape(-1, array.real.shape[1])[: self.worlds]

    def launch(self, kernel, items, inputs, outputs):
        wp.launch(kernel, self.variant.dim(self.width, items), inputs=inputs, outputs=outputs, device="cpu")

    def measure(self):
        k = self.kernels
        inputs = [self.first_point, self.node, self.weight, self.anchor, self.x.S]
        self.launch(k.cavity_points, self.count, inputs, [self.point_x.S])
        inputs = [self.first_point, self.ring_start, self.ring, self.point_x.S]
        self.launch(k.cavity_gradient, self.count, inputs, [self.point_gradient.S])
        inputs = [self.first_row, self.starts, self.point_x.S, self.point_gradient.S]
        self.launch(k.cavity_volume, 1, inputs, [self.volume.S])
        self.V = self.read(self.volume)[:, 1]
        self.H = self.read(self.point_gradient)[:, 3:].reshape(self.worlds, self.count, 3)

    def tangent(self, pressure, scale=1.0):
        """Dense -p d2V/dx2 of the nodes, (world, 3 node, 3 node), from the stored blocks m > n."""
        point_node = self.node.numpy()[1:]
        edge, m, n, weight = meshing.edge_couplings(self.ends, point_node, self.weight.numpy()[1:])
        size = self.x.real.shape[1] // 3
        keys, block = np.unique(m.astype(np.int64) * size + n, return_inverse=True)
        order = np.argsort(block, kind="stable")
        start = np.searchsorted(block[order], np.arange(keys.size + 1))
        vectors, blocks = self.empty(3 * len(self.ends)), self.empty(9 * keys.size)
        multiplier = self.rows(np.tile([0.0, pressure], (self.worlds, 1)))
        chamber = self.array(np.zeros(len(self.ends)), wp.int32)
        ones = self.rows(np.ones((self.worlds, 1)))
        inputs = [self.first_row, chamber, self.opposite, self.point_x.S, multiplier.S, ones.S, scale]
        self.launch(self.kernels.edge_stiffness, len(self.ends), inputs, [vectors.S])
        inputs = [self.array(start, wp.int32), self.array(edge[order], wp.int32), self.array(weight[order]), vectors.S]
        self.launch(self.kernels.block_stiffness, keys.size, inputs, [blocks.S])
        K = np.zeros((self.worlds, size, 3, size, 3))
        values = self.read(blocks).reshape(self.worlds, -1, 3, 3)
        for b, key in enumerate(keys):
            K[:, key // size, :, key % size] = values[:, b]
            K[:, key % size, :, key // size] = np.moveaxis(values[:, b], 1, 2)
        return K.reshape(self.worlds, 3 * size, 3 * size)


def chambers(triangles, x, **options):
    return Chambers(triangles, np.asarray(x)[None], **options)


def test_volumes_of_cube_and_octahedron():
    """a^3 and 4 a^3 / 3 to 1e-12; the outward orientation comes from the surface of a positive mesh."""
    for a in (1.0, 0.03):
        np.testing.assert_allclose(chambers(CUBE_TRIANGLES, a * CUBE).V, a**3, rtol=1e-12)
        np.testing.assert_allclose(chambers(OCTAHEDRON_TRIANGLES, a * OCTAHEDRON).V, 4.0 * a**3 / 3.0, rtol=1e-12)


def test_kinematics(rng):
    """Translation invariance, sum H = 0, sum x x H = 0, V(s x) = s^3 V, V(F x) = det(F) V, to 1e-12."""
    x, triangles = blob(rng)
    base = chambers(triangles, x)
    V, H = base.V[0], base.H[0]
    np.testing.assert_allclose(V, meshing.surface_volume(x, triangles), rtol=1e-12)
    size = np.abs(H).max()
    assert np.abs(H.sum(axis=0)).max() < 1e-12 * size
    assert np.abs(np.cross(x, H).sum(axis=0)).max() < 1e-12 * size * np.ptp(x)
    moved = chambers(triangles, x + [0.3, -0.1, 0.2])
    np.testing.assert_allclose(moved.V, V, rtol=1e-12)
    np.testing.assert_allclose(moved.H[0], H, atol=1e-12 * size)
    np.testing.assert_allclose(chambers(triangles, 1.7 * x).V, 1.7**3 * V, rtol=1e-12)
    F = np.eye(3) + 0.3 * rng.standard_normal((3, 3))
    np.testing.assert_allclose(chambers(triangles, x @ F.T).V, np.linalg.det(F) * V, rtol=1e-12)


def test_row_is_volume_gradient(rng):
    """V is a cubic polynomial: the five-point difference is exact; 1e-10 of the row is rounding at this step."""
    x, triangles = blob(rng)
    d = rng.standard_normal(x.shape)
    step = 1e-3
    V = [chambers(triangles, x + k * step * d).V[0] for k in (-2, -1, 1, 2)]
    slope = (V[0] - 8.0 * V[1] + 8.0 * V[2] - V[3]) / (12.0 * step)
    np.testing.assert_allclose(slope, (chambers(triangles, x).H[0] * d).sum(), rtol=1e-10)


def test_work_of_pressure(rng):
    """The work of H' p along an inflation is the integral of p dV: 100 midpoint steps, 1e-6."""
    x, triangles = blob(rng)
    d = 0.2 * (x - x.mean(axis=0)) + 0.0005 * rng.standard_normal(x.shape)
    times = (np.arange(100) + 0.5) / 100.0
    pressure = 1000.0 + 500.0 * times
    power = [(chambers(triangles, x + t * d).H[0] * d).sum() for t in times]
    V = [chambers(triangles, x + t * d).V[0] for t in np.linspace(0.0, 1.0, 101)]
    np.testing.assert_allclose(np.dot(pressure, power) / 100.0, np.dot(pressure, np.diff(V)), rtol=1e-6)


def embedded(rng):
    """A chamber whose points lie inside the tets of a block, three of them on nodes; nodes, carriers and weights."""
    mesh = meshing.box((0.05, 0.04, 0.04), (4, 3, 3))
    x, triangles = blob(rng)
    x = x + [0.01, 0.01, 0.01]
    x[:3] = mesh.nodes[[21, 22, 26]]
    tet, weights = meshing.embed(mesh.nodes, mesh.tets, x)
    return mesh.nodes, triangles, mesh.tets[tet], weights


@pytest.mark.parametrize("carried", [False, True])
def test_tangent_is_derivative_of_pressure_force(rng, carried):
    """-p d2V/dx2 against central differences of -p H, exact for a quadratic row; symmetric; no trace."""
    if carried:
        nodes, triangles, point_node, weight = embedded(rng)
    else:
        nodes, triangles = blob(rng)
        point_node = np.full((len(nodes), 4), -1)
        point_node[:, 0] = np.arange(len(nodes))
        weight = np.tile([1.0, 0.0, 0.0, 0.0], (len(nodes), 1))
    pressure, step = 8000.0, 1e-3
    options = {"point_node": point_node, "point_weight": weight}

    def row(x):
        H = np.zeros_like(x)
        used = point_node >= 0
        spread = weight[:, :, None] * chambers(triangles, x, **options).H[0][:, None, :]
        np.add.at(H, point_node[used], spread[used])
        return H

    K = chambers(triangles, nodes, **options).tangent(pressure)[0]
    d = rng.standard_normal(nodes.shape)
    expected = -pressure * (row(nodes + step * d) - row(nodes - step * d)) / (2.0 * step)
    scale = np.abs(expected).max()
    np.testing.assert_allclose((K @ d.ravel()).reshape(-1, 3), expected, atol=1e-8 * scale)
    assert np.abs(K - K.T).max() <= 1e-12 * np.abs(K).max()
    assert abs(np.trace(K)) <= 1e-12 * np.abs(K).max()
    half = chambers(triangles, nodes, **options).tangent(pressure, scale=0.5)[0]
    np.testing.assert_allclose(half, 0.5 * K, rtol=1e-12)


@pytest.mark.parametrize("variant", VARIANTS[1:])
def test_variants_agree_far_from_the_origin(rng, variant):
    """float32 keeps 1e-4 of the volume of a 3 cm chamber 1 m away: positions round to 6e-8 m."""
    x, triangles = blob(rng)
    positions = x + 0.001 * rng.standard_normal((11, *x.shape)) + [1.0, 0.0, 0.0]
    exact, single = Chambers(triangles, positions), Chambers(triangles, positions, variant)
    np.testing.assert_allclose(single.V, exact.V, rtol=1e-4)
    np.testing.assert_allclose(single.H, exact.H, atol=1e-4 * np.abs(exact.H).max())
    K, reference = single.tangent(5000.0), exact.tangent(5000.0)
    np.testing.assert_allclose(K, reference, atol=1e-4 * np.abs(reference).max())


def test_lanes_equal_scalar_to_rounding(rng):
    """The same arithmetic in another order of lanes: 1e-6."""
    x, triangles = blob(rng)
    positions = x + 0.001 * rng.standard_normal((9, *x.shape))
    one, eight = (Chambers(triangles, positions, variant) for variant in VARIANTS[1:])
    np.testing.assert_allclose(eight.V, one.V, rtol=1e-6)
    np.testing.assert_allclose(eight.H, one.H, atol=1e-6 * np.abs(one.H).max())


COMMAND = {
    "pressure": 0.0,
    "volume": 1.0e-6,
    "gas": 1.0e-6,
    "min_pressure": -UNBOUNDED,
    "max_pressure": UNBOUNDED,
    "min_volume": 0.0,
    "max_volume": UNBOUNDED,
    "max_pressure_rate": UNBOUNDED,
    "max_flow": UNBOUNDED,
    "ambient": 101325.0,
    "exponent": 1.4,
}


def law(control, h=0.01, p=0.0, V=1.0e-6, variant=("scalar", "float64"), now=None, rest=1.0e-6, **changes):
    """Goal, bounds, target and compliance of one row in state (p, V), linearised at volume ``now``."""
    chosen = lanes.variant(*variant)
    kernels = cavity.kernels(chosen)
    worlds = 3

    def filled(count, row, value):
        array = rows.allocate(chosen, worlds, count, "cpu")
        memory = array.real.numpy()
        memory[:, row] = value
        array.real.assign(memory)
        return array

    values = {**COMMAND, **changes}
    inputs = {name: filled(1, 0, value) for name, value in values.items()}
    out = {name: filled(2, 1, 0.0) for name in ("goal", "lower", "upper", "target", "compliance")}
    code = wp.array([CAVITY_CONTROLS.index(control)], dtype=wp.int32, device="cpu")
    dim = chosen.dim(out["goal"].S.shape[0], 1)
    arguments = [1, code, *(inputs[name].S for name in values if name in inputs), filled(2, 1, p).S, filled(2, 1, V).S]
    outputs = [out[name].S for name in ("goal", "lower", "upper")]
    arguments += [filled(1, 0, 0.0).S, h, h]  # nothing is left to later stages
    wp.launch(kernels.cavity_command, dim, inputs=arguments, outputs=outputs, device="cpu")
    rest_volume = wp.array([rest], dtype=chosen.real, device="cpu")
    volume = filled(2, 1, V if now is None else now)
    arguments = [1, code, rest_volume, inputs["ambient"].S, inputs["exponent"].S, out["goal"].S, volume.S]
    wp.launch(
        kernels.cavity_law, dim, inputs=arguments, outputs=[out[n].S for n in ("target", "compliance")], device="cpu"
    )
    return SimpleNamespace(**{name: float(array.real.numpy()[0, -1, 0]) for name, array in out.items()})


@pytest.mark.parametrize("variant", VARIANTS)
def test_pressure_control(variant):
    """lower = upper = command, clamped to the limits and the rate; no compliance."""
    row = law("pressure", pressure=8000.0, variant=variant)
    assert row.lower == row.upper == 8000.0
    assert row.compliance == 0.0
    assert law("pressure", pressure=8000.0, max_pressure=5000.0, variant=variant).upper == 5000.0
    assert law("pressure", pressure=-9000.0, min_pressure=-2000.0, variant=variant).lower == -2000.0
    row = law("pressure", pressure=8000.0, p=1000.0, max_pressure_rate=5000.0, variant=variant)
    np.testing.assert_allclose([row.lower, row.upper], 1050.0, rtol=1e-6)
    row = law("pressure", pressure=0.0, p=1000.0, max_pressure_rate=5000.0, variant=variant)
    np.testing.assert_allclose([row.lower, row.upper], 950.0, rtol=1e-6)
    assert law("pressure", h=0.0, pressure=8000.0, max_pressure_rate=5000.0, variant=variant).upper == 8000.0


@pytest.mark.parametrize("variant", VARIANTS)
def test_volume_control(variant):
    """Target = command, clamped to limits and flow; the pressure between its limits; no compliance."""
    row = law("volume", volume=1.1e-6, min_pressure=-10.0, max_pressure=9000.0, variant=variant)
    np.testing.assert_allclose([row.goal, row.target], 1.1e-6, rtol=1e-6)
    assert (row.lower, row.upper, row.compliance) == (-10.0, 9000.0, 0.0)
    np.testing.assert_allclose(law("volume", volume=1.5e-6, max_volume=1.2e-6, variant=variant).target, 1.2e-6)
    np.testing.assert_allclose(law("volume", volume=0.5e-6, min_volume=0.8e-6, variant=variant).target, 0.8e-6)
    np.testing.assert_allclose(law("volume", volume=1.5e-6, max_flow=1e-5, variant=variant).target, 1.1e-6, rtol=1e-6)
    np.testing.assert_allclose(law("volume", volume=0.5e-6, max_flow=1e-5, variant=variant).target, 0.9e-6, rtol=1e-6)
    np.testing.assert_allclose(law("volume", h=0.0, volume=1.2e-6, max_flow=1e-5, variant=variant).target, 1.2e-6)


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("now", [2.0e-6, 0.1e-6, -1.0e-6])
def test_volume_target_is_within_reach_of_a_linearisation(variant, now):
    """A goal far away is approached by a quarter of the volume, now or at rest, whichever is larger."""
    way = 0.25 * max(now, 1.0e-6)
    for volume, target in ((9.0e-6, now + way), (-9.0e-6, now - way)):
        row = law("volume", volume=volume, min_volume=-1.0, now=now, variant=variant)
        np.testing.assert_allclose([row.goal, row.target], [volume, target], rtol=1e-6)


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("exponent", [1.0, 1.4])
def test_gas_control(variant, exponent):
    """With p = p_a (G / V)^kappa - p_a at the present volume: C = V / (kappa p_abs), target = V + C p."""
    V, G, ambient = 1.3e-6, 2.0e-6, 101325.0
    row = law("gas", gas=G, now=V, exponent=exponent, variant=variant)
    absolute = ambient * (G / V) ** exponent
    compliance = V / (exponent * absolute)
    np.testing.assert_allclose(row.compliance, compliance, rtol=1e-5)
    np.testing.assert_allclose(row.target, V + compliance * (absolute - ambient), rtol=1e-6)
    rest = law("gas", gas=1.0e-6, exponent=exponent, variant=variant)
    np.testing.assert_allclose(rest.target, 1.0e-6, rtol=1e-6)


def test_gas_flow_starts_from_the_gas_held():
    """At p and V the chamber holds V ((p + p_a) / p_a)^(1 / kappa); the flow changes it by at most h max_flow."""
    p, V, kappa, ambient = 20000.0, 1.2e-6, 1.4, 101325.0
    held = V * ((p + ambient) / ambient) ** (1.0 / kappa)
    row = law("gas", gas=9.0e-6, p=p, V=V, max_flow=1.0e-5)
    np.testing.assert_allclose(row.goal, held + 1.0e-7, rtol=1e-12)
    same = law("gas", gas=held, p=p, V=V, max_flow=1.0e-5)
    np.testing.assert_allclose(same.target, V + same.compliance * p, rtol=1e-12)


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize(("gas", "now"), [(0.0, 1.0e-6), (1.0e-6, 0.0), (1.0e-6, -1.0e-6), (0.0, 0.0)])
def test_gas_law_is_finite_in_any_state(variant, gas, now):
    """No gas, or a chamber squeezed flat or inside out: finite numbers, and a compliance that is not negative."""
    row = law("gas", gas=gas, now=now, variant=variant)
    assert np.isfinite([row.target, row.compliance]).all()
    assert row.compliance >= 0.0


def test_sealed_gas_balances_a_piston():
    """One chamber, one spring: iterating the linearised row reaches p_a (G / V)^kappa - p_a = k (V - V0) / A^2.

    The row with W = A^2 / k: V + W (p_new - p) = V_new and gap = 0; quadratic convergence in 6 linearisations to 1e-12.
    """
    ambient, kappa, V0, G, W = 101325.0, 1.4, 1.0e-6, 1.8e-6, 2.0e-11
    V = V0
    for _ in range(6):
        row = law("gas", gas=G, now=V)
        p_balance = (V - V0) / W
        p = (row.target - V + W * p_balance) / (W + row.compliance)
        V = V0 + W * p
    np.testing.assert_allclose(p, ambient * (G / V) ** kappa - ambient, rtol=1e-12)


@pytest.mark.parametrize("parts", [pytest.param(1, marks=pytest.mark.slow), team.PARTS])
def test_threads_of_a_gpu_share_a_volume(parts, monkeypatch):
    """Two chambers of eleven worlds, to rounding as a sum over all points; on a CPU threads of a block are fibers."""
    monkeypatch.setattr(wp.config, "enable_cpu_blocks", parts > 1)
    draws, worlds, starts = np.random.default_rng(5), 11, np.array([0, 6, 31])
    x, gradient = draws.normal(size=(2, worlds, starts[-1], 3))
    given = [wp.array(a.reshape(worlds, -1), dtype=wp.float64, device="cpu") for a in (x, gradient)]
    volume = wp.full((worlds, 3), 7.0, dtype=wp.float64, device="cpu")
    threads = parts * team.team("cpu", worlds, 2)[1]
    inputs = [parts, 1, wp.array(starts, dtype=wp.int32, device="cpu"), *given]
    kernel = cavity.kernels(lanes.variant("cuda", "float64")).share_volume
    wp.launch(kernel, threads, inputs, [volume], device="cpu", block_dim=32 if parts > 1 else 1)
    own = [slice(*starts[k : k + 2]) for k in (0, 1)]
    wanted = [((x[:, s] - x[:, s.start, None]) * gradient[:, s]).sum(axis=(1, 2)) / 3.0 for s in own]
    np.testing.assert_allclose(volume.numpy(), np.stack([np.full(worlds, 7.0), *wanted], axis=1), rtol=1e-12)
