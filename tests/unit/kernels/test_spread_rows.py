"""Rows of contacts at nodes of reduced bodies, which threads share on a GPU: on a CPU, beside those of one thread."""

import numpy as np
import pytest
import warp as wp

from softwarp.kernels.algebra import lanes
from softwarp.kernels.rows import contact, contact_panel, touch
from softwarp.model.codes import SLOTS

WORLDS, SIZE, CONTACTS, NODES = 2, 40, 3, 5
BODY_BLOCKS = (range(1, 35), range(35, 40))  # dofs of two bodies' modes; dof 0 is none


@pytest.mark.parametrize("precision", ["float32", pytest.param("float64", marks=pytest.mark.slow)])
def test_threads_share_the_modes_of_a_contact(precision: str) -> None:
    """Two nodes of one body, one of another and a dof that is no mode, to the bit as a thread alone adds them."""
    variant = lanes.variant("cuda", precision)
    real, draws = variant.real, np.random.default_rng(4)
    body = np.array([0, 0, 1, 1, 0])
    stride = np.array([112, 16])

    def numbers(values: object) -> wp.array:
        return wp.array(np.asarray(values), dtype=wp.int32, device="cpu")

    def reals(values: object, kind: object = real) -> wp.array:
        return wp.array(np.asarray(values, dtype=float), dtype=kind, device="cpu")

    modes = touch.functions(variant).Touch()
    modes.dof = numbers(np.concatenate([draws.permutation(blocks) for blocks in BODY_BLOCKS]))
    modes.begin, modes.end = numbers(np.array([0, 34])[body]), numbers(np.array([34, 39])[body])
    modes.first, modes.stride = numbers(np.array([1, 35])[body]), numbers(stride[body])
    modes.place = numbers(np.cumsum(3 * stride[body]) - 3 * stride[body])
    modes.basis = reals(draws.normal(size=3 * stride[body].sum()))
    modes.floating, modes.radius = numbers(np.full(NODES, -1)), reals(np.zeros(0))
    modes.axes = modes.arm = reals(np.zeros((1, 0, 1)))
    dof = np.full((WORLDS, CONTACTS, SLOTS), -1)
    dof[:, :, :4] = SIZE + draws.integers(0, NODES, size=(WORLDS, CONTACTS, 4))
    dof[:, 1, 2] = 0
    free = reals(draws.integers(0, 2, size=(SIZE, 3)))
    place = np.tile(np.arange(SIZE), (WORLDS, CONTACTS, 1))
    given = [draws.normal(size=(WORLDS, CONTACTS * n)) for n in (SLOTS, 3 * SLOTS, 9)]
    sides = []
    for shares in (False, True):

        def whole(values: np.ndarray, kind: object, as_three: bool) -> wp.array:
            flat = values.reshape(WORLDS, -1)
            return wp.array(flat.T[None] if as_three else flat, dtype=kind, device="cpu")

        single = not shares
        first, count = (whole(np.full(WORLDS, n), wp.int32, single) for n in (1, CONTACTS))
        inputs = [SIZE, SIZE, free, modes, first, count, whole(dof, wp.int32, single)]
        inputs += [whole(values, real, True) for values in given]
        inputs.append(whole(place, wp.int32, single))
        side = whole(np.zeros((WORLDS, 9 * SIZE * CONTACTS)), real, single)
        if shares:
            dim = (WORLDS, CONTACTS, contact_panel.SPREAD)
            wp.launch(contact_panel.kernels(variant).spread_rows, dim, inputs, [side], device="cpu")
            sides.append(side.numpy())
        else:
            kernel = contact.kernels(variant, together=True).scatter_rows
            wp.launch(kernel, (1, CONTACTS, WORLDS), inputs, [side], device="cpu")
            sides.append(side.numpy()[0].T)
    assert np.abs(sides[0]).max() > 1.0 and not sides[0][:, : 9 * SIZE].any()
    assert np.array_equal(*sides)
