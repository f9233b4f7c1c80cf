"""The carts' scenes against theory: how fast the stem falls, when it buckles, how it leans, how a pole moves."""

import math

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

import softwarp as sw
from softwarp.envs import registry
from softwarp.envs.scenes.cart_pole import CartPoleSceneConfig
from softwarp.envs.scenes.cart_stem import CartStemSceneConfig, StemConfig, build_cart_stem_scene
from softwarp.envs.tasks.cart_pole import CartPoleConfig
from softwarp.envs.tasks.cart_stem import CartStemConfig

G = 9.81


def bending_stiffness(config: StemConfig) -> float:
    """E I of the stem's round section [N m^2]."""
    return config.youngs * math.pi * config.radius**4 / 4.0


def stem_offsets(config: CartStemSceneConfig, steps: int, curvature: float = 0.02, newton: int = 1) -> np.ndarray:
    """Offset of the tip [m] after each step of 10 ms, of a stem let go where it is bent."""
    builder = sw.ModelBuilder(gravity=config.gravity)
    scene = build_cart_stem_scene(config, builder)
    sim = sw.Simulation(builder.finalize(precision="float64"), dt=0.01, newton_iterations=newton)
    sim.control.rod_force[:, -1, 4] = bending_stiffness(config) * curvature  # N m
    sim.params.gravity.zero_()
    assert sim.solve_static(max_iterations=400).converged.all()
    sim.control.rod_force.zero_()
    sim.params.gravity[:] = torch.tensor(config.gravity, dtype=torch.float64)
    offsets = []
    for _ in range(steps):
        sim.step()
        offsets.append(float(sim.rod_x[0, -1, 0] - sim.body_pose[0, scene.cart, 0]))
    return np.array(offsets)


def falling_rate(config: CartStemSceneConfig, dt: float, *, converged: bool) -> float:
    """Growth rate [1/s] of the offset x by m x'' + c x' - k x = 0, in steps of backward Euler.

    k = 4 P / (3 L) - 4 E I / L^3 pushes the tip aside, c = beta 4 E I / L^3 + alpha m damps, and m holds the sphere's
    turning by 2 x / L. One linearisation per step takes the elastic stiffness at the step's end, but the weight's push,
    which is in the changing direction of the stem, at its start, as SOFA does.
    """
    length, m = config.length, config.sphere_mass
    elastic = 4.0 * bending_stiffness(config) / length**3
    push = 4.0 * m * G / (3.0 * length)
    c = config.rayleigh[1] * elastic + config.sphere_damping * m
    m += 0.4 * m * config.sphere_radius**2 * (2.0 / length) ** 2

    def imbalance(rate: float) -> float:
        z = math.exp(rate * dt)
        v = (z - 1.0) / dt
        return m * v * (1.0 - 1.0 / z) / dt + c * v + elastic * z - push * (z if converged else 1.0)

    return brentq(imbalance, 1e-3, 10.0)


@pytest.mark.parametrize("newton", [1, pytest.param(3, marks=pytest.mark.slow)])
def test_stem_falls_at_its_rate(newton):
    """Left alone, the paper's stem falls by exp(0.7 t), as the equation of motion says."""
    config = CartStemSceneConfig()
    assert falling_rate(config, 1e-4, converged=True) == pytest.approx(0.715, abs=0.005)
    x = stem_offsets(config, 250, newton=newton)
    measured = np.log(x[-1] / x[-101])
    assert measured == pytest.approx(falling_rate(config, 0.01, converged=newton > 1), rel=0.005)


@pytest.mark.parametrize(("sections", "load"), [(1, 3.0), pytest.param(16, math.pi**2 / 4.0, marks=pytest.mark.slow)])
def test_stem_buckles(sections, load):
    """It stands below the tip weight 3 E I / L^2 of one section, pi^2 / 4 E I / L^2 of a rod, and falls above."""
    config = CartStemSceneConfig(sections=sections, rayleigh=(0.0, 0.05))
    critical = load * bending_stiffness(config) / config.length**2 / G
    for share in (0.96, 1.04):
        config.sphere_mass = share * critical
        x = stem_offsets(config, 300)
        assert (x[-1] > x[149]) == (share > 1.0)
        assert x[-1] > 0.0


def test_hard_stem_falls_faster():
    """Eight sections, mass and a tenth of the damping: about 3.3 1/s."""
    x = stem_offsets(CartStemConfig.hard(), 100)
    assert 2.8 < np.log(x[-1] / x[-31]) / 0.3 < 3.8


def arc(curvature: float, s: float) -> np.ndarray:
    """Sideways and upward position at arc length s [m]."""
    return np.array([(1.0 - math.cos(curvature * s)) / curvature, math.sin(curvature * s) / curvature])


def leaning(config, push: float) -> tuple[float, float]:
    """Curvature [1/m] and arc length [m] at the contact of a stem whose cart is ``push`` [m] beyond the edge."""

    def at_edge(k: float) -> float:
        return brentq(lambda s: arc(k, s)[1] - config.obstacle_height, 0.05, min(config.length, 0.5 * math.pi / k))

    k = brentq(lambda k: arc(k, at_edge(k))[0] - config.skin / math.cos(k * at_edge(k)) - push, 1e-3, 8.0)
    return k, at_edge(k)


@pytest.mark.parametrize("side", [-1, 1])
def test_stem_leans_on_an_edge(side):
    """Pushed d beyond the edge it is the arc that touches it; the tip is where the arc ends; E I L k = F dp/dk."""
    env = registry.make("CartStemContact", num_worlds=1, seed=0, goals="benchmark", end_on_success=False)
    config = env.config
    env.reset()
    for target in (0.0225, 0.035, 0.050):
        action = torch.tensor([[side * target / 0.06]])
        for _ in range(8):
            env.step(env.reset_where(torch.zeros(1, dtype=torch.bool)).set("action", action))
        cart, tip = float(env._cart_x), side * float(env._cart_x - env._tip_x)
        assert cart == pytest.approx(side * target, abs=1e-6)
        k, s = leaning(config, target - (0.05 - config.half_diagonal))
        assert tip == pytest.approx(arc(k, config.length)[0], rel=0.03, abs=2e-4)
        k = 2.0 * tip / (tip**2 + float(env.sim.rod_x[0, -1, 2]) ** 2)
        force = env.sim.contact_force(env.scene.stem, env.scene.obstacles[(side + 1) // 2])[0].numpy()
        slope = (arc(k + 1e-6, s) - arc(k - 1e-6, s)) / 2e-6
        slope += config.skin * s * np.array([math.sin(k * s), math.cos(k * s)])  # friction acts on the skin
        moment = -side * force[0] * slope[0] + force[2] * slope[1]
        assert moment == pytest.approx(bending_stiffness(config) * config.length * k, rel=0.05)  # chords


def test_true_rod_leans_less():
    """A rod of many sections is straight beyond the edge at height z: its tip is d (1 + 3 (L - z) / 2 z) aside."""
    env = registry.make(
        "CartStemContact", num_worlds=1, seed=0, goals="benchmark", end_on_success=False, sections=12, contact_pieces=2
    )
    config = env.config
    env.reset()
    target = 0.03
    for _ in range(8):
        env.step(env.reset_where(torch.zeros(1, dtype=torch.bool)).set("action", torch.tensor([[target / 0.06]])))
    d, z = target - 0.05 + config.reach, config.obstacle_height
    expected = d * (1.0 + 1.5 * (config.length - z) / z)
    assert float(env._cart_x - env._tip_x) == pytest.approx(expected, rel=0.03)


def test_tip_stiffness():
    """A small force at the tip meets 4 E I / L^3 = 1257 N/m."""
    env = registry.make("CartStemContact", num_worlds=1, seed=0, precision="float64")
    assert 4.0 * bending_stiffness(env.config) / env.config.length**3 == pytest.approx(1257.0, rel=1e-3)
    sim = env.sim
    sim.control.rod_force[:, -1, 0] = 1.0
    for _ in range(400):
        sim.step()
    assert 1.0 / float(sim.rod_x[0, -1, 0]) == pytest.approx(1257.0, rel=5e-3)


def accelerations(config: CartPoleSceneConfig, angle: float, spin: float, force: float) -> tuple[float, float]:
    """x'' and a'' of the closed form at the top of scenes/cart_pole.py."""
    m, d, g = config.pole_mass, config.hinge_distance, -config.gravity[2]
    inertia = m * (config.pole_size[0] ** 2 + config.pole_size[2] ** 2) / 12.0  # about the pole's centre, around y
    sin, cos = math.sin(angle), math.cos(angle)
    matrix = [[config.cart_mass + m, m * d * cos], [m * d * cos, inertia + m * d * d]]
    x, a = np.linalg.solve(matrix, [force + m * d * spin**2 * sin, m * g * d * sin])
    return float(x), float(a)


def motion(_: float, state: np.ndarray, config: CartPoleSceneConfig, force: float) -> list[float]:
    """Derivative of x, v, angle and spin."""
    x, a = accelerations(config, state[2], state[3], force)
    return [state[1], x, state[3], a]


def test_closed_form_is_gymnasium_s():
    """For a thin pole the closed form is that of CartPole-v1."""
    from gymnasium.envs.classic_control.cartpole import CartPoleEnv

    config, env = CartPoleConfig.classic(pole_size=(1e-6, 0.02, 1.0)), CartPoleEnv()
    env.reset(seed=0)
    for angle, spin, action in ((0.1, 0.3, 0), (-0.15, 0.8, 1), (0.05, -2.0, 1)):
        env.state = (0.0, 0.0, angle, spin)
        _, v, _, w = env.step(action)[0]
        expected = accelerations(config, angle, spin, config.force * (1 - 2 * action))
        np.testing.assert_allclose((v / env.tau, (w - spin) / env.tau), expected, rtol=1e-5)


@pytest.mark.parametrize("make", [pytest.param(CartPoleConfig, marks=pytest.mark.slow), CartPoleConfig.classic])
def test_cart_pole_follows_the_equations_of_motion(make):
    """Random forces over 40 actions: the states of the closed form, to first order in the time step."""
    errors = []
    for refine in (1, 2):
        config = make(action_kind="continuous", precision="float64", max_angle=3.0, max_x=50.0)
        config.dt, config.action_repeat = config.dt / refine, config.action_repeat * refine
        env = registry.make("CartPole", num_worlds=1, seed=3, config=config)
        state = env.reset()["observation"][0].double().numpy()
        generator = torch.Generator().manual_seed(0)
        worst = 0.0
        for _ in range(40):
            action = 0.4 * (2.0 * torch.rand(1, 1, generator=generator) - 1.0)
            force = float(action) * config.force
            moved = solve_ivp(motion, (0.0, env.control_dt), state, args=(config, force), rtol=1e-10, atol=1e-12)
            state = moved.y[:, -1]
            data = env.step(env.reset_where(torch.zeros(1, dtype=torch.bool)).set("action", action))["next"]
            worst = max(worst, float(np.abs(data["observation"][0].numpy() - state)[[0, 2]].max()))
        errors.append(worst)
    assert errors[0] < 1e-2
    assert errors[1] == pytest.approx(0.5 * errors[0], rel=0.1)
