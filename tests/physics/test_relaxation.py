"""Maxwell branches: stiffness and loss against the standard linear solid, limits, rest, batches. SI units."""

import numpy as np
import pytest
import torch

import softwarp as sw
from softwarp import meshing

SIDE = 0.03  # m


def bar(
    relaxation=(0.0, 0.0),
    *,
    dt=0.002,
    integrator="bdf2",
    quadratic=False,
    mass=0.0,
    carried=False,
    rayleigh=(0.0, 0.0),
    worlds=1,
    precision="float64",
    gravity=0.0,
    **options,
) -> sw.Simulation:
    """A bar of 10 cm along x, one end held or carried by a body that stands still, perhaps a mass on the other."""
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, -gravity))
    mesh = meshing.box((0.1, SIDE, SIDE), (3, 1, 1) if quadratic else (6, 2, 2))
    body = builder.add_tets(
        meshing.elevate(mesh) if quadratic else mesh,
        material=sw.Corotational(youngs=2.0e5, nu=0.4),
        density=1000.0,
        rayleigh=rayleigh,
        relaxation=relaxation,
    )
    box = ((-1.0, -1.0, -1.0), (1.0e-5, 1.0, 1.0))
    if carried:
        builder.attach(body, box=box, to=builder.add_rigid(mass=1.0, inertia=(1.0, 1.0, 1.0), kinematic=True))
    else:
        builder.fix(body, box=box)
    if mass:
        plate = builder.add_rigid(mass=mass, inertia=(1e-6, 1e-6, 1e-6), pose=(0.1, 0.5 * SIDE, 0.5 * SIDE))
        builder.attach(body, box=((0.1 - 1e-6, -1.0, -1.0), (1.0, 1.0, 1.0)), to=plate)
    model = builder.finalize(num_worlds=worlds, precision=precision)
    return sw.Simulation(model, dt, integrator=integrator, **options)


def bend(sim: sw.Simulation, amplitude: float = 1.0e-4) -> None:
    """Displace by a parabola."""
    sim.node_x[..., 2] += amplitude * (sim.node_x[..., 0] / 0.1) ** 2
    if sim.model.frame_count:
        sim.frame_pose[:, -1, 2] += amplitude * (sim.frame_pose[:, -1, 0] / 0.1) ** 2
    sim.refresh()


def slowest(sim: sw.Simulation, steps: int = 300) -> complex:
    """Exponent [1/s] of the slowest mode of a bent bar let go, by the matrix pencil of its end's motion."""
    rest = sim.node_x[0].clone()
    end = int(torch.argmax(rest[:, 0] + 1.0e-3 * rest[:, 2]))
    bend(sim)
    found = []
    for _ in range(steps):
        sim.step()
        found.append(float(sim.node_x[0, end, 2] - rest[end, 2]))
    assert int(sim.status.max()) <= 0
    q = np.array(found[20:])
    half = len(q) // 2
    rows = np.linalg.svd(np.array([q[i : i + half] for i in range(len(q) - half)]), full_matrices=False)[2][:8]
    z = np.linalg.eigvals(np.linalg.pinv(rows[:, :-1].T) @ rows[:, 1:].T)
    exponents = np.log(z.astype(complex)) / sim.dt
    return complex(min(exponents[exponents.imag > 1.0], key=abs))


@pytest.mark.parametrize(
    "scene",
    [{}, {"quadratic": True}, {"quadratic": True, "mass": 0.02, "carried": True}],
    ids=["clamped", "quadratic", "frames"],
)
def test_standard_linear_solid(scene):
    """A mode stiffens and loses as the cubic says: 30 % more stiffness that decays in 14 ms."""
    ratio, time = 0.3, 0.014
    omega = abs(slowest(bar(**scene)))
    roots = np.roots([time, 1.0, omega**2 * time * (1.0 + ratio), omega**2])
    known = roots[np.argmax(roots.imag)]
    measured = slowest(bar((ratio, time), **scene))
    assert measured.imag == pytest.approx(known.imag, rel=3e-3)
    assert measured.real == pytest.approx(known.real, rel=2e-2)
    assert known.imag > 1.02 * omega


def run(sim: sw.Simulation, steps: int) -> torch.Tensor:
    """Nodes after some steps of a bent bar."""
    bend(sim)
    sim.step(steps)
    return sim.node_x.clone()


@pytest.mark.parametrize("integrator", ["euler", "bdf2"])
def test_short_times_are_rayleigh_damping(integrator):
    """A branch that fades within a hundredth of a step damps like beta = ratio time."""
    fast = run(bar((100.0, 1.0e-5), integrator=integrator), 40)
    damped = run(bar(rayleigh=(0.0, 1.0e-3), integrator=integrator), 40)
    free = run(bar(integrator=integrator), 40)
    assert (fast - damped).norm() < 0.02 * (free - damped).norm()


def test_long_times_are_a_stiffer_law():
    """A branch that hardly fades is one more spring, if it remembers the way from the unloaded shape."""
    slow, stiff = bar((0.5, 1.0e3)), bar()
    stiff.params.youngs *= 1.5
    rest = slow.node_x.clone()
    bend(slow)
    slow.node_memory.copy_(slow.node_x - rest)
    slow.step(40)
    assert (slow.node_x - run(stiff, 40)).norm() < 2.0e-3 * (slow.node_x - run(bar(), 40)).norm()


def test_rest_is_that_of_the_law():
    """The branch carries nothing at rest, whether a bar comes to it by itself or by a static solve, which forgets."""
    plain, relaxing = (bar(pair, gravity=9.81, dt=0.05, integrator="euler") for pair in ((0.0, 0.0), (0.4, 0.02)))
    plain.solve_static()
    relaxing.step(400)
    assert (relaxing.node_x - plain.node_x).abs().max() < 1.0e-9
    assert relaxing.node_memory.abs().max() < 1.0e-9
    bend(relaxing, 1.0e-3)
    relaxing.step()
    assert relaxing.node_memory.abs().max() > 1.0e-5
    relaxing.solve_static()
    assert (relaxing.node_memory == 0.0).all()


def test_newton_and_order():
    """Newton's method and one linearisation agree for small motion; second order in the step."""
    for integrator in ("euler", "bdf2"):
        once, often = (run(bar((0.3, 0.014), newton_iterations=n, integrator=integrator), 30) for n in (1, 6))
        still = bar().node_x
        assert (once - often).norm() < 2.0e-3 * (once - still).norm()
    damped = {"rayleigh": (0.0, 4.0e-3)}
    ends = [run(bar((0.3, 0.014), dt=dt, **damped), round(0.064 / dt)) for dt in (0.004, 0.002, 0.0005)]
    assert float(torch.log2((ends[0] - ends[2]).norm() / (ends[1] - ends[2]).norm())) == pytest.approx(2.0, abs=0.3)


@pytest.mark.parametrize("path", ["scalar", "lanes"])
def test_worlds_have_their_own(path):
    """Each world its ratio and time; alone as in a batch, restored as going on; one that fails keeps its memory."""
    pairs = [(0.1, 0.01), (0.3, 0.014), (0.5, 0.05)]

    def make(chosen):
        sim = bar((0.2, 0.02), worlds=len(chosen), precision="float32", solver_path=path, mass=0.02)
        sim.params.relaxation_ratio[:, 0] = torch.tensor([ratio for ratio, _ in chosen])
        sim.params.relaxation_time[:, 0] = torch.tensor([time for _, time in chosen])
        bend(sim, 1.0e-3)
        return sim

    together, alone = make(pairs), [make([pair]) for pair in pairs]
    for sim in (together, *alone):
        sim.step(7)
    saved = together.snapshot()
    for sim in (together, *alone):
        sim.step(5)
    after = together.node_x.clone()
    for world, sim in enumerate(alone):
        assert torch.equal(after[world], sim.node_x[0])
        assert torch.equal(together.node_memory[world], sim.node_memory[0])
    assert (after[0] - after[2]).abs().max() > 1.0e-5
    together.restore(saved)
    together.step(5)
    assert torch.equal(together.node_x, after)
    kept = together.node_memory.clone()
    together.control.node_force[1, 3] = float("nan")
    together.step()
    assert int(together.status[1]) == sw.Status.NONFINITE
    assert torch.equal(together.node_memory[1], kept[1])
    assert torch.isfinite(together.node_memory).all()


def test_refused():
    """Half a branch, impossible numbers, and what one scene cannot have both."""
    for bad in ((0.3, 0.0), (0.0, 0.1), (-0.1, 0.1), (0.1, float("nan")), 0.3):
        with pytest.raises((ValueError, TypeError), match="relaxation"):
            bar(bad)
    builder = sw.ModelBuilder()
    mesh = meshing.box((0.1, SIDE, SIDE), (2, 1, 1))
    builder.add_tets(mesh, material=sw.Corotational(1.0e5, 0.4), density=1000.0, relaxation=(0.3, 0.01), name="pad")
    builder.add_rod([(0, 0, 1), (0, 0, 2)], radius=0.01, youngs=1e6, rayleigh=(0.0, 0.01), name="stem")
    with pytest.raises(ValueError, match=r"'pad' has relaxation and rod 'stem'"):
        builder.finalize()
