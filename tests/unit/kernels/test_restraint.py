"""Ends of segments that are held from turning over: a GPU, which follows a line only where it must, beside a CPU."""

import numpy as np
import pytest
import warp as wp

from softwarp.kernels.algebra import lanes
from softwarp.kernels.frames import restraint

PIECES, WORLDS, H = (9, 6), 64, 0.01


def arrays(variant: lanes.Variant, values: np.ndarray) -> wp.array:
    """Rows of worlds, (world, row), in a variant's order of (pack, row, lane)."""
    ordered = values.T[None] if variant.world_fastest else values[:, :, None]
    return wp.array(np.ascontiguousarray(ordered), dtype=variant.real, device="cpu")


def held(name: str, poses: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Unknowns after ``hold_turns`` of a variant on a CPU."""
    v = lanes.variant(name, "float64")
    k, frames = restraint.kernels(v), sum(PIECES) + len(PIECES)
    shape = (1, WORLDS) if v.world_fastest else (WORLDS, 1)
    integers = {
        "telescope": np.repeat(np.arange(len(PIECES)), PIECES),
        "place": np.concatenate([np.arange(n) for n in PIECES]),
        "pieces": np.array(PIECES),
        "base": np.array([0, PIECES[0] + 1]),
        "dof": np.arange(2 * frames),
    }
    i = {key: wp.array(value.astype(np.int32), dtype=wp.int32, device="cpu") for key, value in integers.items()}
    free = np.ones((2 * frames, 3))
    free[5] = 0.0  # an end that is given is not turned back
    pose, out = arrays(v, poses), arrays(v, u)
    near = arrays(v, np.zeros((WORLDS, sum(PIECES))))
    if v.world_fastest:
        inputs = [H, i["telescope"], i["place"], i["base"], i["dof"], pose, out]
        wp.launch(k.turn_of_segment, (shape[0], sum(PIECES), shape[1]), inputs, [near], device="cpu")
    dof_free = wp.array(free, dtype=v.real, device="cpu")
    wp.launch(k.hold_turns, shape, [H, i["pieces"], i["base"], i["dof"], dof_free, pose, near], [out], device="cpu")
    found: np.ndarray = out.numpy()
    return found[0].T if v.world_fastest else found[:, :, 0]


@pytest.mark.parametrize("size", [0.2, 1.2, 2.5])
def test_a_gpu_holds_turns_as_a_cpu_does(size: float) -> None:
    """Lines bent by up to ``size`` rad a segment, half of whose worlds turn some ends far: the same numbers."""
    rng, frames = np.random.default_rng(5), sum(PIECES) + len(PIECES)
    turn = rng.normal(size=(WORLDS, frames, 3))
    turn *= size * rng.uniform(size=(WORLDS, frames, 1)) / np.linalg.norm(turn, axis=2, keepdims=True)
    half = 0.5 * np.linalg.norm(turn, axis=2, keepdims=True)
    poses = np.concatenate([0.0 * turn, turn * np.sin(half) / (2.0 * half), np.cos(half)], axis=2).reshape(WORLDS, -1)
    spin = np.where(rng.uniform(size=(WORLDS, frames, 1)) < 0.3, 1.0, 0.02) * rng.normal(size=(WORLDS, frames, 3))
    spin[::2] *= 0.1
    u = np.concatenate([rng.normal(size=spin.shape), 3.0 * spin / H], axis=2).reshape(WORLDS, -1)
    cpu, gpu = held("scalar", poses, u), held("cuda", poses, u)
    np.testing.assert_array_equal(gpu, cpu)
    changed = (cpu != u).any(axis=1)
    assert changed.any() and not changed.all()
