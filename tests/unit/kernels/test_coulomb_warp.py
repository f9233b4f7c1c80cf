"""The GPU's sweeps, whose threads are fibers of a block here, beside the CPU's: the same way to the same solution."""

from dataclasses import dataclass

import numpy as np
import pytest
import warp as wp
from numpy.typing import NDArray

from softwarp.kernels.algebra import lanes
from softwarp.kernels.rows import anderson, coulomb, coulomb_warp, warp_system

FAR = 1.0e9
Array = NDArray[np.float64]


@dataclass
class Case:
    """Rows that only pull and contacts, with a random matrix [m/N] of the given rank and free gaps [m]."""

    rows: int
    contacts: int
    rank: int
    mu: float = 0.5

    def __post_init__(self) -> None:
        rng = np.random.default_rng(self.rank)
        self.order = self.rows + 3 * self.contacts
        half = rng.normal(size=(self.order, self.rank))
        self.matrix = half @ half.T / self.rank + 1.0e-4 * np.eye(self.order)
        self.free = 1.0e-3 * rng.normal(size=self.order)


def swept(
    case: Case, precision: str, sweeps: int, *, near: int | None, device: str = "cpu", unknowns: int = 0
) -> tuple[Array, Array, Array, float]:
    """Multipliers of rows and contacts, gaps and residual after ``sweeps``: a CPU's, or a GPU's with ``near`` rows."""
    real = wp.float64 if precision == "float64" else wp.float32

    def array(values: object) -> wp.array:
        return wp.array(np.atleast_2d(np.asarray(values, dtype=float)), dtype=real, device=device)

    def zeros(count: int) -> wp.array:
        return wp.zeros((1, max(count, 1)), dtype=real, device=device)

    rows, count, order = case.rows, case.contacts, case.order
    bounded = wp.array(np.arange(rows, dtype=np.int32), dtype=wp.int32, device=device)
    inputs = [wp.array([[count]], dtype=wp.int32, device=device), array(case.matrix.reshape(-1)), array(case.free)]
    inputs += [zeros(rows), zeros(rows), array(np.full(max(rows, 1), FAR)), array(np.full(max(rows, 1), -FAR))]
    inputs += [array(np.full(max(rows, 1), FAR)), array(np.full(max(count, 1), case.mu)), zeros(count)]
    multiplier, force, change, residual = zeros(rows), zeros(3 * count), zeros(order), zeros(1)
    history = zeros(anderson.HISTORY * order)
    limits = [sweeps, 1.0e-9 if precision == "float64" else 1.0e-7, FAR]
    if near is None:
        kernel = coulomb.kernels(lanes.variant("scalar", precision)).gauss_seidel
        outputs = [multiplier, force, change, zeros(count), history, zeros(anderson.GRAM), residual]
        wp.launch(kernel, dim=1, inputs=[bounded, rows, order, *limits, *inputs], outputs=outputs, device=device)
    else:
        own = -(-rows // 32), -(-count // 32), near, unknowns
        kernel = coulomb_warp.kernels(lanes.variant("cuda", precision), *own).gauss_seidel
        structure = [bounded, rows, order, -1, count, *limits, warp_system.stride_of(order)]
        structure.append(wp.zeros((1, 1), dtype=wp.int32, device=device))
        outputs = [multiplier, force, change, history, zeros(warp_system.entries(order)), residual]
        wp.launch(kernel, (1, 32), [*structure, *inputs], outputs, device=device, block_dim=32)
    gap = case.free + case.matrix @ change.numpy()[0].astype(float)
    return multiplier.numpy()[0].astype(float), force.numpy()[0].astype(float), gap, float(residual.numpy()[0, 0])


@pytest.mark.parametrize(
    ("precision", "near", "device"),
    [
        ("float32", 0, "cpu"),
        pytest.param("float64", 0, "cpu", marks=pytest.mark.slow),
        pytest.param("float32", 104, "cpu", marks=pytest.mark.slow),
        pytest.param("float32", 0, "cuda:0", marks=pytest.mark.cuda),
        pytest.param("float64", 0, "cuda:0", marks=pytest.mark.cuda),
        pytest.param("float32", 104, "cuda:0", marks=pytest.mark.cuda),
    ],
)
def test_a_gpu_sweeps_as_a_cpu_does(monkeypatch: pytest.MonkeyPatch, precision: str, near: int, device: str) -> None:
    monkeypatch.setattr(wp.config, "enable_cpu_blocks", True)
    fine = 1.0e-8 if precision == "float64" else 2.0e-6
    for case in (Case(4, 12, 20), Case(1, 20, 40), Case(1, 30, 100, mu=0.0)):
        for sweeps in (2, 3, 40):
            ours = swept(case, precision, sweeps, near=near, device=device)
            theirs = swept(case, precision, sweeps, near=None)
            for mine, other in zip(ours[:3], theirs[:3], strict=True):
                assert mine == pytest.approx(other, abs=fine * max(np.abs(other).max(), 1e-3) * 100)
        pulls, force, gap, residual = ours
        assert residual < 2e-7
        normal, slip = gap[case.rows :: 3], gap[case.rows :].reshape(-1, 3)[:, 1:]
        press, friction = force[::3], force.reshape(-1, 3)[:, 1:]
        assert np.all(press >= 0.0) and np.all(normal > -1e-6) and np.abs(press * normal).max() < 1e-6
        assert np.all(np.abs(pulls[: case.rows] * gap[: case.rows]) < 1e-6)
        rubs = press > 0.0
        assert rubs.any() and np.all(np.linalg.norm(friction, axis=1) <= case.mu * press * (1.0 + 1e-5))
        inside = rubs & (np.linalg.norm(friction, axis=1) < 0.99 * case.mu * press)
        assert np.abs(slip[inside]).max(initial=0.0) < 1e-6


@pytest.mark.parametrize(
    "device", [pytest.param("cpu", marks=pytest.mark.slow), pytest.param("cuda:0", marks=pytest.mark.cuda)]
)
def test_systems_in_shared_memory_have_the_same_solution(monkeypatch: pytest.MonkeyPatch, device: str) -> None:
    """Some of the systems of a solve are too large for it, others are not."""
    monkeypatch.setattr(wp.config, "enable_cpu_blocks", True)
    for case in (Case(4, 12, 20), DrawnPlate(7)):
        near, far = (swept(case, "float32", 25, near=80, device=device, unknowns=unknowns) for unknowns in (33, 0))
        for mine, other in zip(near, far, strict=True):
            assert mine == pytest.approx(other, rel=1e-6, abs=1e-9)


class DrawnPlate(Case):
    """A plate in 6 rigid motions and 24 others on 24 points, which a floor stops while it is drawn along."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        super().__init__(0, 24, 30, mu=0.7)
        x, y = rng.uniform(-1.0, 1.0, (24, 2)).T
        one, none = np.ones(24), np.zeros(24)
        rigid = np.array([[one, y, -x, none, none, none], [none, none, none, one, none, -y], [none] * 4 + [one, x]])
        rigid = rigid.transpose(2, 0, 1)
        moves = np.concatenate([rigid, 0.3 * rng.standard_normal((24, 3, 24))], axis=2).reshape(72, 30)
        self.matrix = 1.0e-3 * moves @ moves.T
        drawn = moves[:, 3:6] @ (1.0e-3 * rng.standard_normal(3))
        load = np.abs(rng.standard_normal(24))
        self.free = drawn - self.matrix[:, ::3] @ load + 2.0e-4 * rng.standard_normal(72)


@pytest.mark.parametrize("near", [None, pytest.param(0, marks=pytest.mark.slow)])
@pytest.mark.parametrize("seed", [4, 7, 31])
def test_points_drawn_along_together_come_to_rest(monkeypatch: pytest.MonkeyPatch, seed: int, near: int | None) -> None:
    """Many contacts slide, some for an instant against their friction: 541 sweeps and more without |nu|."""
    monkeypatch.setattr(wp.config, "enable_cpu_blocks", True)
    _, force, gap, residual = swept(DrawnPlate(seed), "float32", 25, near=near)
    press, friction = force[::3], np.linalg.norm(force.reshape(-1, 3)[:, 1:], axis=1)
    assert residual <= 1.0e-7
    assert np.all(gap[::3] > -2e-6) and np.abs(press * gap[::3]).max() < 2e-6
    assert np.count_nonzero(friction[press > 0] > 0.69 * press[press > 0]) > 4


@pytest.mark.slow
def test_more_rows_than_newton_takes_are_left_to_the_acceleration(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(wp.config, "enable_cpu_blocks", True)
    case = Case(0, 60, 300)
    _, force, gap, residual = swept(case, "float64", 200, near=0)
    assert 3 * np.count_nonzero(force[::3]) > warp_system.MOST
    assert residual < 1e-8 and gap[::3].min() > -1e-7
