"""Error of one float32 step of the trunk against float64, by passes of iterative refinement.

    softwarp bench refinement

The trunk is driven by one cable for 0.4 s in float64; then one step is taken from the same state in both precisions.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from .trunk import build

PULL = 0.02  # m
STEPS = 40


def main(arguments: Sequence[str]) -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        prog="softwarp bench refinement", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.parse_args(arguments)
    exact = build(1, "cpu", "float64")
    exact.control.cable_displacement[:, 0] = PULL
    for _ in range(STEPS):
        exact.step()
    x, v, tension = exact.node_x.clone(), exact.node_v.clone(), exact.cable_tension.clone()
    exact.step()
    for passes in range(3):
        sim = build(1, "cpu", "float32", refinement=passes)
        sim.control.cable_displacement[:, 0] = PULL
        sim.node_x.copy_(x)
        sim.node_v.copy_(v)
        sim.cable_tension.copy_(tension)
        sim.step()
        velocity = float((sim.node_v.double() - exact.node_v).norm() / exact.node_v.norm())
        cable = float((sim.cable_displacement.double() - exact.cable_displacement).abs().max())
        print(f"{passes} passes: velocity off by {100 * velocity:.2f} %, cable displacement by {1e6 * cable:.2f} um")
    return 0
