"""MultiGait, reduced order: the quadruped of MultiGaitFull in some 90 modes, at a small part of its price.

Scene        scenes/multi_gait.py, its body in 3 translations (with chambers="each": a frame that moves and turns with
             it), 60 deformations and 30 for contact, with few elements that stand for all; 60 sub-steps of 10 ms per
             action
Action       as MultiGaitFull:
             discrete:   symmetric: 6 choices, 0-2 fill the centre, both rear, both front legs, 3-5 empty them
                         each: 10 choices, 0-4 fill centre, front left, front right, rear left, rear right, 5-9 empty
             continuous: (3,) or (5,) in [-1, 1] -> volumes added to the same chambers, 0 to the largest
Observation  observed="points": (68,), as MultiGaitFull, so that a policy of one runs in the other
             observed="modes": (37,), 5 volumes added / largest; amplitudes of the first 32 modes / how large each was
             in the motion that they come from (root mean square)
Start        at rest on the floor, no air added, heading 0
Goal         forward: the line x = 0.2 m;  headings: a heading in +-0.35 rad
Reward       forward: centimetres won along +x (progress), or max(0, .) of them (paper);  headings: heading won / 10
             degrees;  sideways -``drift_weight`` per cm, with forward
Ends         truncated after 6 actions (3.6 s)
Success      forward: past the line;  headings: within 10 degrees

The modes come with softwarp, for each of both kinds of chambers its own, and hold no other mesh; ``reduced="FILE.npz"``
takes those of ``softwarp reduce env=multi_gait_full``.

With symmetric chambers they were learned from the full coarse mesh while both sides were filled alike at random, and
are mirror images of themselves. They tell left and right chambers not apart: the sum of their pressures moves the
robot, each is told half.

After a cycle of the hand-written gait, which the modes were not learned from, the robot stands where the full one does
within 2.5 % of the way along x (2.79 mm), after two within 0.3 %; nodes are 1.4 % of the mean place's way apart.
``assets/multi_gait/reduce.py`` made the modes.

With chambers="each", which goals="headings" needs, 90 modes live in a frame that turns with the robot. They were
learned from volumes of all five chambers drawn at random; 49 are mirror images of themselves, 41 are turned round by
the mirror. The hand-written wave turns the robot by 1.33 degrees in a cycle of four continuous actions: of eight
headings from -20 to 20 degrees it is within 10 degrees of all after 32 actions, within 5 after 60. Three cycles
turn the reduced robot by 3.60 degrees, the full one by 3.58.

``distance`` is the way to the line.
"""

from __future__ import annotations

from functools import cached_property
from pathlib import Path

import torch
from torch import Tensor

from softwarp.envs.options.multi_gait_full import ACTION_KINDS as ACTION_KINDS
from softwarp.envs.options.multi_gait_reduced import MultiGaitReducedConfig
from softwarp.envs.tasks.multi_gait_full import LAYOUT, MultiGaitFull
from softwarp.model.floating import RIGID
from softwarp.reduction import read_about

SEEN = 32  # modes of an observation, at most
MODES = Path(__file__).parent.parent / "multi_gait_modes.npz"
TURNING_MODES = MODES.with_name("multi_gait_turning_modes.npz")


class MultiGaitReduced(MultiGaitFull):
    """See the table at the top of this file."""

    config: MultiGaitReducedConfig

    @property
    def reduced_file(self) -> str | None:
        """The modes that were asked for, or those that come with softwarp, with which chambers apart turn the robot."""
        return self.config.reduced or str(TURNING_MODES if self.config.chambers == "each" else MODES)

    @cached_property
    def _sizes(self) -> list[float]:
        """Amplitudes [m] that count as 1 in an observation, of the first modes."""
        file = str(self.reduced_file)
        sizes = read_about(file)["report"].get("amplitudes")
        if sizes is None:
            raise ValueError(
                f"{file}: it does not tell how large amplitudes are, which observed='modes' needs; make it again"
            )
        return [max(float(size), 1e-12) for size in sizes[:SEEN]]

    @property
    def layout(self) -> tuple[tuple[str, int, float], ...]:
        """Parts of an observation: name, entries, what counts as 1."""
        if self.config.observed == "points":
            return LAYOUT
        return (LAYOUT[0], *((f"mode {number}", 1, size) for number, size in enumerate(self._sizes)))

    def observe(self) -> dict[str, Tensor]:
        """See the table at the top."""
        if self.config.observed == "points":
            return super().observe()
        first = RIGID if self.sim.model.floating_count else 0
        amplitudes = self.sim.mode_q[:, first : first + len(self._sizes)].to(torch.float32)
        return {"observation": torch.cat((self.growth / self._largest, amplitudes), dim=1) * self._scale}
