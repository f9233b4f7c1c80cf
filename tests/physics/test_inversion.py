"""Elements stay upright below the guard's volume ratio, and a step tells which are not. docs/theory/corotational.md."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

import softwarp as sw
from softwarp import meshing
from softwarp.envs.registry import make
from softwarp.gradients.refusals import Diverged
from softwarp.gradients.rollout import Rollout
from softwarp.gradients.worlds import DifferentiableWorlds, held_flags, told_worlds
from softwarp.solvers import partition

YOUNGS, NU = 1.0e5, 0.4
MU, LAM = YOUNGS / 2.8, YOUNGS * NU / (1.4 * 0.2)
STIFFNESS = 10.0 * (LAM + 2.0 * MU)  # Pa, of the guard


def cube(
    worlds: int = 1,
    *,
    element: str = "p1",
    dt: float = 0.01,
    clamped: bool = False,
    device: str = "cpu",
    threads: int | None = None,
    **material: Any,
) -> sw.Simulation:
    """A silicone cube of 0.1 m in 8 cells, without gravity, free or clamped at its bottom."""
    options = {"method": "large", "inversion_guard": 0.3} | material
    precision = options.pop("precision", "float64")
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    mesh = meshing.box((0.1, 0.1, 0.1), (2, 2, 2))
    body = builder.add_tets(mesh, material=sw.Corotational(YOUNGS, NU, **options), density=1000.0, element=element)
    if clamped:
        builder.fix(body, box=((-1.0, -1.0, -1.0), (1.0, 1.0, 1e-9)))
    return sw.Simulation(builder.finalize(worlds, device, precision), dt, threads=threads)


def volume_ratios(sim: sw.Simulation) -> torch.Tensor:
    """J of all linear tets, (world, tet)."""
    corners = torch.as_tensor(sim.model.tet_corners.astype(np.int64))
    x, rest = sim.node_x.cpu().double(), torch.as_tensor(sim.model.node_rest).double()
    edges, rest_edges = (p[..., corners[:, 1:], :] - p[..., corners[:, :1], :] for p in (x, rest))
    return torch.linalg.det(edges) / torch.linalg.det(rest_edges)


def squeeze(sim: sw.Simulation, stretch: tuple[float, float, float]) -> torch.Tensor:
    """Put all nodes where diag(stretch) takes them; their rest positions."""
    rest = torch.as_tensor(sim.model.node_rest).to(sim.node_x)
    sim.node_x.copy_(rest * torch.tensor(stretch, dtype=rest.dtype))
    return rest


@pytest.mark.parametrize("method", ["large", "warped"])
@pytest.mark.parametrize("element", ["p1", "p2"])
def test_pressed_flat(method: str, element: str) -> None:
    """Between rigid walls, at a share s of its height: k d (1 + 4 (d / 0.3)^2) with d = 0.3 - s, beyond 0 5 k d."""
    sims = [cube(method=method, element=element, inversion_guard=guard) for guard in (0.0, 0.3)]
    for s in (0.6, 0.31, 0.2, 0.05, -0.1):
        pressures = []
        for sim in sims:
            top = squeeze(sim, (1.0, 1.0, s))[:, 2] > 0.099
            pressures.append(float(sim.internal_force()[0, top, 2].sum()) / 0.01)
        depth = max(0.3 - s, 0.0)
        expected = -STIFFNESS * depth * (1.0 + 4.0 * min(depth / 0.3, 1.0) ** 2)
        assert pressures[1] - pressures[0] == pytest.approx(expected, rel=1e-9, abs=1e-9 * STIFFNESS)
        if method == "warped" and s > 0.0:
            assert pressures[0] == pytest.approx((LAM + 2.0 * MU) * (s - 1.0), rel=1e-6)


@pytest.mark.parametrize("element", ["p1", "p2"])
def test_forces_are_those_of_the_energy(element: str) -> None:
    """Of ``warped``, which has one; a guarded element neither pushes nor turns itself."""
    sim = cube(method="warped", element=element)
    rest = squeeze(sim, (1.1, 0.9, 0.2))
    rng = np.random.default_rng(3)
    x = sim.node_x + 0.0005 * torch.as_tensor(rng.standard_normal(rest.shape))
    way = torch.as_tensor(rng.standard_normal(rest.shape))
    energies = []
    for step in (1e-7, -1e-7):
        sim.node_x.copy_(x + step * way)
        energies.append(float(sim.elastic_energy()))
    sim.node_x.copy_(x)
    if element == "p1":
        assert float(volume_ratios(sim).min()) > 0.05 and float(volume_ratios(sim).max()) < 0.3
    force = sim.internal_force()[0]
    assert float((force * way).sum()) == pytest.approx((energies[0] - energies[1]) / 2e-7, rel=1e-6)
    scale = float(force.abs().max())
    assert float(force.sum(dim=0).abs().max()) < 1e-10 * scale
    assert float(torch.linalg.cross(sim.node_x[0], force).sum(dim=0).abs().max()) < 1e-10 * scale


def test_above_the_guard_nothing_changes() -> None:
    """A cube that is squeezed to half its height and let go has the same bits with and without."""
    ends = []
    for guard in (0.0, 0.3):
        sim = cube(9, precision="float32", inversion_guard=guard)
        squeeze(sim, (1.1, 1.1, 0.5))
        for _ in range(20):
            sim.step()
        assert float(sim.compression.max()) < 0.7
        ends.append(sim.node_x.clone())
    assert torch.equal(*ends)


@pytest.mark.parametrize("method", ["large", "warped"])
def test_crushed_cube_stays_upright(method: str) -> None:
    """Pressed from above at more and more, up to three times its modulus."""
    sims = [cube(method=method, inversion_guard=guard, precision="float32", clamped=True) for guard in (0.0, 0.3)]
    for sim in sims:
        z = torch.as_tensor(sim.model.node_rest[:, 2]).to(sim.node_x)
        sim.params.rayleigh_stiffness.fill_(0.1)
        worst = 0.0
        top = z > 0.099
        for step in range(100):
            sim.control.node_force[:, top, 2] = -3.0 * YOUNGS * 0.01 * (step / 100) / int(top.sum())
            sim.step()
            worst = max(worst, float(sim.compression))
        is_upright = int(sim.inverted_count) == 0 and worst < 1.0
        assert is_upright == (sim is sims[1])
    assert (sims[0].status == sw.Status.INVERTED).all() and (sims[1].status == sw.Status.OK).all()


@pytest.mark.parametrize(
    ("element", "precision"),
    [
        ("p1", "float32"),
        ("p1", "float64"),
        pytest.param("p2", "float32", marks=pytest.mark.slow),
        ("p2", "float64"),
    ],
)
@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda:0", marks=pytest.mark.cuda)])
def test_what_a_step_tells(device: str, element: str, precision: str) -> None:
    """Counts and compressions are those of where the step led to, world by world, and go back to none."""
    options: dict[str, Any] = {"element": element, "precision": precision, "device": device}
    sim = cube(9, inversion_guard=0.0, dt=1e-5, **options)
    assert float(sim.compression.abs().max()) == 0.0
    node = int(np.linalg.norm(sim.model.node_rest - 0.1, axis=1).argmin())
    sim.node_x[4, node] -= 0.12  # a corner through the middle of the cube
    sim.node_x[7] *= 0.95
    sim.step()
    if element == "p1":
        J = volume_ratios(sim)
        assert sim.inverted_count.tolist() == (J <= 0.0).sum(dim=1).tolist()
        assert torch.allclose(sim.compression.cpu().double(), (1.0 - J).max(dim=1).values.clamp(min=0.0), atol=1e-5)
    inverted = sim.inverted_count > 0
    assert inverted.tolist() == [world == 4 for world in range(9)]
    assert (sim.status == torch.where(inverted, sw.Status.INVERTED, sw.Status.OK)).all()
    assert not sw.Status.INVERTED.failed and float(sim.compression[7]) > 0.05
    alone = cube(1, inversion_guard=0.0, dt=1e-5, **options)
    alone.restore(sim.snapshot([4]))
    assert int(alone.inverted_count) == int(sim.inverted_count[4])
    sim.reset()
    sim.step()
    assert not sim.inverted_count.any() and (sim.status == sw.Status.OK).all()


def test_failed_world_keeps_what_it_told() -> None:
    """A step that is rolled back changes neither count nor compression."""
    sim = cube(3)
    squeeze(sim, (1.0, 1.0, 0.8))
    sim.step()
    before = sim.compression.clone()
    sim.control.node_force[1] = float("nan")
    sim.step()
    assert sw.Status(int(sim.status[1])).failed and float(sim.compression[1]) == float(before[1])


@pytest.mark.slow
def test_trunk_stays_upright_whatever_is_commanded() -> None:
    """Full commands that change every half second crush the trunk; without a guard, elements turn inside out."""
    env = make("Trunk", num_worlds=8, seed=5)
    generator = torch.Generator().manual_seed(5)
    env.reset()
    worst = 0.0
    for step in range(40):
        if step % 10 == 0:
            action = (torch.rand(8, env.action_size, generator=generator) < 0.5).float() * 2.0 - 1.0
        env.step(env.fake_tensordict().set("action", action))
        worst = max(worst, float(env.sim.compression.max()))
        assert not env.sim.inverted_count.any()
    assert worst > 0.7  # so far that the guard has held


@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_steps_of_inverted_worlds_are_bounded(precision: str) -> None:
    """Corners that fly apart by more than half an edge a step do not where elements are inside out, and do elsewhere.

    All velocities of such a world are shortened by the same factor; the other worlds keep their bits.
    """
    ends = []
    for restrained in (False, True):
        sim = cube(10, precision=precision, inversion_guard=0.4)
        term = next(t for t in sim._systems[0].terms if hasattr(t, "restrains"))
        assert term.restrains
        term.restrains = restrained
        middle = int((torch.as_tensor(sim.model.node_rest) - 0.05).norm(dim=1).argmin())
        sim.node_x[3, middle, 0] += 0.06
        sim.step()
        assert sim.status.tolist() == [0, 0, 0, -1, 0, 0, 0, 0, 0, 0]
        sim.node_v[2:4] = 60.0 * torch.as_tensor(sim.model.node_rest - 0.05).to(sim.node_v)
        sim.node_v[2:4, 0] += 30.0
        before = sim.node_x.clone()
        sim.step()
        assert bool((sim.status < 3).all())
        corners = torch.as_tensor(sim.model.tet_corners.astype(np.int64))
        moved = (sim.node_x - before)[:, corners]
        apart = (moved[:, :, 1:] - moved[:, :, :1]).norm(dim=-1).amax(dim=(1, 2)) / 0.05
        ends.append((apart, sim.node_x.clone(), sim.node_v.clone()))
    (free, x0, v0), (held, x1, v1) = ends
    assert float(free[2]) > 0.6 and float(free[3]) > 0.6
    assert float(held[3]) == pytest.approx(0.5, rel=1e-4)
    others = [0, 1, 2, 4, 5, 6, 7, 8, 9]
    assert torch.equal(x0[others], x1[others]) and torch.equal(v0[others], v1[others])
    factor = 0.5 / free[3]
    torch.testing.assert_close(v1[3], factor * v0[3], rtol=1e-4, atol=1e-4)


def test_rollouts_refuse_steps_that_were_held_back() -> None:
    """They take these steps to the bit; a gradient knows nothing of what was held back, so that there is none."""
    sim = cube(2, inversion_guard=0.4)
    middle = int((torch.as_tensor(sim.model.node_rest) - 0.05).norm(dim=1).argmin())
    sim.node_x[1, middle, 0] += 0.06
    sim.step()
    assert sim.status.tolist() == [0, -1]
    sim.node_v[1] = 60.0 * torch.as_tensor(sim.model.node_rest - 0.05).to(sim.node_v)
    sim.node_v[1, 0] += 30.0
    worlds, rollout = DifferentiableWorlds(sim), Rollout(sim)
    worlds.start()
    worlds.step()
    assert worlds.held.tolist() == [False, True]
    start = sim.snapshot()
    sim.step()
    assert torch.equal(worlds.state["node_x"], sim.node_x)
    sim.restore(start)
    with pytest.raises(Diverged, match="steps were held back in world 1 and 0 others"):
        rollout(steps=1)
    sim.reset()
    rollout(steps=1)
    worlds.start()
    worlds.step()
    assert not worlds.held.any()


@pytest.mark.parametrize("world", [1, 39])
def test_world_that_was_held_back_is_named(world: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Among shards that one thread steps in turns, in the same workspace."""
    monkeypatch.setattr(partition, "SHARD_BYTES", 1.0)
    sim = cube(40, inversion_guard=0.4, precision="float32", threads=1)
    assert len(sim.systems) == 5
    middle = int((torch.as_tensor(sim.model.node_rest) - 0.05).norm(dim=1).argmin())
    sim.node_x[world, middle, 0] += 0.06
    sim.step()
    sim.node_v[world] = 60.0 * torch.as_tensor(sim.model.node_rest - 0.05).to(sim.node_v)
    sim.node_v[world, 0] += 30.0
    sim.step()
    told = told_worlds(held_flags(sim.systems), sim.status != 0)
    assert told.nonzero().flatten().tolist() == [world]
