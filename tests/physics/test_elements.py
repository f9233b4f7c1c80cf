"""Assembled elastic force, energy and tangent of tetrahedral meshes, without a time step.

Expected values: differences of the energy, the formulas in the docstrings, or homogeneous states, which linear
tetrahedra hold exactly (catalogue sections 1.1, 1.3, 1.4, 1.5).
"""

import numpy as np
import pytest
import scipy.optimize

import softwarp as sw
from softwarp import meshing
from tests import cases

SIZE, CELLS = (0.2, 0.1, 0.15), (3, 2, 2)  # m
SPACING = 0.05  # m, the shortest cell edge
YOUNGS, NU = 1.0e5, 0.4  # Pa
LARGE_F = np.array([[1.1, 0.3, -0.05], [0.02, 0.9, 0.15], [0.1, -0.2, 1.2]])
SMALL_F = np.eye(3) + 1e-3 * np.array([[1.0, 0.4, -0.2], [0.3, -0.5, 0.6], [0.1, -0.7, 0.8]])

each_law = pytest.mark.parametrize("law", [*cases.LAWS, *cases.FITTED])
LANES = ("nh_log", "yeoh")  # laws of which others than those in float64 are compiled for quick tests, and stvk
each_rotation = pytest.mark.parametrize("law", [*cases.LAWS, "large"])


def deformed_case(law: str, rng: np.random.Generator, **options: object) -> cases.Case:
    """An irregular block, stretched by LARGE_F, each node moved by a further 10 % of the spacing; J > 0.2."""
    mesh = cases.jittered(meshing.box(SIZE, CELLS), 0.2 * SPACING, rng)
    case = cases.body(mesh, law, YOUNGS, NU, project_tangent=False, **options)
    positions = mesh.nodes @ LARGE_F.T + rng.uniform(-0.1, 0.1, mesh.nodes.shape) * SPACING
    assert (meshing.tet_volumes(positions, mesh.tets) / mesh.tet_volumes).min() > 0.2
    case.move(positions)
    return case


@each_law
def test_force_is_energy_gradient(law: str, rng: np.random.Generator) -> None:
    """Force: f . d = dE/dx . d; central difference, step 1e-6 of the size: |difference| <= 1e-7 |f| (catalogue 1.1)."""
    case = deformed_case(law, rng)
    start, step = case.positions(), 1e-6 * max(SIZE)
    force = case.internal_force()
    for _ in range(3):
        direction = rng.standard_normal(start.shape)
        direction /= np.linalg.norm(direction)
        energy = []
        for sign in (1.0, -1.0):
            case.move(start + sign * step * direction)
            energy.append(float(case.sim.elastic_energy()[0]))
        assert abs((energy[0] - energy[1]) / (2.0 * step) - (force * direction).sum()) < 1e-7 * np.linalg.norm(force)


# float64 proves the formulas of every law; in float32 one law by invariants and one by stretches prove the variant.
TANGENTS = [
    *((law, "float64", 1e-6, 1e-6) for law in (*cases.LAWS, *cases.FITTED)),
    *(
        pytest.param(law, "float32", 1e-3, 1e-2, marks=() if law in ("nh_log", "ogden") else pytest.mark.slow)
        for law in (*cases.LAWS, *cases.FITTED)
    ),
]


@pytest.mark.parametrize(("law", "precision", "step", "tolerance"), TANGENTS)
def test_tangent_is_force_gradient(
    law: str, precision: str, step: float, tolerance: float, rng: np.random.Generator
) -> None:
    """K d = df/dx . d; central difference, catalogue 1.1."""
    case = deformed_case(law, rng, precision=precision)
    start = case.positions()
    direction = rng.standard_normal(start.shape)
    direction /= np.linalg.norm(direction)
    product = case.sim.tangent_product(cases.tensor(case.sim, direction[None]))[0].double().cpu().numpy()
    force = []
    for sign in (1.0, -1.0):
        case.move(start + sign * step * max(SIZE) * direction)
        force.append(case.internal_force())
    difference = (force[0] - force[1]) / (2.0 * step * max(SIZE))
    assert np.linalg.norm(difference - product) < tolerance * np.linalg.norm(product)


@each_rotation
def test_stiffness_matrix_is_the_tangent(law: str, rng: np.random.Generator) -> None:
    """The assembled matrix is symmetric to 1e-12 and gives the matrix-free product."""
    case = deformed_case(law, rng)
    K = case.sim.stiffness_matrix()
    assert K.shape == (3 * len(case.mesh.nodes),) * 2
    assert abs(K - K.T).max() < 1e-12 * abs(K).max()
    direction = rng.standard_normal(case.mesh.nodes.shape)
    product = case.sim.tangent_product(cases.tensor(case.sim, direction[None]))[0].cpu().numpy()
    np.testing.assert_allclose((K @ direction.ravel()).reshape(-1, 3), product, atol=1e-11 * np.abs(product).max())


@pytest.mark.parametrize(
    "law",
    [pytest.param(law, marks=() if law in LANES else pytest.mark.slow) for law in (*cases.LAWS, *cases.FITTED)],
)
def test_one_world_equals_worlds_side_by_side(law: str, rng: np.random.Generator) -> None:
    """Eight tets of one world in lanes, or one tet of eight worlds: forces and tangent products agree to 3e-6.

    72 tets of two laws, 36 each, leave the last bundle of each half empty.
    """
    mesh = cases.jittered(meshing.box(SIZE, CELLS), 0.2 * SPACING, rng)
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    for half, offset in ((mesh.tets[:36], 0.0), (mesh.tets[36:], 1.0)):
        used, tets = np.unique(half, return_inverse=True)
        part = meshing.TetMesh(mesh.nodes[used] + (0.0, offset, 0.0), tets.reshape(-1, 4))
        builder.add_tets(part, material=cases.material(law if offset else "stvk", YOUNGS, NU), density=1000.0)
    model = [builder.finalize(worlds, precision="float32") for worlds in (1, 9)]
    one, many = (sw.Simulation(m, project_tangent=True) for m in model)
    moved = one.node_x[0].double().numpy() @ LARGE_F.T
    moved = np.stack([moved + rng.uniform(-0.1, 0.1, moved.shape) * SPACING for _ in range(9)])
    direction = rng.standard_normal(moved.shape)
    many.node_x.copy_(cases.tensor(many, moved))
    many.refresh()
    forces, products = many.internal_force(), many.tangent_product(cases.tensor(many, direction))
    for world in range(9):
        one.node_x.copy_(cases.tensor(one, moved[world : world + 1]))
        one.refresh()
        for found, expected in (
            (one.internal_force()[0], forces[world]),
            (one.tangent_product(cases.tensor(one, direction[world : world + 1]))[0], products[world]),
        ):
            np.testing.assert_allclose(found.numpy(), expected.numpy(), atol=3e-6 * float(expected.abs().max()))


@pytest.mark.parametrize("law", cases.LAWS)
def test_tangents_of_crushed_elements(law: str) -> None:
    """Mirrored, flat, pressed to a line and to a point: finite if the law is, and projected ones semidefinite."""
    mirrored, line = np.diag([1.1, 0.9, -0.8]), np.outer([1.0, 2.0, 3.0], [0.3, 0.1, -0.1])
    F = np.stack([mirrored, np.diag([1.0, 1.0, 0.0]), line, np.zeros((3, 3))])
    solid = cases.LAWS[law](YOUNGS, NU)
    if law == "nh_log":
        F = F[:0]  # infinite energy
    for tangent in solid.tangent(F, project=True):
        assert np.isfinite(tangent).all()
        np.testing.assert_allclose(tangent, tangent.T, atol=1e-9 * YOUNGS)
        assert np.linalg.eigvalsh(tangent).min() > -1e-9 * YOUNGS


def edge_frame(corner: np.ndarray) -> np.ndarray:
    """SOFA's rotation "large" of (tet, 4, 3) corners: e1 along b - a, e3 along (b - a) x (c - a), e2 = e3 x e1."""
    e1 = corner[:, 1] - corner[:, 0]
    e1 /= np.linalg.norm(e1, axis=1)[:, None]
    e3 = np.cross(e1, corner[:, 2] - corner[:, 0])
    e3 /= np.linalg.norm(e3, axis=1)[:, None]
    return np.stack([e1, np.cross(e3, e1), e3], axis=-1)


def test_large_rotation_is_sofas(rng: np.random.Generator) -> None:
    """Corotational "large": f = R K0 (R^T x - X), R = [e1 e2 e3] [E1 E2 E3]^T from the edges a-b and a-c.

    With linear shape functions of gradient g_a the element force is V R sigma g_a, sigma = Hooke's law of the
    symmetric gradient of R^T x - X. K0 of Hooke's law kills translations, so no corner needs to be singled out.
    """
    case = deformed_case("large", rng)
    mu, lam = cases.lame(YOUNGS, NU)
    tets, rest, now = case.mesh.tets, case.mesh.nodes[case.mesh.tets], case.positions()[case.mesh.tets]
    R = edge_frame(now) @ edge_frame(rest).transpose(0, 2, 1)
    Dm = (rest[:, 1:] - rest[:, :1]).transpose(0, 2, 1)
    gradient = np.linalg.inv(Dm)  # rows: gradients of the shape functions of corners 1, 2, 3
    gradient = np.concatenate([-gradient.sum(axis=1, keepdims=True), gradient], axis=1)
    F = np.einsum("nai,naj->nij", now, gradient)
    displacement = R.transpose(0, 2, 1) @ F - np.eye(3)
    strain = 0.5 * (displacement + displacement.transpose(0, 2, 1))
    sigma = 2.0 * mu * strain + lam * np.trace(strain, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    corner_force = np.einsum("n,nij,naj->nai", case.mesh.tet_volumes, R @ sigma, gradient)
    expected = np.zeros_like(case.mesh.nodes)
    np.add.at(expected, tets.ravel(), corner_force.reshape(-1, 3))
    np.testing.assert_allclose(case.internal_force(), expected, atol=1e-11 * np.abs(expected).max())


@pytest.mark.parametrize(
    ("law", "precision", "tolerance"), cases.in_both_precisions([*cases.LAWS, "large"], 1e-10, 1e-4)
)
def test_rigid_motion_is_force_free(law: str, precision: str, tolerance: float, rng: np.random.Generator) -> None:
    """A body at Q X + c has |f| <= tolerance E h^2 (catalogue 1.5). float32 rounds x at 3e-8, a strain of 1e-6."""
    mesh = cases.jittered(meshing.box(SIZE, CELLS), 0.2 * SPACING, rng)
    case = cases.body(mesh, law, YOUNGS, NU, precision=precision)
    for Q in (cases.random_rotation(rng), np.diag([-1.0, -1.0, 1.0])):
        case.move(mesh.nodes @ Q.T + np.array([0.1, -0.2, 0.3]))
        assert np.abs(case.internal_force()).max() < tolerance * YOUNGS * SPACING**2
        assert float(case.sim.elastic_energy()[0]) < tolerance * YOUNGS * SPACING**3


@each_rotation
def test_force_turns_with_the_body(law: str, rng: np.random.Generator) -> None:
    """Turned with Q: f(Q x) = Q f(x) at a deformed state."""
    case = deformed_case(law, rng)
    force, Q = case.internal_force(), cases.random_rotation(rng)
    case.move(case.positions() @ Q.T)
    np.testing.assert_allclose(case.internal_force(), force @ Q.T, atol=1e-10 * np.abs(force).max())


@each_rotation
def test_internal_force_is_self_balanced(law: str, rng: np.random.Generator) -> None:
    """Sum f = 0, and sum x cross f = 0 for every law whose stress P F^T is symmetric ("large" has none)."""
    case = deformed_case(law, rng)
    force = case.internal_force()
    assert np.abs(force.sum(axis=0)).max() < 1e-11 * np.abs(force).sum()
    if law != "large":
        moment = np.cross(case.positions(), force).sum(axis=0)
        assert np.abs(moment).max() < 1e-11 * np.abs(force).sum() * max(SIZE)


@pytest.mark.parametrize(
    ("law", "precision", "tolerance"),
    [
        *cases.in_both_precisions(cases.LAWS, 1e-12, 1e-5),
        *(
            pytest.param(*key, marks=pytest.mark.slow)
            for law in cases.FITTED
            for key in ((law, "float64", 1e-12), (law, "float32", 1e-5))
        ),
    ],
)
@pytest.mark.parametrize("F", [SMALL_F, LARGE_F], ids=["small", "large"])
def test_patch(law: str, F: np.ndarray, precision: str, tolerance: float, rng: np.random.Generator) -> None:
    """Surface nodes at F X: the inner nodes of an irregular mesh land on F X, to tolerance L (catalogue 1.4).

    The nodal force on the surface is P(F) times the node's share of the rest area vector, and inside it is zero.
    """
    mesh = cases.jittered(meshing.box(SIZE, (4, 3, 3)), 0.2 * SIZE[1] / 3, rng)
    case = cases.body(mesh, law, YOUNGS, NU, fixed=cases.boundary(mesh), precision=precision)
    target = mesh.nodes @ F.T
    case.move(target + case.free[:, None] * rng.uniform(-0.05, 0.05, target.shape) * SPACING)
    case.sim.solve_static(tolerance=1e-13 if precision == "float64" else 1e-6)
    assert np.abs(case.positions() - target).max() < tolerance * max(SIZE)
    expected = cases.area_vectors(mesh) @ cases.material(law, YOUNGS, NU).stress(F).T
    assert np.abs(case.internal_force() - expected).max() < 10.0 * tolerance * YOUNGS * SPACING**2


# catalogue 1.3, E = 1e5 Pa, nu = 0.3: nominal stress [Pa] at a stretch, sides free. A stronger dead compression than
# pi^2 E / 48 = 0.2 E makes a cube held at one face buckle, so the homogeneous state is no stable answer there.
UNIAXIAL = [
    ("nh_log", 0.9, -10872.22),
    ("nh_log", 1.5, 37828.02),
    ("snh", 0.9, -10757.62),
    ("snh", 1.5, 38319.09),
    ("stvk", 0.9, -8550.0),
    ("stvk", 1.5, 93750.0),
    ("corot", 0.9, -10000.0),
    ("corot", 1.5, 50000.0),
]


@pytest.mark.parametrize("cells", [(1, 1, 1), (4, 4, 4)], ids=["one cell", "4x4x4"])
@pytest.mark.parametrize(("law", "stretch", "stress"), UNIAXIAL)
def test_uniaxial_block(law: str, stretch: float, stress: float, cells: tuple[int, int, int]) -> None:
    """A cube under a dead axial traction, sides free, stretches homogeneously, the same on every mesh.

    The face x = 0 is held in the shape of the homogeneous state, diag(stretch, side, side) X, which the traction
    of table 1.3 keeps in balance; all other nodes are free (force patch test, catalogue 1.3 and 1.4).
    """
    mesh = meshing.box((0.1, 0.1, 0.1), cells)
    solid = cases.material(law, 1e5, 0.3)
    side = scipy.optimize.brentq(lambda s: float(solid.stress(np.diag([stretch, s, s]))[2, 2]), 0.2, 2.0, xtol=1e-15)
    stress_exact = float(solid.stress(np.diag([stretch, side, side]))[0, 0])
    assert stress_exact == pytest.approx(stress, abs=0.006)

    case = cases.body(mesh, law, 1e5, 0.3, fixed=cases.on_plane(mesh, 0, 0.0))
    case.load(cases.traction(mesh, cases.on_plane(mesh, 0, 0.1), (stress_exact * 0.01, 0.0, 0.0)))
    target = mesh.nodes * np.array([stretch, side, side])
    halfway = mesh.nodes * (1.0 + 0.5 * (np.array([stretch, side, side]) - 1.0))
    case.move(np.where(case.free[:, None], halfway, target))
    case.sim.solve_static(tolerance=1e-13)
    assert np.abs(case.positions() - target).max() < 1e-10 * 0.1


@each_rotation
def test_turned_problem_gives_turned_answer(law: str, rng: np.random.Generator) -> None:
    """Mesh, gravity and load turned together by Q turn statics and 20 steps by Q, to 1e-8 m (catalogue 1.5)."""
    mesh = meshing.box((0.4, 0.1, 0.1), (4, 2, 2))
    fixed, Q = cases.on_plane(mesh, 0, 0.0), cases.random_rotation(rng)
    force = cases.traction(mesh, cases.on_plane(mesh, 0, 0.4), (0.0, 2.0, -1.0))
    answers = []
    for turn in (np.eye(3), Q):
        turned = meshing.TetMesh(mesh.nodes @ turn.T, mesh.tets)
        gravity = tuple(turn @ np.array([0.0, 0.0, -9.81]))
        case = cases.body(turned, law, YOUNGS, 0.3, gravity=gravity, fixed=fixed, dt=0.01)
        case.load(force @ turn.T)
        for _ in range(20):
            case.sim.step()
        dynamic = case.positions()
        case.sim.solve_static(tolerance=1e-12)
        answers.append((dynamic @ turn, case.positions() @ turn))
    for reference, turned in zip(*answers, strict=True):
        assert np.abs(turned - reference).max() < 1e-8
