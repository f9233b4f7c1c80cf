"""What passes between Warp and PyTorch."""

import torch

from softwarp import interop
from softwarp.model.codes import Status


def test_worst_status_of_sub_steps_is_kept():
    """Failures outrank remarks, the larger code the smaller one; a remark outranks OK, and stays."""
    worst = torch.full((6,), Status.OK.value, dtype=torch.int32)
    codes = torch.tensor(
        [
            [Status.OK, Status.INVERTED, Status.OK, Status.INVERTED, Status.MAX_ITERATIONS, Status.NONFINITE],
            [Status.OK, Status.OK, Status.INVERTED, Status.NONFINITE, Status.INVERTED, Status.OK],
            [Status.OK, Status.OK, Status.OK, Status.OK, Status.CONTACT_OVERFLOW, Status.INVERTED],
        ],
        dtype=torch.int32,
    )
    for status in codes:
        interop.keep_worst(worst, status)
    told = [Status.OK, Status.INVERTED, Status.INVERTED, Status.NONFINITE, Status.CONTACT_OVERFLOW, Status.NONFINITE]
    assert worst.tolist() == [code.value for code in told]
