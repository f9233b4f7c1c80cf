"""Products of a GPU's kernels for reduced bodies, run on a CPU and held against NumPy."""

import numpy as np
import pytest
import warp as wp

from softwarp.kernels.algebra import lanes
from softwarp.kernels.algebra import team as sums_of_teams
from softwarp.kernels.elements import mode_loads, mode_places, reduction, samples, tensor_sums

WORLDS, STRIDES, SAMPLES = 3, (16, 32), (2, 3)  # two bodies


def launch(kernel, dim, inputs, output):
    wp.launch(kernel, dim=dim, inputs=inputs, outputs=[output], device="cpu")
    return output.numpy()


@pytest.mark.parametrize("worlds", [3, 2 * samples.WARP])
@pytest.mark.parametrize("size", [samples.TET, samples.TRI])
def test_stiffness_in_modes(size, worlds):
    """E' K E of both bodies, on and below the diagonal, and what more samples add to it; also of whole warps."""
    draws, variant = np.random.default_rng(0), lanes.variant("cuda", "float64")
    k = samples.kernels(variant)
    half = k.half_tet if size == samples.TET else k.half_tri
    stride = np.repeat(STRIDES, SAMPLES)
    start = np.cumsum(size * stride) - size * stride
    E = [draws.normal(size=(size, s)) for s in stride]
    K = draws.normal(size=(worlds, len(stride), size, size))
    basis = wp.array(np.concatenate([e.ravel() for e in E]), dtype=wp.float64, device="cpu")
    arrays = [wp.array(a, dtype=wp.int32, device="cpu") for a in (stride, start)]
    stiffness = wp.array(K.reshape(worlds, -1), dtype=wp.float64, device="cpu")
    strip = wp.zeros((worlds, len(basis)), dtype=wp.float64, device="cpu")
    most = max(STRIDES) // samples.TILE
    launch(half, (most * len(stride), worlds), [most, *arrays, basis, stiffness], strip)
    each = [s // samples.TILE for s in STRIDES]
    squares = sum(e * (e + 1) // 2 for e in each)
    bodies = [STRIDES, np.cumsum([0, *SAMPLES]), [0, size * STRIDES[0] * SAMPLES[0]]]
    bodies = [wp.array(a, dtype=wp.int32, device="cpu") for a in bodies]
    total = wp.full((worlds, sum(s * s for s in STRIDES)), 7.0, dtype=wp.float64, device="cpu")
    for times, more in ((1.0, False), (2.0, True)):
        found = launch(k.whole_product, (squares, worlds), [size, squares, more, *bodies, basis, strip], total)
        first = 0
        for number, s in enumerate(STRIDES):
            own = [n for n, body in enumerate(np.repeat([0, 1], SAMPLES)) if body == number]
            wanted = times * sum(np.einsum("ai,wab,bj->wij", E[n], K[:, n], E[n]) for n in own)
            low = np.tril_indices(s)
            block = found[:, first : first + s * s].reshape(worlds, s, s)
            np.testing.assert_allclose(block[:, *low], wanted[:, *low], rtol=1e-12, atol=1e-12)
            first += s * s


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda:0", marks=pytest.mark.cuda)])
@pytest.mark.parametrize("modes", [16, *(pytest.param(count, marks=pytest.mark.slow) for count in (48, 80, 96))])
def test_stiffness_on_tensor_cores(modes, device):
    """E' K E of the second of two bodies with its tets and triangles, as exact as sums of float32; an odd world too."""
    draws, first, count = np.random.default_rng(modes), 5, {samples.TET: 21, samples.TRI: 10}
    wanted, arrays, stiffness, halves, scales = 0.0, [], [], [], []
    for size, many in count.items():
        E = draws.normal(size=(first + many, size, modes)).astype(np.float32)
        K = draws.normal(size=(WORLDS, first + many, size, size)).astype(np.float32)
        arrays.append(wp.array(E.ravel(), dtype=wp.float32, device=device))
        stiffness.append(wp.array(K.reshape(WORLDS, -1), dtype=wp.float32, device=device))
        parts = tensor_sums.fragments(E[first:])
        halves.append(wp.array(parts.halves, dtype=wp.int32, device=device))
        scales += [parts.most, parts.back]
        own = [a.astype(np.float64) for a in (E[first:], K[:, first:])]
        wanted = wanted + np.einsum("eai,weab,ebj->wij", own[0], own[1], own[0], optimize=True)
    begin = [number for size, many in count.items() for number in (many, first * size * modes, first * size**2)]
    total = wp.full((WORLDS, 7 + modes**2), 7.0, dtype=wp.float32, device=device)
    kernel = tensor_sums.kernels(lanes.variant("cuda", "float32"), modes).stiffness
    dim, block = (-(-WORLDS // tensor_sums.GROUP), tensor_sums.THREADS), tensor_sums.THREADS
    wp.launch(kernel, dim, [*begin, 7, *scales, *arrays, *halves, *stiffness], [total], device=device, block_dim=block)
    found = total.numpy()
    low = np.tril_indices(modes)
    error = (found[:, 7:].reshape(wanted.shape) - wanted)[:, *low]
    assert np.sqrt((error**2).mean() / (wanted[:, *low] ** 2).mean()) < 1.0e-6
    assert (found[:, :7] == 7.0).all()


@pytest.mark.parametrize("size", [samples.TET, samples.TRI])
def test_halves_are_the_rows_to_rounding(size):
    """Heads and tails at the places that tensor cores give them, to 2^-23 of a number or 2^-39 of the largest."""
    E = np.random.default_rng(size).normal(size=(11, size, 32)).astype(np.float32) * np.float32(28.0)
    E[3] *= 1e-4
    parts = tensor_sums.fragments(E)
    rounds = -(-size // 2)
    both = parts.halves.view(np.float16).reshape(2, rounds, 2, 2, 32, 4, 2).astype(np.float64)
    assert np.abs(both).max() <= 2.0**tensor_sums.TOP
    found, seen = both.sum(axis=3) * parts.back, 0
    for stage, r, tile, thread, q, row in np.ndindex(found.shape):
        sample, mode = 8 * stage + thread % 4 + 4 * (q // 2), 16 * tile + thread // 4 + 8 * (q % 2)
        is_one = sample < len(E) and 2 * r + row < size
        wanted = E[sample, 2 * r + row, mode] if is_one else 0.0
        assert abs(found[stage, r, tile, thread, q, row] - wanted) <= max(2.0**-23 * abs(wanted), 2.0**-25 * parts.back)
        seen += is_one
    assert seen == E.size and parts.most == np.abs(E).max()


@pytest.fixture(params=[(3, 1), (16, 1), (3, sums_of_teams.PARTS)], ids=["alone", "beside", "shared"])
def team(request, monkeypatch):
    """Worlds, threads for each of them and some modes, and threads of a block, which run together if they share."""
    worlds, parts = request.param
    monkeypatch.setattr(wp.config, "enable_cpu_blocks", parts > 1)
    return worlds, parts, 32 if parts > 1 else 1


def load(kernel, team, modes, inputs, output):
    """Launch a kernel of ``mode_loads`` on a CPU."""
    worlds, parts, block = team
    threads = parts * sums_of_teams.team("cpu", worlds, modes // mode_loads.GROUP)[1]
    wp.launch(kernel, threads, [parts, *inputs], [output], device="cpu", block_dim=block)
    return output.numpy()


def test_forces_on_modes(team):
    """Phi' f of both bodies is added, whatever nodes have no force; also where threads share nodes."""
    worlds = team[0]
    draws, variant = np.random.default_rng(1), lanes.variant("cuda", "float64")
    nodes, body = 9, np.array([0, 1, 1, 0, 1, 0, 0, 1, 1])
    stride = np.array(STRIDES)[body]
    start = np.cumsum(3 * stride) - 3 * stride
    basis = [draws.normal(size=(3, s)) for s in stride]
    f = draws.normal(size=(worlds, nodes, 3)) * (draws.uniform(size=(worlds, nodes, 1)) < 0.5)
    order = np.argsort(body, kind="stable")
    wide = np.concatenate([[0], np.cumsum(STRIDES)])
    arrays = [np.searchsorted(body[order], [0, 1, 2]), order, start, body, wide[:-1], STRIDES]
    arrays += [np.repeat([0, 1], STRIDES)]
    inputs = [wp.array(a, dtype=wp.int32, device="cpu") for a in arrays]
    inputs += [wp.array(np.concatenate([b.ravel() for b in basis]), dtype=wp.float64, device="cpu")]
    inputs += [wp.array(f.reshape(worlds, -1), dtype=wp.float64, device="cpu")]
    out = wp.full((worlds, int(wide[-1])), 2.0, dtype=wp.float64, device="cpu")
    kernel = mode_loads.kernels(variant).add_forces
    found = load(kernel, team, int(wide[-1]), inputs, out)
    for number, s in enumerate(STRIDES):
        wanted = 2.0 + sum(f[:, n] @ basis[n] for n in range(nodes) if body[n] == number)
        np.testing.assert_allclose(found[:, wide[number] : wide[number] + s], wanted, rtol=1e-12)


def test_forces_of_contacts_on_modes(team):
    """Phi' f of the nodes that touch something is added to forces on the dofs of their bodies' modes."""
    worlds, parts, block = team
    draws, variant, dofs = np.random.default_rng(6), lanes.variant("cuda", "float64"), 20
    nodes, blocks = (7, 21), tuple(s // 3 for s in STRIDES)
    stride, begin = np.repeat(STRIDES, nodes), np.repeat([0, blocks[0]], nodes)
    basis = [draws.normal(size=(3, s)) for s in stride]
    f = draws.normal(size=(worlds, sum(nodes), 3)) * (draws.uniform(size=(worlds, sum(nodes), 1)) < 0.5)
    mode_dof = 1 + draws.permutation(sum(blocks))
    ranges = np.repeat([[0, nodes[0]], [nodes[0], sum(nodes)]], blocks, axis=0)
    arrays = [mode_dof, ranges, begin, stride, np.cumsum(3 * stride) - 3 * stride]
    inputs = [wp.array(a, dtype=wp.int32, device="cpu") for a in arrays]
    inputs.append(wp.array(np.concatenate([b.ravel() for b in basis]), dtype=wp.float64, device="cpu"))
    forces = np.concatenate([np.full((worlds, 3 * dofs), np.nan), f.reshape(worlds, -1)], axis=1)
    inputs.append(wp.array(forces, dtype=wp.float64, device="cpu"))
    out = wp.full((worlds, 3 * dofs), 2.0, dtype=wp.float64, device="cpu")
    threads = parts * sums_of_teams.team("cpu", worlds, sum(blocks))[1]
    kernel = mode_loads.kernels(variant).touch_forces
    wp.launch(kernel, threads, [parts, dofs, *inputs], [out], device="cpu", block_dim=block)
    wanted = np.full((worlds, dofs, 3), 2.0)
    for k, dof in enumerate(mode_dof):
        at = 3 * (k - (k >= blocks[0]) * blocks[0])
        wanted[:, dof] += sum(f[:, n] @ basis[n][:, at : at + 3] for n in range(*ranges[k]))
    np.testing.assert_allclose(out.numpy(), wanted.reshape(worlds, -1), rtol=1e-12)


def test_rows_on_modes(team):
    """Rows of H on the modes of their bodies, from gradients by their points."""
    worlds = team[0]
    draws, variant = np.random.default_rng(3), lanes.variant("cuda", "float64")
    points, body = np.array([4, 7, 5]), np.array([0, 1, 1])
    stride = np.array(STRIDES)[body]
    start, wide = np.cumsum(3 * points * stride) - 3 * points * stride, np.cumsum(stride) - stride
    basis = [draws.normal(size=(3 * p, s)) for p, s in zip(points, stride, strict=True)]
    gradient = draws.normal(size=(worlds, 3 * points.sum()))
    arrays = [body, np.cumsum(points) - points, points, start, wide, np.repeat([0, 1, 2], stride), STRIDES]
    inputs = [wp.array(a, dtype=wp.int32, device="cpu") for a in arrays]
    inputs += [wp.array(np.concatenate([b.ravel() for b in basis]), dtype=wp.float64, device="cpu")]
    inputs += [wp.array(gradient, dtype=wp.float64, device="cpu")]
    out = wp.zeros((worlds, int(stride.sum())), dtype=wp.float64, device="cpu")
    kernel = mode_loads.kernels(variant).mode_rows
    found = load(kernel, team, int(stride.sum()), inputs, out)
    for row, b in enumerate(basis):
        own = gradient[:, 3 * arrays[1][row] :][:, : 3 * points[row]]
        np.testing.assert_allclose(found[:, wide[row] : wide[row] + stride[row]], own @ b, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("precision", ["float32", pytest.param("float64", marks=pytest.mark.slow)])
def test_places_of_nodes_of_two_bodies(precision):
    """X + Phi q and Phi v of nodes that threads take four at a time, some of both bodies; the rest is left alone."""
    draws, real = np.random.default_rng(2), wp.float64 if precision == "float64" else wp.float32
    listed, body = np.array([7, 0, 3, 9, 4, 1, 8, 2, 6, 5]), np.array([0, 0, 0, 1, 1, 1, 1, 1, 1, 0])
    stride = np.array(STRIDES)[body]
    start = np.cumsum(3 * stride) - 3 * stride
    basis, wide = [draws.normal(size=(3, s)) for s in stride], np.array([0, STRIDES[0]])
    rest, q = draws.normal(size=(len(body), 3)), draws.normal(size=(2, WORLDS, sum(STRIDES)))
    inputs = [wp.array(a, dtype=wp.int32, device="cpu") for a in (listed, body, start, wide, STRIDES)]
    flat = np.concatenate([b.ravel() for b in basis])
    inputs += [wp.array(a, dtype=real, device="cpu") for a in (flat, rest, *q)]
    k = mode_places.kernels(lanes.variant("cuda", precision))
    for count in (10, 9, 5):
        dim = (-(-count // mode_places.NODES), WORLDS)
        x, y, v = (wp.full((WORLDS, 30), 5.0, dtype=real, device="cpu") for _ in range(3))
        wp.launch(k.node_positions, dim, [count, *inputs[:-1]], [x], device="cpu")
        wp.launch(k.node_states, dim, [count, *inputs], [y, v], device="cpu")
        assert np.array_equal(x.numpy(), y.numpy())
        for values, amplitudes, origin in ((y, q[0], rest), (v, q[1], 0.0 * rest)):
            wanted = np.full((WORLDS, 10, 3), 5.0)
            for i in range(count):
                own = amplitudes[:, wide[body[i]] : wide[body[i]] + stride[i]]
                wanted[:, listed[i]] = own @ basis[i].T + origin[i]
            fine = 1.0e-12 if precision == "float64" else 1.0e-5
            np.testing.assert_allclose(values.numpy(), wanted.reshape(WORLDS, 30), rtol=fine, atol=fine)


@pytest.mark.parametrize("precision", ["float32", pytest.param("float64", marks=pytest.mark.slow)])
def test_velocities_of_touching_nodes(precision):
    """Phi v of nodes of two bodies, behind the dofs, as a thread for each node finds it."""
    draws, real = np.random.default_rng(6), wp.float64 if precision == "float64" else wp.float32
    body, listed, dofs = np.array([0, 1, 0, 1, 1, 0, 0]), np.array([2, 0, 5, 6, 1, 4, 3]), 2
    stride = np.array(STRIDES)[body]
    start = np.cumsum(3 * stride) - 3 * stride
    wide = [0, STRIDES[0]]

    def numbers(values):
        return wp.array(np.asarray(values), dtype=wp.int32, device="cpu")

    basis = wp.array(draws.normal(size=3 * stride.sum()), dtype=real, device="cpu")
    v = wp.array(draws.normal(size=(WORLDS, sum(STRIDES))), dtype=real, device="cpu")
    common = [numbers(wide), numbers(STRIDES), basis, v]
    variant, found = lanes.variant("cuda", precision), []
    cases = [(mode_places, [numbers(start[listed]), numbers(body)], -(-len(listed) // mode_places.NODES))]
    cases += [(reduction, [numbers(body), numbers(start)], len(listed))]
    for module, arrays, items in cases:
        out = wp.full((WORLDS, 3 * (dofs + len(listed))), 5.0, dtype=real, device="cpu")
        inputs = [dofs, numbers(listed), *arrays, *common]
        found.append(launch(module.kernels(variant).touch_velocities, (items, WORLDS), inputs, out))
    assert (found[0][:, : 3 * dofs] == 5.0).all() and (found[0][:, 3 * dofs :] != 5.0).all()
    np.testing.assert_allclose(*found, rtol=1e-5 if precision == "float32" else 1e-13, atol=1e-6)
