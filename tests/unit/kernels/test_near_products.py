"""Blocks of W between contacts on most of a world's dofs, in shared memory on a GPU; run on a CPU's fibers here."""

import numpy as np
import pytest
import warp as wp

from softwarp.kernels.algebra import lanes
from softwarp.kernels.rows import contact, contact_panel

SIZE, CONTACTS, ROWS, WORLDS = 11, 37, 2, 2
ORDER = ROWS + 3 * CONTACTS


@pytest.mark.parametrize("precision", ["float32", pytest.param("float64", marks=pytest.mark.slow)])
@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda:0", marks=pytest.mark.cuda)])
def test_products_near_and_far(monkeypatch: pytest.MonkeyPatch, precision: str, device: str) -> None:
    """The same entries as threads without shared memory find, of late contacts too; others keep theirs."""
    monkeypatch.setattr(wp.config, "enable_cpu_blocks", True)
    variant, draws = lanes.variant("cuda", precision), np.random.default_rng(5)
    order = draws.permutation(SIZE)  # dofs by column
    place, path = np.full((WORLDS, CONTACTS, SIZE), -1), np.zeros((WORLDS, CONTACTS, SIZE), dtype=int)
    length = np.zeros((WORLDS, CONTACTS), dtype=int)
    for w in range(WORLDS):
        for c in range(CONTACTS):
            on_path = [dof for dof in order if draws.uniform() < 0.8]
            place[w, c, on_path], path[w, c, : len(on_path)] = np.arange(len(on_path)), on_path
            length[w, c] = len(on_path)

    def numbers(values: np.ndarray) -> wp.array:
        return wp.array(values.reshape(WORLDS, -1), dtype=wp.int32, device=device)

    def reals(values: np.ndarray) -> wp.array:
        return wp.array(values.reshape(WORLDS, -1), dtype=variant.real, device=device)

    column = wp.array(np.stack([order, *[np.zeros(SIZE, dtype=int)] * 3], axis=1), dtype=wp.vec4i, device=device)
    side = reals(draws.normal(size=(WORLDS, CONTACTS * SIZE * 9)))
    for first, count in (((0, 0), (CONTACTS, 9)), ((30, 3), (CONTACTS, 5))):
        span = [numbers(np.array(first)), numbers(np.array(count))]
        far, near = (reals(np.full((WORLDS, ORDER**2), 7.0)) for _ in range(2))
        inputs = [SIZE, SIZE, ROWS, ORDER, 4, *span, numbers(length), numbers(path), numbers(place), side, 0.5]
        kernel = contact.kernels(variant, together=True).delassus_contacts
        wp.launch(kernel, (WORLDS, CONTACTS, 4), inputs, [far], device=device)
        inputs = [SIZE, SIZE, ROWS, ORDER, column, *span, numbers(place), side, 0.5]
        groups, threads = -(-CONTACTS // contact_panel.NEAR_GROUP), contact_panel.THREADS
        kernel = contact_panel.kernels(variant).delassus_near
        wp.launch(kernel, (WORLDS, groups, threads), inputs, [near], device=device, block_dim=threads)
        fine = 1.0e-5 if precision == "float32" else 1.0e-13
        assert (far.numpy() != 7.0).any() and (far.numpy() == 7.0).any()
        np.testing.assert_allclose(near.numpy(), far.numpy(), rtol=fine, atol=fine)
