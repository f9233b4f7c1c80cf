"""Elimination of equations of contacts: in registers, by threads, and beside NumPy."""

from types import SimpleNamespace

import numpy as np
import numpy.typing as npt
import pytest
import warp as wp

from softwarp.kernels.algebra import lanes
from softwarp.kernels.rows import contact_equations, elimination

WORLDS, ROWS, CONTACTS = 8, 2, (7, 0, 3, 7, 5, 1, 2, 6)
ORDER = ROWS + 3 * max(CONTACTS)


class Equations:
    """Equations of some worlds, in the order of memory of one variant."""

    def __init__(self, kind: str, precision: str, rank: int) -> None:
        made = lanes.variant("scalar" if kind == "lanes" else kind, precision)
        self.packs, self.lanes = {"scalar": (WORLDS, 1)}.get(kind, (1, WORLDS))
        self.width = WORLDS if kind == "cuda" else self.packs
        self.is_cuda, self.real = kind == "cuda", np.float64 if precision == "float64" else np.float32
        self.k, self.variant = contact_equations.kernels(made), made
        rng = np.random.default_rng(1)
        basis = rng.normal(size=(WORLDS, ORDER, rank))
        self.w = basis @ basis.transpose(0, 2, 1)
        self.force = rng.normal(size=(WORLDS, ORDER))
        self.mode = np.zeros((WORLDS, 4 * max(CONTACTS)))
        self.mode[:, ::4] = rng.integers(0, 2, size=(WORLDS, max(CONTACTS)))
        self.softness = np.zeros((WORLDS, max(CONTACTS)))

    def array(self, values: npt.NDArray[np.float64], dtype: type | None = None) -> wp.array:
        """Rows of worlds, as (pack, row, lane)."""
        placed = values.reshape(self.packs, self.lanes, -1).transpose(0, 2, 1)
        return wp.array(np.ascontiguousarray(placed, dtype=dtype or self.real), device="cpu")

    def solved(self) -> SimpleNamespace:
        """What the kernels find, the matrix of the worlds' right-hand sides being W itself."""
        held, matrix = ORDER * elimination.ROWS, ORDER * elimination.stride_of(ORDER)
        shape = (1, -1, WORLDS) if self.is_cuda else (WORLDS, -1, 1)
        held, matrix = (wp.zeros(n * WORLDS, dtype=self.variant.real).reshape(shape) for n in (held, matrix))
        count = self.array(np.array(CONTACTS), np.int32)
        gap = self.array(np.einsum("wij,wj->wi", self.w * self._active(), self.force))
        none = self.array(np.zeros((WORLDS, ORDER)))
        active = self.array(np.ones((WORLDS, ROWS)), np.int32)
        inputs = [ROWS, ORDER, count, self.array(self.w.reshape(WORLDS, -1)), none, self.array(self.softness), active]
        inputs += [self.array(self.mode), none, gap, none]
        outputs = [self.array(np.zeros((WORLDS, n))) for n in (ORDER, ROWS, ORDER)]
        unsure = self.array(np.zeros((WORLDS, 1)), np.int32)
        self._launch(self.k.note_equations, [*inputs, outputs[2], held])
        items = ORDER if self.is_cuda else 1
        shared = [ROWS, ORDER, count, inputs[3], held, matrix]
        wp.launch(self.k.fill_matrices, self.variant.dim(self.width, items), shared, device="cpu")
        self._launch(self.k.factor_matrix, [ROWS, ORDER, count, matrix, held])
        self._launch(self.k.solve_again, [*inputs, matrix, held, *outputs, unsure])
        change = outputs[0].numpy().transpose(0, 2, 1).reshape(WORLDS, ORDER)
        return SimpleNamespace(change=change, unsure=unsure.numpy().ravel())

    def _launch(self, kernel: wp.Kernel, inputs: list[object]) -> None:
        wp.launch(kernel, dim=(self.packs, self.lanes), inputs=inputs, device="cpu")

    def _active(self) -> npt.NDArray[np.float64]:
        """1 where an unknown of a world is one, by columns."""
        contacts = np.repeat(self.mode[:, ::4] > 0.0, 3, axis=1)
        contacts &= np.arange(3 * max(CONTACTS)) < 3 * np.array(CONTACTS)[:, None]
        return np.concatenate([np.ones((WORLDS, ROWS)), contacts], axis=1)[:, None, :]

    def expected(self) -> npt.NDArray[np.float64]:
        """Forces that the right-hand sides were made of."""
        return self.force * self._active()[:, 0]


@pytest.mark.parametrize("kind", ["scalar", "lanes", "cuda"])
def test_equations_are_solved(kind: str) -> None:
    """Open contacts have no force, and places behind the contacts of a world change nothing."""
    equations = Equations(kind, "float32" if kind == "lanes" else "float64", 2 * ORDER)
    tolerance = 2e-2 if kind == "lanes" else 1e-9
    found = equations.solved()
    np.testing.assert_allclose(found.change, equations.expected(), atol=tolerance)
    assert not found.unsure.any()


@pytest.mark.parametrize("rank", [2 * ORDER, 9])
def test_ways_agree(rank: int) -> None:
    """One world after the other, worlds side by side, and threads find the same bits, also where rows repeat others."""
    found = [Equations(kind, "float32", rank).solved() for kind in ("scalar", "lanes", "cuda")]
    for other in found[1:]:
        np.testing.assert_array_equal(found[0].change, other.change)
        np.testing.assert_array_equal(found[0].unsure, other.unsure)


@pytest.mark.parametrize("kind", ["scalar", "cuda"])
def test_repeated_rows(kind: str) -> None:
    """Rows that repeat others get no force; the others make the same gaps."""
    equations = Equations(kind, "float64", 5)
    found = equations.solved()
    active = equations._active()
    made, asked = (
        np.einsum("wij,wj->wi", equations.w * active, forces) * active[:, 0]
        for forces in (found.change, equations.force)
    )
    np.testing.assert_allclose(made, asked, atol=1e-8)
    assert not found.unsure.any()
    assert (np.count_nonzero(found.change, axis=1) <= 5).all()
