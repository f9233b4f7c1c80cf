"""Model order reduction: soft bodies at the price of some dozens of modes. Theory: docs/theory/reduction.md.

motion = reduction.record(sim, drive, steps=600, every=10)        # states of the full model
small = reduction.train(sim, body, motion, tolerance=1e-3)        # modes, and the elements that stand for all
small.save("finger.npz")
builder.reduce(body, reduction.Reduction.load("finger.npz"))      # in a scene with the same mesh
"""

from softwarp.reduction.basis import Basis, pod
from softwarp.reduction.error import Deviation, deviation
from softwarp.reduction.file import Reduction, ReductionFileError, read_about
from softwarp.reduction.motion import Motion, record, sweep
from softwarp.reduction.sampling import Sampling, sample_elements
from softwarp.reduction.training import train

__all__ = [
    "Basis",
    "Deviation",
    "Motion",
    "Reduction",
    "ReductionFileError",
    "Sampling",
    "deviation",
    "pod",
    "read_about",
    "record",
    "sample_elements",
    "sweep",
    "train",
]
