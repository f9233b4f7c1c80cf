"""The whole implicit step: free fall, a swinging beam on the same mesh, momentum, energy (catalogue 5.3, 5.4, 5.6)."""

from typing import Any

import numpy as np
import pytest
import torch

from softwarp import meshing
from tests import cases

CONVERGED: dict[str, Any] = {"newton_iterations": 20}
ONE_SOLVE: dict[str, Any] = {"newton_iterations": 1, "project_tangent": False}

# Catalogue 5.6: displacement [m] of (1, 0.05, 0.05) at t = 0.10, 0.25, 0.50 s, dt = 0.01. The snh rows and the corot
# row of the one-solve scheme are not in it: they come from an independent NumPy solver that gives the others to the
# last digit.
SWING = {
    ("newton", "stvk"): [
        (-0.00278254, 0.00134423, -0.07124644),
        (-0.0363949, 0.02910699, -0.24690499),
        (-0.00946905, 0.06015392, -0.11425589),
    ],
    ("newton", "nh_log"): [
        (-0.00272702, 0.00133958, -0.07125298),
        (-0.03588319, 0.02900575, -0.24771137),
        (-0.00961884, 0.06029926, -0.11655373),
    ],
    ("newton", "corot"): [
        (-0.00274688, 0.00134124, -0.07125061),
        (-0.03605517, 0.02905189, -0.2473776),
        (-0.00952845, 0.06022949, -0.11546244),
    ],
    ("newton", "snh"): [
        (-0.00273374, 0.00133965, -0.07125208),
        (-0.03594787, 0.02900949, -0.24765259),
        (-0.00964359, 0.06039104, -0.11656228),
    ],
    ("one solve", "stvk"): [
        (-0.00267685, 0.001327, -0.07109073),
        (-0.03588447, 0.02882292, -0.24536986),
        (-0.00954263, 0.05986501, -0.11536314),
    ],
    ("one solve", "nh_log"): [
        (-0.002623, 0.00132256, -0.07109708),
        (-0.03538032, 0.0287239, -0.24617495),
        (-0.00968897, 0.06001244, -0.11762953),
    ],
    ("one solve", "corot"): [
        (-0.00264227, 0.00132414, -0.07109477),
        (-0.03555003, 0.02876903, -0.24584271),
        (-0.00960045, 0.05994258, -0.11655552),
    ],
    ("one solve", "snh"): [
        (-0.00262951, 0.00132266, -0.07109597),
        (-0.03544315, 0.02872762, -0.24611299),
        (-0.00971337, 0.06010069, -0.11763619),
    ],
}


def swing(law: str, scheme: str, dt: float, times: tuple[float, ...], precision: str = "float64") -> np.ndarray:
    """Tip displacements [m] at ``times`` [s] of the beam of 5.6, gravity switched on at rest."""
    case = cases.cantilever(
        (20, 2, 2),
        law,
        youngs=5e6,
        gravity=(0.0, 0.0, -9.81),
        precision=precision,
        dt=dt,
        **(CONVERGED if scheme == "newton" else ONE_SOLVE),
    )
    tip, tips, steps = case.node(cases.TIP), [], 0
    for time in times:
        while steps < round(time / dt):
            case.sim.step()
            steps += 1
        assert int(case.sim.status[0]) == 0
        tips.append(case.displacements()[tip])
    return np.array(tips)


# One law with each scheme, in both precisions; test_elements has the forces of every law.
SWINGS = [
    pytest.param(scheme, law, *limit, marks=() if is_told else pytest.mark.slow)
    for limit in (("float64", 1e-6), ("float32", 1e-3))
    for scheme, law in SWING
    for is_told in ((scheme, law) in (("newton", "nh_log"), ("one solve", "corot")),)
]


@pytest.mark.parametrize(("scheme", "law", "precision", "tolerance"), SWINGS)
def test_swing_same_mesh(scheme: str, law: str, precision: str, tolerance: float) -> None:
    """Fifty steps of a gravity-driven beam on the same mesh, relative to the swing of 0.25 m (5.6)."""
    measured = swing(law, scheme, 0.01, (0.10, 0.25, 0.50), precision)
    assert np.abs(measured - SWING[scheme, law]).max() < 0.25 * tolerance


@pytest.mark.slow
def test_first_order_in_time() -> None:
    """The neo-Hookean u_z of 5.6 at 0.5 s for dt = 0.005 and 0.0025; order 1 against the limit -0.10306 m."""
    fine = [swing("nh_log", "newton", dt, (0.5,))[0, 2] for dt in (0.005, 0.0025)]
    assert fine == pytest.approx([-0.10975223, -0.10619998], abs=2e-7)
    order = np.log2((fine[0] + 0.10306) / (fine[1] + 0.10306))
    assert order == pytest.approx(1.0, abs=0.15)


def free_block(law: str, **options: Any) -> cases.Case:
    mesh = meshing.box((0.2, 0.1, 0.1), (4, 2, 2))
    return cases.body(mesh, law, 1e5, 0.4, **options)


@pytest.mark.parametrize("law", [*cases.LAWS, "large"])
@pytest.mark.parametrize("iterations", [1, 4])
def test_free_fall(law: str, iterations: int) -> None:
    """Position x_n = x_0 + n h v_0 + g h^2 n (n + 1) / 2 exactly: 4.95405 m after 100 steps of 0.01 s (5.3)."""
    case = free_block(law, gravity=(0.0, 0.0, -9.81), dt=0.01, newton_iterations=iterations)
    case.sim.node_v[:] = torch.tensor([0.5, -0.2, 1.0], dtype=torch.float64)
    for _ in range(100):
        case.sim.step()
    expected = case.mesh.nodes + [0.5, -0.2, 1.0 - 4.95405]
    assert np.abs(case.positions() - expected).max() < 1e-9
    assert float(case.sim.time[0]) == pytest.approx(1.0)


@pytest.mark.parametrize("dt", [0.001, 0.01])
def test_free_fall_in_float32(dt: float) -> None:
    """float32 rounds x = 5 m at 2e-7 m a step: 1e-4 m over 100 steps."""
    case = free_block("corot", gravity=(0.0, 0.0, -9.81), precision="float32", dt=dt)
    for _ in range(100):
        case.sim.step()
    drop = -9.81 * dt**2 * 100 * 101 / 2
    assert np.abs(case.displacements() - [0.0, 0.0, drop]).max() < 1e-4


def kick(case: cases.Case, rng: np.random.Generator) -> None:
    """A spin, a drift and a random jolt of every node."""
    x = case.mesh.nodes - case.mesh.nodes.mean(axis=0)
    velocity = np.cross([3.0, -2.0, 4.0], x) + [0.3, 0.1, -0.2] + 0.1 * rng.standard_normal(x.shape)
    case.sim.node_v.copy_(cases.tensor(case.sim, velocity[None]))


@pytest.mark.parametrize(
    ("law", "precision", "tolerance"), cases.in_both_precisions([*cases.LAWS, "large"], 1e-12, 1e-6)
)
@pytest.mark.parametrize("iterations", [1, 8])
def test_linear_momentum(law: str, precision: str, tolerance: float, iterations: int, rng: np.random.Generator) -> None:
    """A free, kicked block keeps sum m v: drift per step relative to sum m |v| (5.4)."""
    case = free_block(law, precision=precision, dt=0.005, newton_iterations=iterations)
    kick(case, rng)
    mass = case.sim.mass[0].double().cpu().numpy()[:, None]
    before = case.sim.node_v[0].double().cpu().numpy()
    for _ in range(20):
        case.sim.step()
    after = case.sim.node_v[0].double().cpu().numpy()
    drift = np.abs((mass * (after - before)).sum(axis=0)).max() / (mass * np.abs(before)).sum()
    assert drift < 20 * tolerance


@pytest.mark.parametrize("law", cases.LAWS)
def test_angular_momentum_loss_is_first_order(law: str, rng: np.random.Generator) -> None:
    """Backward Euler loses angular momentum at O(dt): halving dt halves the loss over the same time (5.4)."""
    losses = []
    for halvings in range(3):
        case = free_block(law, dt=0.002 / 2**halvings, newton_iterations=8)
        kick(case, np.random.default_rng(0))
        mass = case.sim.mass[0].cpu().numpy()[:, None]

        def angular(case: cases.Case = case, mass: np.ndarray = mass) -> np.ndarray:
            v = case.sim.node_v[0].cpu().numpy()
            return np.cross(case.positions() - (mass * case.positions()).sum(axis=0) / mass.sum(), mass * v).sum(axis=0)

        start = np.linalg.norm(angular())
        for _ in range(20 * 2**halvings):
            case.sim.step()
        losses.append(1.0 - np.linalg.norm(angular()) / start)
    assert 0.0 < losses[2] < losses[1] < losses[0] < 0.2
    assert np.log2(losses[1] / losses[2]) == pytest.approx(1.0, abs=0.3)


@pytest.mark.parametrize("law", cases.LAWS)
def test_energy_never_grows(law: str, rng: np.random.Generator) -> None:
    """Free and undamped, Newton converged: kinetic + elastic energy falls monotonically under backward Euler (5.4)."""
    case = free_block(law, dt=0.002, newton_iterations=12)
    kick(case, rng)
    mass = case.sim.mass[0].cpu().numpy()[:, None]
    energies = []
    for _ in range(60):
        v = case.sim.node_v[0].cpu().numpy()
        energies.append(0.5 * (mass * v**2).sum() + float(case.sim.elastic_energy()[0]))
        case.sim.step()
    change = np.diff(energies)
    assert change.max() < 1e-10 * energies[0]
    assert energies[-1] < 0.99 * energies[0]


@pytest.mark.parametrize("law", ["corot", "nh_log"])
def test_steps_end_at_the_static_answer(law: str) -> None:
    """The equilibrium does not depend on dt: damped steps of 0.01 and 0.05 s settle where ``solve_static`` does."""
    options = {"gravity": (0.0, 0.0, -9.81), "rayleigh": (2.0, 0.02)}
    case = cases.cantilever((10, 2, 2), law, **options)
    case.sim.solve_static(tolerance=1e-11)
    expected = case.positions()
    assert np.abs(expected - case.mesh.nodes).max() > 0.05
    for dt, steps in ((0.01, 1000), (0.05, 200)):
        case = cases.cantilever((10, 2, 2), law, dt=dt, **options)
        for _ in range(steps):
            case.sim.step()
        assert np.abs(case.positions() - expected).max() < 1e-6


def test_mass_lumping() -> None:
    """``volume`` gives each node a quarter of its tets' mass, ``uniform`` total / count; both add up to the total."""
    import softwarp as sw

    mesh = meshing.box((0.2, 0.1, 0.1), (4, 2, 2))
    shares = np.zeros(len(mesh.nodes))
    np.add.at(shares, mesh.tets.ravel(), np.repeat(mesh.tet_volumes / 4.0, 4))
    for lumping, expected in (("volume", shares / mesh.volume), ("uniform", np.full(len(shares), 1.0 / len(shares)))):
        builder = sw.ModelBuilder()
        builder.add_tets(mesh, material=sw.Corotational(1e5, 0.4), total_mass=0.5, lumping=lumping)
        sim = sw.Simulation(builder.finalize(precision="float64"))
        np.testing.assert_allclose(sim.mass[0].cpu().numpy(), 0.5 * expected, rtol=1e-12)
