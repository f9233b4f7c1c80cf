"""Bodies of quadratic tetrahedra with contact, cables, chambers, frames, markers, pictures and files."""

import numpy as np
import pytest

import softwarp as sw
from softwarp import meshing
from tests import cases


def beam(builder: sw.ModelBuilder, law: str = "corot", youngs: float = 1e6, nu: float = 0.3) -> int:
    """0.2 x 0.02 x 0.02 m along x in (10, 1, 1) cells."""
    mesh = meshing.box((0.2, 0.02, 0.02), (10, 1, 1))
    return builder.add_tets(mesh, material=cases.material(law, youngs, nu), density=1000.0, element="p2")


ROOT = ((-1.0, -1.0, -1.0), (1e-9, 1.0, 1.0))


@pytest.mark.parametrize("cells", [2, pytest.param(4, marks=pytest.mark.slow)])
def test_block_rests_on_the_ground(cells: int) -> None:
    """Soft cube on a frictionless plane: mean u_z of the top -8.77834e-3 m on (4,4,4), loads sum to the weight (7.12).

    Nodes of edges touch like corners. Two cells are 1.5 % off.
    """
    mesh = meshing.elevate(meshing.box((0.1,) * 3, (cells,) * 3))
    builder = sw.ModelBuilder()
    block = builder.add_tets(mesh, material=sw.NeoHookean(5e3, 0.3), density=1000.0)
    plane = builder.add_rigid(sw.Plane(), kinematic=True)
    builder.add_contact(block, plane)
    model = builder.finalize(precision="float64", contact_capacity=(2 * cells + 1) ** 2)
    sim = sw.Simulation(model, dt=0.1, newton_iterations=5)
    for _ in range(30):
        sim.step()
    x = sim.node_x[0].numpy()
    top = mesh.nodes[:, 2] > 0.1 - 1e-9
    assert (x - mesh.nodes)[top, 2].mean() == pytest.approx(-8.77834e-3, rel=1e-4 if cells == 4 else 2e-2)
    np.testing.assert_allclose(sim.contact_force(block, plane)[0], [0.0, 0.0, 9.81], atol=1e-6)
    assert int(sim.contact_count[0]) == (2 * cells + 1) ** 2
    assert x[:, 2].min() > -1e-9


def test_tendon_bends_a_beam() -> None:
    """Constant curvature T d / E I of a straight tendon beside the axis, beam theory with strain -T / E A (8.1).

    The clamp and the pull at the end cell leave 2 % of the tip; the end point sinks in, by 3 % of the pull.
    """
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    body = beam(builder)
    builder.fix(body, box=ROOT)
    x, d, tension = np.linspace(0.0, 0.2, 21), 0.008, 4.0
    path = np.stack([x, np.full(21, 0.01), np.full(21, 0.01 + d)], axis=1)
    builder.add_cable(body, path, control="force")
    tip = builder.add_marker(body, (0.2, 0.01, 0.01))
    sim = sw.Simulation(builder.finalize(precision="float64"))
    sim.control.cable_tension.fill_(tension)
    assert bool(sim.solve_static().converged.all())
    curvature, strain = tension * d / (1e6 * 0.02**4 / 12.0), -tension / (1e6 * 0.02**2)
    angle, radius = 0.2 * curvature, (1.0 + strain) / curvature
    expected = np.array([radius * np.sin(angle), 0.01, 0.01 + radius * (1.0 - np.cos(angle))])
    bent = np.linalg.norm(expected - [0.2, 0.01, 0.01])
    np.testing.assert_allclose(sim.marker_x[0, tip], expected, atol=0.02 * bent)
    pull = 0.2 * (curvature * d - strain)
    assert float(sim.cable_displacement[0, 0]) == pytest.approx(pull, rel=0.04)


def hollow_cube(n: int = 3) -> meshing.QuadraticMesh:
    """A cube of 0.03 m whose middle cell is air."""
    mesh = meshing.box((0.03,) * 3, (n,) * 3)
    centre = mesh.nodes[mesh.tets].mean(axis=1)
    walls = (np.abs(centre - 0.015) > 0.005).any(axis=1)
    return meshing.elevate(*meshing.compact(mesh.nodes, mesh.tets[walls]))


@pytest.mark.parametrize("law", [pytest.param("large", marks=pytest.mark.slow), "nh_log"])
def test_chamber_of_six_node_faces(law: str) -> None:
    """Its wall is 4 triangles per face; its volume is det F V0 under F; a pressure on it sums to no force.

    A spherical void in an infinite solid widens by 3 p / 4 mu of its volume, a cubic one in a thin block by more.
    Pressure times the change of volume is twice the elastic energy.
    """
    mesh = hollow_cube()
    wall = meshing.voids(mesh.nodes, mesh.linear().tets)
    assert len(wall) == 1
    assert len(wall[0]) == 4 * 12
    used, triangles = np.unique(wall[0], return_inverse=True)
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    body = builder.add_tets(mesh, material=cases.material(law, 1e5, 0.3), density=1000.0)
    builder.fix(body, nodes=[0])
    builder.add_cavity(body, mesh.nodes[used], triangles.reshape(-1, 3))
    sim = sw.Simulation(builder.finalize(precision="float64"), dt=0.5, newton_iterations=4)
    F = np.array([[1.1, 0.3, -0.05], [0.02, 0.9, 0.15], [0.1, -0.2, 1.2]])
    sim.node_x.copy_(cases.tensor(sim, mesh.nodes @ F.T)[None])
    sim.refresh()
    assert float(sim.cavity_volume[0, 0]) == pytest.approx(np.linalg.det(F) * 1e-6, rel=1e-12)
    sim.reset()
    sim.control.cavity_pressure.fill_(200.0)
    for _ in range(30):
        sim.step()
    widened = float(sim.cavity_volume[0, 0]) / 1e-6 - 1.0
    mu = 1e5 / 2.6
    assert 0.75 * 200.0 / mu < widened < 2.5 * 200.0 / mu
    force = sim.internal_force()[0].numpy()
    assert np.abs(force.sum(axis=0)).max() < 1e-9 * np.abs(force).sum()
    work = 0.5 * 200.0 * widened * 1e-6
    assert float(sim.elastic_energy()[0]) == pytest.approx(work, rel=0.02)


@pytest.mark.parametrize("law", ["large", "nh_log"])
def test_frame_carries_nodes(law: str) -> None:
    """Nodes on a kinematic body at rest are fixed ones: the damped beam comes to rest at the same place, to 0.3 %.

    The rest is the lumped weight of the elements at the root.
    """
    sags = []
    for is_carried in (False, True):
        builder = sw.ModelBuilder(gravity=(0.0, 0.0, -9.81))
        body = beam(builder, law, youngs=3e5)
        if is_carried:
            base = builder.add_rigid(mass=1.0, inertia=(1.0, 1.0, 1.0), kinematic=True)
            builder.attach(body, to=base, box=ROOT)
        else:
            builder.fix(body, box=ROOT)
        builder.add_marker(body, (0.2, 0.01, 0.01))
        sim = sw.Simulation(builder.finalize(precision="float64"), dt=0.1, newton_iterations=6)
        for _ in range(40):
            sim.step()
        sags.append(0.01 - float(sim.marker_x[0, 0, 2]))
    assert sags[0] > 0.01
    assert sags[1] == pytest.approx(sags[0], rel=3e-3)


@pytest.mark.parametrize("law", ["large", "nh_log"])
def test_body_on_a_free_frame_keeps_momentum(law: str) -> None:
    """A rigid hub with a soft arm, thrown and spun: nothing from outside, damping included."""
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    mesh = meshing.box((0.1, 0.02, 0.02), (4, 1, 1))
    arm = builder.add_tets(
        mesh, material=cases.material(law, 2e5, 0.4), density=1000.0, rayleigh=(0.0, 0.01), element="p2"
    )
    hub = builder.add_rigid(sw.shapes.Box((0.02,) * 3), density=1000.0, pose=(-0.01, 0.01, 0.01))
    builder.attach(arm, to=hub, box=ROOT)
    sim = sw.Simulation(builder.finalize(precision="float64"), dt=0.002, newton_iterations=10)
    sim.node_v[..., 1] = 5.0 * (sim.node_x[..., 0] + 0.01)
    sim.body_twist[..., 5] = 5.0
    sim.refresh()
    start, angular = sim.momentum()
    for _ in range(50):
        sim.step()
    end, turned = sim.momentum()
    np.testing.assert_allclose(end, start, atol=1e-9 * float(start.abs().max()))
    # backward Euler keeps the moment of momentum up to the order of the step
    np.testing.assert_allclose(turned, angular, rtol=0.02, atol=1e-9)
    assert float(sim.elastic_energy()[0]) > 0.0


@pytest.mark.parametrize("law", ["large", "nh_log"])
def test_linear_and_quadratic_bodies_share_a_scene(law: str) -> None:
    """A linear body with a membrane beside a quadratic one: each moves as it does alone, to rounding."""

    def scene(kinds: str) -> tuple[sw.Simulation, dict[str, slice]]:
        builder, where, first = sw.ModelBuilder(gravity=(0.0, 0.0, -9.81)), {}, 0
        for element in kinds.split():
            mesh = meshing.box((0.1, 0.02, 0.02), (4, 1, 1))
            body = builder.add_tets(
                meshing.TetMesh(mesh.nodes + (0.0, 0.1 * (element == "p2"), 0.0), mesh.tets),
                material=cases.material(law, 1e5, 0.4),
                density=1000.0,
                rayleigh=(0.1, 0.01),
                element=element,  # type: ignore[arg-type]
            )
            builder.fix(body, box=ROOT)
            builder.add_marker(body, (0.1, 0.01 + 0.1 * (element == "p2"), 0.01))
            builder.add_membrane(body, builder.bodies[body].mesh.surface()[:4], thickness=1e-4, youngs=1e6)
            count = len(builder.bodies[body].mesh.nodes)
            where[element], first = slice(first, first + count), first + count
        return sw.Simulation(builder.finalize(precision="float64"), dt=0.01, newton_iterations=2), where

    runs = {}
    for kinds in ("p1", "p2", "p1 p2", "p2 p1"):
        sim, where = scene(kinds)
        for _ in range(20):
            sim.step()
        runs[kinds] = {element: sim.node_x[0, rows].numpy().copy() for element, rows in where.items()}
        assert float(sim.elastic_energy()[0]) > 0.0
    for kinds in ("p1 p2", "p2 p1"):
        for element in ("p1", "p2"):
            np.testing.assert_allclose(runs[kinds][element], runs[element][element], atol=1e-12)
    assert np.abs(runs["p1"]["p1"][:, 2].min() - runs["p2"]["p2"][:, 2].min()) > 1e-3


def test_markers_and_surface_follow_the_nodes() -> None:
    """Markers on nodes, on an edge and inside an element; the surface has four facets per face, all ten nodes."""
    builder = sw.ModelBuilder()
    body = beam(builder)
    mesh = builder.bodies[body].mesh
    corner, middle = 3, len(meshing.box((0.2, 0.02, 0.02), (10, 1, 1)).nodes) + 5
    places = [mesh.nodes[corner], mesh.nodes[middle], [0.0713, 0.0121, 0.0087]]
    for place in places:
        builder.add_marker(body, place)
    sim = sw.Simulation(builder.finalize(precision="float64"))
    assert sim.model.tet_count == 0
    assert sim.model.quadratic_count == 60
    x = mesh.nodes
    bent = np.stack([x[:, 0], x[:, 1], x[:, 2] + 5.0 * x[:, 0] ** 2], axis=1)
    sim.node_x.copy_(cases.tensor(sim, bent)[None])
    sim.refresh()
    np.testing.assert_allclose(sim.marker_x[0, 0], bent[corner])
    np.testing.assert_allclose(sim.marker_x[0, 1], bent[middle])
    lifted = 0.0087 + 5.0 * 0.0713**2
    # linear between nodes 0.01 m apart: at most 10 (0.01)^2 / 8 above the parabola
    assert lifted <= float(sim.marker_x[0, 2, 2]) <= lifted + 10.0 * 0.01**2 / 8.0
    assert len(sim.model.surface_tri) == 4 * len(meshing.box((0.2, 0.02, 0.02), (10, 1, 1)).surface())


def test_stress_of_a_homogeneous_state() -> None:
    """Von Mises stress at all nodes is that of the law at F."""
    F = np.diag([1.2, 0.95, 0.9])
    mesh = meshing.elevate(meshing.box((0.1, 0.1, 0.1), (2, 1, 1)))
    case = cases.body(mesh, "nh_log", 1e5, 0.3)
    case.move(mesh.nodes @ F.T)
    cauchy = cases.material("nh_log", 1e5, 0.3).stress(F) @ F.T / np.linalg.det(F)
    deviator = cauchy - np.trace(cauchy) / 3.0 * np.eye(3)
    expected = np.sqrt(1.5 * (deviator**2).sum())
    np.testing.assert_allclose(case.sim.node_stress()[0], expected, rtol=1e-10)


def test_usd_shows_edge_nodes(tmp_path) -> None:
    """The exported mesh has every surface node of the elements, edge nodes included, frame by frame."""
    from pxr import Usd, UsdGeom

    from softwarp.io.trajectory import Recorder
    from softwarp.io.usd import export_usd

    builder = sw.ModelBuilder(gravity=(0.0, 0.0, -9.81))
    body = beam(builder, "large", youngs=1e5)
    builder.fix(body, box=ROOT)
    sim = sw.Simulation(builder.finalize(), dt=0.02)
    recorder = Recorder(sim, [0], stress=True, name="arm")
    for _ in range(3):
        recorder.capture()
        sim.step()
    film = recorder.finish()
    stage = Usd.Stage.Open(str(export_usd(film, tmp_path / "arm.usdc")))
    meshes = [UsdGeom.Mesh(prim) for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh)]
    skin = np.unique(sim.model.surface_tri)
    soft = next(found for found in meshes if len(found.GetPointsAttr().Get(2)) == len(skin))
    faces = np.array(soft.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)
    assert len(faces) == 4 * len(meshing.box((0.2, 0.02, 0.02), (10, 1, 1)).surface())
    assert set(faces.ravel()) == set(range(len(skin)))
    tip = np.array(soft.GetPointsAttr().Get(2))[:, 2].min()
    assert tip < -0.001
    np.testing.assert_array_equal(np.array(soft.GetPointsAttr().Get(2)), film.vertex_x[2, 0])


def test_input_is_checked() -> None:
    """Unknown elements, a quadratic mesh for linear elements, uniform masses."""
    builder, mesh, solid = sw.ModelBuilder(), meshing.box((1.0, 1.0, 1.0), (1, 1, 1)), sw.NeoHookean(1e5, 0.3)
    with pytest.raises(ValueError, match="element must be one of p1, p2, got 'p3'"):
        builder.add_tets(mesh, material=solid, density=1.0, element="p3")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"a QuadraticMesh has element 'p2'; pass its linear\(\) for 'p1'"):
        builder.add_tets(meshing.elevate(mesh), material=solid, density=1.0, element="p1")
    with pytest.raises(ValueError, match="lumping must be 'volume' for element 'p2', got 'uniform'"):
        builder.add_tets(mesh, material=solid, density=1.0, element="p2", lumping="uniform")
    body = builder.add_tets(mesh, material=solid, total_mass=2.0, element="p2")
    assert builder.bodies[body].density == pytest.approx(2.0)
    high = meshing.elevate(mesh)
    again = builder.add_tets(high.nodes, high.elements, material=solid, density=1.0)
    np.testing.assert_array_equal(builder.bodies[again].elements, builder.bodies[body].elements)
