"""Cables: virtual work, imposed length against imposed tension, limits, and a beam bent by a tendon (catalogue 8)."""

from typing import Any

import numpy as np
import pytest
import torch

import softwarp as sw
from softwarp import meshing
from tests import cases

LENGTH, WIDTH = 0.2, 0.04  # m
YOUNGS, NU = 1e5, 0.3
OFFSET = 0.01  # m, of the cable from the axis


def tendon_beam(
    cells: tuple[int, int, int] = (8, 2, 2),
    law: str = "corot",
    *,
    nu: float = NU,
    waypoints: np.ndarray | None = None,
    precision: str = "float64",
    num_worlds: int = 1,
    rayleigh: tuple[float, float] = (1.0, 0.01),
    options: dict[str, Any] | None = None,
    **cable: Any,
) -> cases.Case:
    """A beam along x, clamped at x = 0, with one cable parallel to its axis at ``OFFSET`` above it."""
    mesh = meshing.box((LENGTH, WIDTH, WIDTH), cells)
    if waypoints is None:
        x = np.linspace(0.0, LENGTH, 9)
        waypoints = np.stack([x, np.full(9, WIDTH / 2), np.full(9, WIDTH / 2 + OFFSET)], axis=1)
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    body = builder.add_tets(mesh, material=cases.material(law, YOUNGS, nu), density=1000.0, rayleigh=rayleigh)
    builder.fix(body, nodes=np.flatnonzero(cases.on_plane(mesh, 0, 0.0)))
    builder.add_cable(body, waypoints, **cable)
    builder.add_marker(body, (LENGTH, WIDTH / 2, WIDTH / 2))
    model = builder.finalize(num_worlds=num_worlds, precision=precision)
    return cases.Case(sw.Simulation(model, **(options or {})), mesh)


def oblique(rng: np.random.Generator) -> np.ndarray:
    """A crooked path through the beam, so that every waypoint carries force."""
    x = np.linspace(0.01, 0.95 * LENGTH, 6)
    return np.stack([x, *(WIDTH / 2 + 0.35 * WIDTH * rng.uniform(-1.0, 1.0, (2, 6)))], axis=1)


def settle(case: cases.Case, steps: int = 400) -> None:
    for _ in range(steps):
        case.sim.step()


def value(view: torch.Tensor) -> float:
    """The number of world 0, cable 0."""
    return float(view[0, 0])


def test_length_is_the_polyline_through_the_waypoints(rng: np.random.Generator) -> None:
    """At F X every waypoint is F X, so L = sum |F (X_j+1 - X_j)|; the displacement is L_0 - L."""
    path = oblique(rng)
    case = tendon_beam(waypoints=path)
    F = np.array([[1.1, 0.3, -0.05], [0.02, 0.9, 0.15], [0.1, -0.2, 1.2]])
    case.move(case.mesh.nodes @ F.T)
    rest, now = (np.linalg.norm(np.diff(points, axis=0), axis=1).sum() for points in (path, path @ F.T))
    assert value(case.sim.cable_length) == pytest.approx(now, rel=1e-12)
    assert value(case.sim.cable_displacement) == pytest.approx(rest - now, rel=1e-10)
    np.testing.assert_allclose(case.sim.cable_x[0].cpu().numpy(), path @ F.T, atol=1e-14)


def test_pull_point_is_part_of_the_length(rng: np.random.Generator) -> None:
    """A pull point fixed in space is the first point; moving the body by 1 cm along x changes only that segment."""
    path, anchor = oblique(rng), np.array([-0.05, 0.01, 0.03])
    case = tendon_beam(waypoints=path, pull_point=tuple(anchor))
    rest = np.linalg.norm(np.diff(np.vstack([anchor, path]), axis=0), axis=1).sum()
    assert value(case.sim.cable_length) == pytest.approx(rest, rel=1e-12)
    case.move(case.mesh.nodes + [0.01, 0.0, 0.0])
    stretch = np.linalg.norm(path[0] + [0.01, 0.0, 0.0] - anchor) - np.linalg.norm(path[0] - anchor)
    assert value(case.sim.cable_displacement) == pytest.approx(-stretch, rel=1e-9)
    np.testing.assert_allclose(case.sim.cable_x[0, 0].cpu().numpy(), anchor, atol=1e-15)


@pytest.mark.parametrize("anchored", [False, True])
@pytest.mark.parametrize("closes", [False, True])
def test_virtual_work(closes: bool, anchored: bool, rng: np.random.Generator) -> None:
    """In equilibrium f_int . d = T d(displacement)/dx . d for every motion d of the free nodes (8.2).

    The displacement's derivative is a central difference with step 1e-6 of the length, so this checks the cable's
    Jacobian against its length through nothing but the equilibrium.
    """
    path, pull_point = oblique(rng), (-0.05, 0.01, 0.03) if anchored else None
    shortest = np.linalg.norm(np.diff(path, axis=0), axis=1).min()
    closing = 0.999 * shortest if closes else 0.0
    case = tendon_beam(waypoints=path, control="force", pull_point=pull_point, closing_length=closing)
    case.sim.control.cable_tension.fill_(3.0)
    case.sim.solve_static(tolerance=1e-12)
    assert value(case.sim.cable_tension) == 3.0
    now = case.sim.cable_x[0].cpu().numpy()
    assert (np.linalg.norm(np.diff(now, axis=0), axis=1).min() < closing) == closes
    start, force = case.positions(), case.internal_force()
    for _ in range(5):
        direction = rng.standard_normal(start.shape) * case.free[:, None]
        step = 1e-6 * LENGTH
        displacements = []
        for sign in (1.0, -1.0):
            case.move(start + sign * step * direction)
            displacements.append(value(case.sim.cable_displacement))
        derivative = (displacements[0] - displacements[1]) / (2.0 * step)
        assert (force * direction).sum() == pytest.approx(3.0 * derivative, rel=1e-6, abs=1e-7)


@pytest.mark.parametrize(
    "law", ["corot", "snh", "large", *(pytest.param(law, marks=pytest.mark.slow) for law in ("stvk", "nh_log"))]
)
@pytest.mark.parametrize("method", ["static", "steps"])
def test_length_and_force_control_agree(law: str, method: str, rng: np.random.Generator) -> None:
    """The tension that holds 6 mm of displacement, imposed as a force, gives the same 6 mm and the same shape (8.2)."""
    path, options = oblique(rng), {"dt": 0.02}
    solve = settle if method == "steps" else lambda case: case.sim.solve_static(tolerance=1e-11)
    by_length = tendon_beam(law=law, waypoints=path, options=options)
    by_length.sim.control.cable_displacement.fill_(0.006)
    solve(by_length)
    assert value(by_length.sim.cable_displacement) == pytest.approx(0.006, rel=1e-8)
    tension = value(by_length.sim.cable_tension)
    assert tension > 1.0

    by_force = tendon_beam(law=law, waypoints=path, control="force", options=options)
    by_force.sim.control.cable_tension.fill_(tension)
    solve(by_force)
    assert value(by_force.sim.cable_tension) == pytest.approx(tension, rel=1e-12)
    assert value(by_force.sim.cable_displacement) == pytest.approx(0.006, rel=1e-6)
    assert np.abs(by_force.positions() - by_length.positions()).max() < 1e-6 * LENGTH


@pytest.mark.parametrize(
    ("precision", "tolerance"), [("float64", 1e-6), pytest.param("float32", 1e-3, marks=pytest.mark.slow)]
)
def test_static_and_stepped_agree(precision: str, tolerance: float) -> None:
    """Steps of 0.02 s with damping settle at the shape and tension of ``solve_static``."""
    static, stepped = (tendon_beam(precision=precision, options={"dt": 0.02}) for _ in range(2))
    for case in (static, stepped):
        case.sim.control.cable_displacement.fill_(0.004)
    static.sim.solve_static()
    settle(stepped)
    assert value(stepped.sim.cable_tension) == pytest.approx(value(static.sim.cable_tension), rel=tolerance)
    assert np.abs(stepped.positions() - static.positions()).max() < tolerance * LENGTH


def test_slack_cable_exerts_nothing() -> None:
    """Commanded longer than it needs to be, a pulling cable has tension 0 exactly and the body stays, to rounding."""
    case = tendon_beam()
    case.sim.control.cable_displacement.fill_(-0.005)
    settle(case, 20)
    assert value(case.sim.cable_tension) == 0.0
    assert np.abs(case.displacements()).max() < 1e-14
    case.sim.solve_static(tolerance=1e-10)
    assert value(case.sim.cable_tension) == 0.0
    assert np.abs(case.displacements()).max() < 1e-14


def test_slack_cable_of_a_falling_beam_exerts_nothing() -> None:
    """With the cable slack, a sagging beam moves exactly as it does under a tension of zero."""
    tracks = []
    for control in ("length", "force"):
        case = tendon_beam(control=control)
        case.sim.params.gravity[:] = torch.tensor([0.0, 0.0, -9.81], dtype=torch.float64)
        case.sim.control.cable_displacement.fill_(-0.05)
        settle(case, 50)
        assert value(case.sim.cable_tension) == 0.0
        tracks.append(case.positions())
    assert np.abs(tracks[0] - case.mesh.nodes).max() > 0.005
    np.testing.assert_array_equal(tracks[0], tracks[1])


def test_bilateral_cable_pushes() -> None:
    """With ``min_tension = -inf`` the same command is met, by a negative tension."""
    case = tendon_beam(min_tension=-np.inf)
    case.sim.control.cable_displacement.fill_(-0.002)
    case.sim.solve_static(tolerance=1e-10)
    assert value(case.sim.cable_displacement) == pytest.approx(-0.002, rel=1e-8)
    assert value(case.sim.cable_tension) < -0.1


def test_small_pull_and_push_mirror() -> None:
    """To first order pull and push are opposite: tensions of +-1e-5 m of displacement agree to 1e-3."""
    tensions = []
    for displacement in (1e-5, -1e-5):
        case = tendon_beam(min_tension=-np.inf)
        case.sim.control.cable_displacement.fill_(displacement)
        case.sim.solve_static(tolerance=1e-8)
        tensions.append(value(case.sim.cable_tension))
    assert tensions[0] == pytest.approx(-tensions[1], rel=1e-3)


def test_rate_limit() -> None:
    """At 0.1 m/s and dt = 0.01 s a jump of 5.5 mm is followed by at most 1 mm a step, and reached after six.

    The limit bounds the target around the measured displacement; the linearised row meets its target up to the square
    of the increment over the length, 5 micrometres.
    """
    case = tendon_beam(max_rate=0.1, options={"dt": 0.01})
    case.sim.control.cable_displacement.fill_(0.0055)
    track = [0.0]
    for _ in range(12):
        case.sim.step()
        track.append(value(case.sim.cable_displacement))
    increments = np.diff(track)
    assert increments.max() < 1.005e-3
    np.testing.assert_allclose(increments[:5], 1e-3, atol=2e-5)
    assert track[5] == pytest.approx(0.005, abs=5e-5)
    assert track[-1] == pytest.approx(0.0055, abs=1e-5)
    case.sim.control.cable_displacement.fill_(0.0)
    case.sim.step()
    assert value(case.sim.cable_displacement) == pytest.approx(0.0045, abs=2e-5)


def test_displacement_limits() -> None:
    """Length control clips its command to [min_displacement, max_displacement], per world."""
    case = tendon_beam(num_worlds=2, min_tension=-np.inf, min_displacement=-0.001, max_displacement=0.002)
    case.sim.control.cable_displacement.copy_(torch.tensor([[0.01], [-0.01]]))
    case.sim.solve_static(tolerance=1e-10)
    np.testing.assert_allclose(case.sim.cable_displacement.cpu().numpy()[:, 0], [0.002, -0.001], rtol=1e-7)
    case.sim.params.cable_max_displacement[0] = 0.003
    case.sim.solve_static(tolerance=1e-10)
    assert value(case.sim.cable_displacement) == pytest.approx(0.003, rel=1e-7)


def test_tension_limit() -> None:
    """Length control stops at ``max_tension``: that tension exactly, and the displacement that it reaches."""
    case = tendon_beam(max_tension=2.0)
    case.sim.control.cable_displacement.fill_(0.05)
    case.sim.solve_static(tolerance=1e-11)
    assert value(case.sim.cable_tension) == 2.0
    reference = tendon_beam(control="force")
    reference.sim.control.cable_tension.fill_(2.0)
    reference.sim.solve_static(tolerance=1e-11)
    assert value(case.sim.cable_displacement) == pytest.approx(value(reference.sim.cable_displacement), rel=1e-7)
    settle(case, 50)
    assert value(case.sim.cable_tension) == 2.0


def test_force_control_respects_its_limits() -> None:
    """The commanded tension is clipped to [min_tension, max_tension]; beyond ``max_displacement`` the cable stops."""
    case = tendon_beam(control="force", max_tension=2.0)
    case.sim.control.cable_tension.fill_(5.0)
    case.sim.solve_static(tolerance=1e-10)
    assert value(case.sim.cable_tension) == 2.0
    case.sim.control.cable_tension.fill_(-1.0)
    case.sim.solve_static(tolerance=1e-10)
    assert value(case.sim.cable_tension) == 0.0

    case = tendon_beam(control="force", max_displacement=0.001)
    case.sim.control.cable_tension.fill_(20.0)
    case.sim.solve_static(tolerance=1e-10)
    assert value(case.sim.cable_displacement) == pytest.approx(0.001, rel=1e-6)
    assert 0.0 < value(case.sim.cable_tension) < 20.0


def test_antagonists_share_the_load() -> None:
    """Two mirrored cables pulled equally only shorten the beam; else they bend it to the stronger side."""
    mesh = meshing.box((LENGTH, WIDTH, WIDTH), (8, 2, 2))
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    body = builder.add_tets(mesh, material=cases.material("corot", YOUNGS, NU), density=1000.0)
    builder.fix(body, nodes=np.flatnonzero(cases.on_plane(mesh, 0, 0.0)))
    x = np.linspace(0.0, LENGTH, 9)
    for side in (1.0, -1.0):
        path = np.stack([x, np.full(9, WIDTH / 2), np.full(9, WIDTH / 2 + side * OFFSET)], axis=1)
        builder.add_cable(body, path)
    sim = sw.Simulation(builder.finalize(num_worlds=3, precision="float64"))
    sim.control.cable_displacement.copy_(torch.tensor([[0.002, 0.002], [0.004, 0.0], [0.0, 0.004]]))
    result = sim.solve_static(tolerance=1e-10)
    assert bool(result.converged.all())
    assert bool((sim.cable_tension >= 0.0).all())
    np.testing.assert_allclose(sim.cable_displacement[0].cpu().numpy(), 0.002, rtol=1e-7)
    tip = (np.abs(mesh.nodes - [LENGTH, WIDTH / 2, WIDTH / 2]).sum(axis=1)).argmin()
    rise = sim.node_x[:, tip, 2].cpu().numpy() - WIDTH / 2
    assert rise[1] > 5e-3 and rise[2] < -5e-3 and abs(rise[0]) < 0.2 * rise[1]


def section(case: cases.Case, x: float) -> tuple[float, float]:
    """Mean axial displacement [m] of the cross-section at ``x``, and its rotation about y [rad]."""
    on = cases.on_plane(case.mesh, 0, x)
    u, z = case.displacements()[on, 0], case.mesh.nodes[on, 2]
    slope, mean = np.polyfit(z - WIDTH / 2, u, 1)
    return float(mean), float(slope)


def strains(cells: tuple[int, int, int], offset: float, nu: float) -> tuple[float, float]:
    """Axial strain and curvature [1/m] of the middle half of the beam, per newton of a small tension."""
    x = np.linspace(0.0, LENGTH, 9)
    path = np.stack([x, np.full(9, WIDTH / 2), np.full(9, WIDTH / 2 + offset)], axis=1)
    case = tendon_beam(cells, nu=nu, waypoints=path, control="force")
    tension = 3e-4
    case.sim.control.cable_tension.fill_(tension)
    case.sim.solve_static(tolerance=1e-8)
    (mean_0, turn_0), (mean_1, turn_1) = section(case, 0.25 * LENGTH), section(case, 0.75 * LENGTH)
    return (mean_1 - mean_0) / (0.5 * LENGTH * tension), (turn_0 - turn_1) / (0.5 * LENGTH * tension)


@pytest.mark.parametrize("nu", [0.0, 0.3])
def test_central_tendon_compresses(nu: float) -> None:
    """Offset 0: axial strain -T / EA in the middle half, by the balance of forces within 2 % on any mesh (8.1).

    The ends are left out: there the tendon's point forces dent the mesh (St Venant).
    """
    strain, _ = strains((16, 4, 4), 0.0, nu)
    assert strain == pytest.approx(-1.0 / (YOUNGS * WIDTH**2), rel=0.02)


# Axial strain over -1/EA and curvature over d/EI of the middle half under a vanishing tension, nu = 0.3, by a linear
# solve with an independent NumPy assembly on the same mesh
SAME_MESH_TENDON = {(8, 2, 2): (0.998600, 0.467440), (16, 4, 4): (1.000287, 0.769593)}


@pytest.mark.parametrize("cells", SAME_MESH_TENDON)
def test_parallel_tendon_same_mesh(cells: tuple[int, int, int]) -> None:
    """Strain and curvature per newton of a parallel tendon on the same mesh, to the 1e-4 of their nonlinearity."""
    strain, curvature = strains(cells, OFFSET, 0.3)
    shares = (-strain * YOUNGS * WIDTH**2, curvature * YOUNGS * WIDTH**4 / (12.0 * OFFSET))
    assert shares == pytest.approx(SAME_MESH_TENDON[cells], rel=1e-4)


def bending_stiffness(cells: tuple[int, int, int]) -> float:
    """T d / curvature over E I: 1 for a beam, more for a mesh of linear tetrahedra."""
    return OFFSET / (strains(cells, OFFSET, 0.3)[1] * YOUNGS * WIDTH**4 / 12.0)


def test_parallel_tendon_bends_to_the_closed_form() -> None:
    """Curvature T d / E I (8.1, 8.5) from meshes of 2 and 4 cells through the depth, extrapolated, within 3 %.

    Linear tetrahedra add an artificial bending stiffness of order h^2: 114 % and 30 % here, a ratio of 3.8.
    Richardson's extrapolation leaves the fourth order, 2 %; the axial strain is within 0.2 % of -T / EA on either mesh.
    """
    coarse, fine = bending_stiffness((8, 2, 2)), bending_stiffness((16, 4, 4))
    assert np.log2((coarse - 1.0) / (fine - 1.0)) == pytest.approx(2.0, abs=0.15)
    assert fine - (coarse - fine) / 3.0 == pytest.approx(1.0, abs=0.03)


@pytest.mark.slow
def test_parallel_tendon_on_finer_meshes() -> None:
    """The same with 4 and 8 cells through the depth, within 0.5 %."""
    coarse, fine = bending_stiffness((16, 4, 4)), bending_stiffness((32, 8, 8))
    assert fine - (coarse - fine) / 3.0 == pytest.approx(1.0, abs=5e-3)


def test_residual_is_reported() -> None:
    """The state tells how far the multiplier rows are from their laws [m]; two crossing cables settle below 1e-9 m."""
    case = tendon_beam(options={"dt": 0.02})
    case.sim.control.cable_displacement.fill_(0.003)
    settle(case, 5)
    assert case.sim.residual.shape == (1, 1) or case.sim.residual.shape == (1,)
    assert float(case.sim.residual.max()) < 1e-9


SHARES = np.array([0.1, 0.2, 0.3, 0.4])


def patched(patch: tuple[Any, Any] | None, waypoint: np.ndarray | None = None) -> tuple[sw.Simulation, np.ndarray]:
    """A beam whose end is pulled sideways by a far cable at its corners, or by nothing, and these corners."""
    mesh = meshing.box((LENGTH, WIDTH, WIDTH), (8, 2, 2))
    corners = np.flatnonzero(cases.on_plane(mesh, 0, LENGTH))[[0, 2, 6, 8]]
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    body = builder.add_tets(mesh, material=cases.material("corot", YOUNGS, NU), density=1000.0)
    builder.fix(body, nodes=np.flatnonzero(cases.on_plane(mesh, 0, 0.0)))
    mean = SHARES @ mesh.nodes[corners]
    if patch is not None:
        given = mean if waypoint is None else waypoint
        shares = (corners, SHARES) if patch == () else patch
        anchor = (mean[0], mean[1], mean[2] - 1.0e5)
        builder.add_cable(body, [given], anchor, control="force", patches={0: shares}, name="pull")
    return sw.Simulation(builder.finalize(1, precision="float64")), corners


def test_a_patch_shares_the_pull_among_its_nodes() -> None:
    """As forces in these shares do, and the cable's length is that to their mean."""
    sim, corners = patched(())
    sim.control.cable_tension[:] = 0.1
    assert sim.solve_static().converged.all()
    free, _ = patched(None)
    free.control.node_force[0, torch.tensor(corners), 2] = torch.tensor(-0.1 * SHARES)
    assert free.solve_static().converged.all()
    moved = sim.node_x[0] - torch.tensor(np.asarray(sim.model.node_rest))
    np.testing.assert_allclose(sim.node_x.numpy(), free.node_x.numpy(), atol=1e-6 * float(moved.abs().max()))
    way = float(torch.tensor(SHARES) @ moved[torch.tensor(corners), 2])
    assert way < -1e-3
    assert value(sim.cable_displacement) == pytest.approx(-way, rel=1e-4)


@pytest.mark.parametrize(
    ("patch", "told"),
    [
        (([0, 1, 2, 3, 4], [0.2] * 5), "give 1 to 4 different nodes"),
        (([8, 8], [0.5, 0.5]), "give 1 to 4 different nodes"),
        (([8, 17], [0.5, 0.6]), "shares must be positive and add up to 1"),
        (([8, 17], [1.5, -0.5]), "shares must be positive and add up to 1"),
        (([8, 17], [0.5]), "shares"),
        (([8, 100000], [0.5, 0.5]), "nodes"),
        (([8, 17], [0.5, 0.5]), "must be the mean of the patch"),
        ([8, 17], "be nodes and their shares"),
    ],
)
def test_patches_that_are_none_are_refused(patch: Any, told: str) -> None:
    with pytest.raises(ValueError, match=told):
        patched(patch)


def test_patches_belong_to_waypoints_of_soft_bodies() -> None:
    builder = sw.ModelBuilder()
    rigid = builder.add_rigid(sw.shapes.Box((0.1, 0.1, 0.1)), mass=1.0)
    with pytest.raises(ValueError, match="0 must be the number of a waypoint that a soft body carries"):
        builder.add_cable(rigid, [(0.0, 0.0, 0.0)], (1.0, 0.0, 0.0), patches={0: ([0], [1.0])})
