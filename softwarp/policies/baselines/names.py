"""Names of the policies without learning, which commands know before Torch is loaded; ``table`` has what makes them."""

from collections.abc import Iterable

UNLEARNED = ("random", "nothing")  # of every environment
NAMES: dict[str, tuple[str, ...]] = {
    "Trunk": ("scripted",),
    "CartStem": ("scripted",),
    "CartStemContact": ("scripted", "direct"),
    "CatchTheObject": ("scripted",),
    "CartPole": ("scripted",),
    "StemPendulum": ("scripted",),
    "Gripper": ("scripted",),
    "Diamond": ("scripted",),
    "BubbleMotion": ("scripted",),
    "TrunkCup": ("scripted", "lookup", "hold"),
    "SimpleMaze": ("scripted",),
    "Maze": ("scripted",),
    "CatheterBeam": ("scripted",),
    "ConcentricTubeRobot": ("scripted",),
    "MultiGaitFull": ("scripted",),
    "MultiGaitReduced": ("scripted",),
}


def unknown_rule(env: str, policy: str, rules: Iterable[str]) -> str:
    """What is told of a policy that an environment does not have."""
    held = ", ".join([*rules, *UNLEARNED])
    return f"environment {env}: has no hand-written policy {policy!r}; there is: {held}; 'inverse' is inverse control"
