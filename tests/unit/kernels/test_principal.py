"""Eigenvalues and singular values of 3x3 matrices, of one world and in lanes, against NumPy."""

import numpy as np
import pytest
import warp as wp

from softwarp.kernels.algebra import lanes, principal
from softwarp.kernels.algebra.vectors import algebra
from softwarp.solvers.workspace.rows import allocate

VARIANTS = [lanes.variant("scalar", "float64"), lanes.variant("scalar"), lanes.variant("lanes")]
every_variant = pytest.mark.parametrize(
    "variant",
    [
        pytest.param(variant, id=variant.key, marks=pytest.mark.slow if variant.key == "scalar_f32" else ())
        for variant in VARIANTS  # float64 proves the source, lanes what float32 leaves of it
    ],
)
WORLDS = 8


def applied(variant, function, width, matrices):
    """Results of a kernel function on matrices (world, n, 9), (world, n, width)."""
    a, S = algebra(variant), variant.S
    read_vector, rows = a.read_vector, a.rows

    @wp.kernel(module=variant.module(f"test_principal_{width}"), enable_backward=False)
    def apply(given: wp.array2d(dtype=S), found: wp.array2d(dtype=S)):
        w, i = wp.tid()
        m = rows(read_vector(given, w, 9 * i), read_vector(given, w, 9 * i + 3), read_vector(given, w, 9 * i + 6))
        function(m, found, w, wp.static(width) * i)

    count = matrices.shape[1]
    given, found = allocate(variant, WORLDS, 9 * count, "cpu"), allocate(variant, WORLDS, width * count, "cpu")
    packs, _, width_of_pack = given.real.shape
    flat = matrices.reshape(packs, width_of_pack, -1).swapaxes(1, 2)
    given.real.assign(flat.astype(given.real.numpy().dtype))
    wp.launch(apply, dim=(packs, count), inputs=[given.S], outputs=[found.S], device="cpu")
    return found.real.numpy().swapaxes(1, 2).reshape(WORLDS, count, width)


def special():
    """Rest, reflections, equal stretches, rank 2, 1 and 0."""
    row, column = np.array([1.0, 2.0, 3.0]), np.array([3.0, 1.0, -1.0])
    flat = np.outer(row, column) + np.outer(column, row)
    diagonals = [(1, 1, 1), (1, 1, -1), (-1, -1, -1), (2, 2, 1), (1, 0.5, 0.5), (1, 0, 0), (0, 0, 3)]
    return np.array([*map(np.diag, diagonals), np.outer(row, column), flat, np.zeros((3, 3)), np.full((3, 3), 2.0)])


def near_pairs(rng, count):
    """Gradients with stretches of which two or all three are nearly equal, to parts from 1 to 1e-9, of many sizes."""
    shape = (WORLDS, count)
    s = np.exp(rng.uniform(-1.0, 1.0, (*shape, 3)) * 10.0 ** -rng.integers(0, 9, (*shape, 1)))
    s[..., 1] = s[..., 0] * (1.0 + 10.0 ** -rng.uniform(0.0, 9.0, shape))
    s = rng.permuted(s, axis=-1) * 10.0 ** rng.integers(-2, 3, (*shape, 1))
    u, v = (np.linalg.qr(rng.standard_normal((*shape, 3, 3)))[0] for _ in range(2))
    return u @ (s[..., None] * v)


@every_variant
def test_singular_values(variant, rng):
    """F = U diag(s) V', two rotations, the sign of det F in the smallest stretch: to 30 roundings, whatever F is."""
    found = principal.functions(variant)
    singular_values = found.singular_values
    a = algebra(variant)
    write_matrix, write_vector = a.write_matrix, a.write_vector

    @wp.func
    def write(F: a.Matrix, out: wp.array2d(dtype=variant.S), w: int, row: int):
        r = singular_values(F)
        write_matrix(out, w, row, r.u)
        write_vector(out, w, row + 9, r.s)
        write_matrix(out, w, row + 12, r.v)

    near = np.eye(3) + rng.standard_normal((WORLDS, 200, 3, 3)) * 10.0 ** -rng.integers(0, 9, (WORLDS, 200, 1, 1))
    cases = np.broadcast_to(special(), (WORLDS, *special().shape))
    F = np.concatenate([near, 3.0 * rng.standard_normal((WORLDS, 200, 3, 3)), cases, near_pairs(rng, 2000)], axis=1)
    out = applied(variant, write, 21, F).astype(float)
    U, s, V = out[..., :9].reshape(F.shape), out[..., 9:12], out[..., 12:].reshape(F.shape)
    eps = np.finfo(np.float64 if variant.real is wp.float64 else np.float32).eps
    size = np.linalg.norm(F, axis=(2, 3), keepdims=True)
    assert (np.abs(np.einsum("...ki,...k,...kj->...ij", U, s, V) - F) <= 30 * eps * size + 1e-11).all()
    exact = np.linalg.svd(F, compute_uv=False)
    exact[..., 2] *= np.where(np.linalg.det(F) < 0.0, -1.0, 1.0)
    sure = np.abs(exact[..., 2]) > 10 * eps * size[..., 0, 0]  # else the sign is that of rounding
    assert (np.abs(np.abs(s) - np.abs(exact)) <= 10 * eps * size[..., 0] + 1e-11).all()
    assert (np.sign(s[sure]) == np.sign(exact[sure])).all()
    full = size[..., 0, 0] > 0.0
    for rotation in (U[full], V):
        np.testing.assert_allclose(np.linalg.det(rotation), 1.0, atol=20 * eps)
        identity = np.broadcast_to(np.eye(3), rotation.shape)
        np.testing.assert_allclose(rotation @ rotation.swapaxes(-1, -2), identity, atol=20 * eps)


@every_variant
def test_principal_axes(variant, rng):
    """M = sum of d_k v_k v_k', equal eigenvalues among them: to 30 roundings."""
    a, axes = algebra(variant), principal.functions(variant).principal_axes
    Symmetric, vector, write_vector = a.Symmetric, a.vector, a.write_vector

    @wp.func
    def write(M: a.Matrix, out: wp.array2d(dtype=variant.S), w: int, row: int):
        m = Symmetric()
        m.xx = M.xx
        m.yy = M.yy
        m.zz = M.zz
        m.xy = M.xy
        m.xz = M.xz
        m.yz = M.yz
        e = axes(m)
        write_vector(out, w, row, vector(e.m.xx, e.m.yy, e.m.zz))
        write_vector(out, w, row + 3, e.x)
        write_vector(out, w, row + 6, e.y)
        write_vector(out, w, row + 9, e.z)

    root = rng.standard_normal((WORLDS, 300, 3, 3))
    pairs = near_pairs(rng, 2000)
    cases = [
        root + root.swapaxes(2, 3),
        np.broadcast_to(special()[:7], (WORLDS, 7, 3, 3)),
        pairs.swapaxes(2, 3) @ pairs,
    ]
    M = np.concatenate(cases, axis=1)
    out = applied(variant, write, 12, M).astype(float)
    d, v = out[..., :3], out[..., 3:].reshape(M.shape)
    eps = np.finfo(np.float64 if variant.real is wp.float64 else np.float32).eps
    size = np.linalg.norm(M, axis=(2, 3), keepdims=True)
    assert (np.abs(np.einsum("...ki,...k,...kj->...ij", v, d, v) - M) <= 30 * eps * size).all()
    np.testing.assert_allclose(v @ v.swapaxes(-1, -2), np.broadcast_to(np.eye(3), M.shape), atol=20 * eps)
