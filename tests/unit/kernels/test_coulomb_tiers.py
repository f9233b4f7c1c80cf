"""Which kernel solves a world's contacts on a GPU."""

import pytest

from softwarp.kernels.algebra import lanes
from softwarp.kernels.rows import coulomb_tiers


@pytest.mark.parametrize("precision", ["float32", "float64"])
@pytest.mark.parametrize("rows", [0, 8, 60, 200])
@pytest.mark.parametrize("capacity", [1, 30, 96, 400])
def test_every_number_of_contacts_has_one_kernel_with_room_for_it(precision, rows, capacity):
    variant = lanes.variant("cuda", precision)
    tiers = coulomb_tiers.tiers(variant, rows, capacity)
    size = 8 if precision == "float64" else 4
    for count in range(capacity + 1):
        (tier,) = (tier for tier in tiers if tier.above < count <= tier.most)
        assert count <= 32 * tier.own_contacts
        if tier.near_rows:
            assert rows + 3 * count <= tier.near_rows
        assert tier.near_unknowns == 0 or tier.near_unknowns % 2 == 1
        lines = tier.near_unknowns + coulomb_tiers.LINES if tier.near_unknowns else 0
        entries = tier.near_rows * (tier.near_rows + 1) // 2 + lines * (tier.near_unknowns + 2)
        assert size * entries <= 48 * 1024
