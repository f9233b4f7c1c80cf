"""The benchmark of gradients through a step runs, and tells every figure that the documentation quotes from it."""

import pytest

from benchmarks import adjoint


@pytest.mark.slow
def test_every_pass_is_told() -> None:
    """On the coarsest trunk, once; whatever takes both the step and more takes longer than the step."""
    record = adjoint.run(1, "cpu", "coarse", 1)
    passes = ("adjoint_kept", "adjoint_kept_parameters", "adjoint_solved", "adjoint_solved_parameters")
    assert all(record[name] > 0.0 for name in ("plain_ms", "mb_per_kept_step", "kept", *passes))
    assert record[f"forward_{adjoint.DIRECTIONS}"] > record["forward_1"] > 0.0
