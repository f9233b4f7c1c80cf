"""Tubes that twist each other: their equations in float64, the criterion of snapping, rigid tubes, a simulation."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

import softwarp as sw
from softwarp.envs import tube_torsion
from softwarp.envs.options.concentric_tube_robot import ConcentricTubeRobotConfig
from softwarp.envs.scenes.concentric_tube_robot import line_of, tube_of, twisted_line_of
from softwarp.envs.tasks.concentric_tube_robot import stored_goals
from softwarp.envs.tube_line import TubeLine
from softwarp.envs.tube_torsion import TwistedLine

LENGTHS = torch.tensor([[0.058, 0.047, 0.042], [0.030, 0.052, 0.012], [0.02, 0.0, 0.0]], dtype=torch.float64)  # m
ANGLES = torch.tensor([[0.1, 1.2, -0.9], [0.0, -1.4, 0.8], [0.5, 0.2, -0.3]], dtype=torch.float64)  # rad, at tips


def robot() -> TwistedLine:
    return twisted_line_of(ConcentricTubeRobotConfig())


def integrated(twisted: TwistedLine, length: np.ndarray, tips: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Base angles [rad] and the innermost tip [m], by Runge and Kutta's method of order 8 on the equations."""
    line = twisted.line
    curved, kappa, ei, ei_end = (
        part.numpy() for part in (line.curved, line.curvature, line.stiffness, line.curved_stiffness)
    )
    stops = np.unique(np.clip(np.concatenate([[0.0], length - curved, length]), 0.0, None))

    def at(mid: float) -> tuple[np.ndarray, np.ndarray]:
        here, bent = mid < length, mid > length - curved
        k = np.where(bent, ei_end, ei) * here
        return k, np.where(bent, kappa, 0.0)

    y, shapes = np.concatenate([tips, np.zeros(3)]), []
    for low, high in zip(stops[-2::-1], stops[:0:-1], strict=True):
        k, own = at(0.5 * (low + high))

        def rate(_: float, y: np.ndarray, k: np.ndarray = k, own: np.ndarray = own) -> np.ndarray:
            x, z = k * own * np.cos(y[:3]), k * own * np.sin(y[:3])
            turn = np.where(k > 0.0, y[3:] / np.where(k > 0.0, twisted.ratio * k, 1.0), 0.0)
            return np.concatenate([turn, (z * x.sum() - x * z.sum()) / k.sum()])

        part = solve_ivp(rate, (high, low), y, method="DOP853", rtol=1e-11, atol=1e-14, dense_output=True)
        y = part.y[:, -1]
        shapes.append((low, high, k, own, part.sol))
    frame = np.concatenate([np.zeros(3), np.eye(3).reshape(-1)])
    tip = np.zeros(3)
    for low, high, k, own, psi in shapes[::-1]:

        def move(s: float, f: np.ndarray, k: np.ndarray = k, own: np.ndarray = own, psi: object = psi) -> np.ndarray:
            a = psi(s)[:3]  # type: ignore[operator]
            u = -(k * own * np.array([np.cos(a), np.sin(a)])).sum(axis=1) / k.sum()
            turn = np.array([[0.0, 0.0, u[1]], [0.0, 0.0, -u[0]], [-u[1], u[0], 0.0]])
            r = f[3:].reshape(3, 3)
            return np.concatenate([r[:, 2], (r @ turn).reshape(-1)])

        frame = solve_ivp(move, (low, high), frame, method="DOP853", rtol=1e-11, atol=1e-13).y[:, -1]
        if high <= length[0] + 1e-12:
            tip = frame[:3]
    return y[:3], tip


def test_lines_obey_their_equations(monkeypatch: pytest.MonkeyPatch) -> None:
    """Angles and tips, also where an outer tube reaches farther: within 0.05 mm, with 16 steps 1 um."""
    twisted = robot()
    for parts, close in ((tube_torsion.PARTS, 5e-5), (16, 1e-6)):
        monkeypatch.setattr(tube_torsion, "PARTS", parts)
        bases, places = twisted.from_tips(LENGTHS, ANGLES)
        for row in range(len(LENGTHS)):
            base, tip = integrated(twisted, LENGTHS[row].numpy(), ANGLES[row].numpy())
            np.testing.assert_allclose(bases[row], base, atol=100.0 * close)
            np.testing.assert_allclose(places[row], tip, atol=close)


def test_tubes_snap_where_the_criterion_says(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two equal ones, opposite: angles at bases stop to follow at L sqrt(c) = pi / 2 within 0.5 % (Dupont, 2010)."""
    monkeypatch.setattr(tube_torsion, "PARTS", 24)
    one, curvature, ratio = torch.ones(3, dtype=torch.float64), 20.0, 0.8
    twisted = TwistedLine(TubeLine(one, curvature * one, one, one), ratio)
    critical = 0.5 * math.pi / math.sqrt(curvature**2 / ratio)
    lengths = critical * torch.tensor([[0.995, 0.995, 0.0], [1.005, 1.005, 0.0]], dtype=torch.float64)
    jacobian, _ = twisted.transmission(lengths, torch.tensor([[0.0, math.pi, 0.0]] * 2, dtype=torch.float64))
    before, after = torch.linalg.det(jacobian)
    assert before > 0.0 > after


def test_rigid_tubes_have_the_closed_form() -> None:
    """With a torsion stiffness of a million times that of bending; and angles at tips are found from those at bases."""
    config = ConcentricTubeRobotConfig()
    rigid = TwistedLine(line_of(config), 1e6)
    torch.testing.assert_close(
        rigid.from_tips(LENGTHS, ANGLES)[1], line_of(config).tip(LENGTHS, ANGLES), atol=1e-7, rtol=0
    )
    twisted = robot()
    bases, _ = twisted.from_tips(LENGTHS, ANGLES)
    assert float((bases - ANGLES).abs().max()) > 0.1
    torch.testing.assert_close(twisted.from_tips(LENGTHS, twisted.tips(LENGTHS, bases))[0], bases, atol=1e-9, rtol=0)


@pytest.mark.slow
def test_simulated_tubes_come_to_rest_there() -> None:
    """Ten commands with 48 segments: half within 0.02 mm, all within 1 mm, where rigid tubes are off by up to 6 mm."""
    config, goals = ConcentricTubeRobotConfig(), stored_goals()
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    tubes = [tube_of(config, number) for number in range(3)]
    builder.add_telescope(tubes, segments=48, windup=False, rayleigh=config.rayleigh)
    sim = sw.Simulation(builder.finalize(10, precision="float64"), dt=0.01)
    length, angle = goals.length[:10].double(), goals.angle[:10].double()
    for share in np.linspace(0.0, 1.0, 100):
        sim.control.tube_length[:], sim.control.tube_angle[:] = length * share, angle * share
        sim.step()
    sim.step(600)
    twisted = robot()
    tip = twisted.from_tips(length, twisted.tips(length, angle))[1]
    off = torch.linalg.vector_norm(sim.rod_x[:, -1] - tip, dim=1)
    rigid = torch.linalg.vector_norm(sim.rod_x[:, -1] - line_of(config).tip(length, angle), dim=1)
    assert float(off.median()) < 2e-5 and float(off.max()) < 1e-3
    assert float(rigid.max()) > 5e-3
