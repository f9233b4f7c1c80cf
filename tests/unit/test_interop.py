"""What passes between Warp and PyTorch."""

import gc

import pytest
import torch

from softwarp import interop
from softwarp.model.codes import Status


def test_worst_status_of_sub_steps_is_kept():
    """Failures outrank remarks, the larger code the smaller one; a remark outranks OK, and stays."""
    codes = torch.tensor(
        [
            [Status.OK, Status.INVERTED, Status.OK, Status.INVERTED, Status.MAX_ITERATIONS, Status.NONFINITE],
            [Status.OK, Status.OK, Status.INVERTED, Status.NONFINITE, Status.INVERTED, Status.OK],
            [Status.OK, Status.OK, Status.OK, Status.OK, Status.CONTACT_OVERFLOW, Status.INVERTED],
        ],
        dtype=torch.int32,
    )
    told = [Status.OK, Status.INVERTED, Status.INVERTED, Status.NONFINITE, Status.CONTACT_OVERFLOW, Status.NONFINITE]
    assert interop.worst_of(list(codes)).tolist() == [code.value for code in told]
    assert interop.worst_of([interop.worst_of(list(codes[:2])), codes[2]]).tolist() == [code.value for code in told]


@pytest.mark.parametrize("was_on", [True, False])
def test_no_garbage_is_collected_during_a_capture(was_on):
    """What was on is on again, after an error too; what was off stays off."""
    (gc.enable if was_on else gc.disable)()
    try:
        with pytest.raises(RuntimeError, match="capture"), interop.uncollected():
            assert not gc.isenabled()
            raise RuntimeError("capture")
        assert gc.isenabled() is was_on
    finally:
        gc.enable()


def test_a_name_that_is_not_there_is_answered_with_those_of_its_part():
    """Before names that look alike and belong to others; without any such, with all."""
    names = ("body_force", "cable_displacement", "cable_tension", "node_force")
    views = interop.Views("sim.control", {name: torch.zeros(1) for name in names})
    with pytest.raises(AttributeError, match="did you mean cable_tension, cable_displacement, node_force"):
        _ = views.cable_force
    with pytest.raises(AttributeError, match="did you mean node_force"):
        _ = views.node_forces
    with pytest.raises(AttributeError, match="'bla'; did you mean body_force, cable_displacement"):
        _ = views.bla
