"""Starting over where inverse control of tubes stalls: the order of things with a stand-in, and goals that need it."""

from types import SimpleNamespace

import pytest
import torch

from softwarp.control import InversePolicy, Outcome, TubeSolution
from softwarp.control.regrasp import BACK, CONTROLLED, OUT, Regrasp
from softwarp.envs import registry


class Stand:
    """Two tubes whose commands are reached at once, 10 mm and 0.5 rad a period at most."""

    def __init__(self, worlds: int = 2) -> None:
        self.now = torch.tensor([0.03, 0.02, 0.0, 0.0], dtype=torch.float64).repeat(worlds, 1)
        self.unit = torch.tensor([0.01, 0.01, 0.5, 0.5], dtype=torch.float64)
        sim = SimpleNamespace(rod_x=torch.zeros(worlds, 3, 3))
        self.response = SimpleNamespace(count=2, nodes=slice(0, 3), sim=sim)

    def present(self):
        return self.now

    def towards(self, present, command):
        return present + (command - present).clamp(-self.unit, self.unit)

    def apart(self, first, second):
        return ((first - second).abs() / self.unit).amax(dim=1)

    def told(self, *outcomes):
        stay, none = self.now.clone(), torch.zeros(len(outcomes))
        return TubeSolution(stay, none, none, torch.tensor([int(outcome) for outcome in outcomes]))


def test_a_stalled_world_draws_back_turns_and_comes_out_and_others_go_on() -> None:
    """Three periods of a stall; five to draw back and turn by 2.15 rad, two to come out by 0.4 and 0.2 of 50 mm."""
    stand = Stand()
    regrasp, targets = Regrasp(stand, wait=3), torch.tensor([[0.0, 0.03, 0.04], [0.0, 0.0, 0.05]])  # type: ignore[arg-type]
    phases, ways = [], []
    for _ in range(10):
        stand.now = regrasp.command(stand.told(Outcome.UNREACHABLE, Outcome.MOVING), targets)
        phases.append(int(regrasp.phase[0]))
        ways.append(stand.now[0].tolist())
    assert regrasp.starts.tolist() == [1, 0]
    assert stand.now[1].tolist() == [0.03, 0.02, 0.0, 0.0]  # the other world is left to the controller
    first_out = phases.index(OUT)
    assert phases == [CONTROLLED] * 2 + [BACK] * 4 + [OUT] * 2 + [CONTROLLED] * 2
    assert ways[first_out][:2] == pytest.approx([0.0, 0.0], abs=1e-9)
    end = phases.index(CONTROLLED, first_out)
    assert ways[end][:2] == pytest.approx([0.4 * 0.05, 0.2 * 0.05])
    assert max(abs(angle) for angle in ways[end][2:]) <= 2.5 and ways[end][2] != ways[end][3] != 0.0
    assert ways[first_out][2:] == pytest.approx(ways[end][2:])  # turned while drawn back


def test_starts_end_and_are_forgotten() -> None:
    """No more than two in a row; a target reached, or a new episode, allows them again; none at all with 0."""
    stand = Stand()
    targets = torch.tensor([[0.0, 0.0, 0.05]] * 2)
    regrasp, never = Regrasp(stand, restarts=2, wait=1), Regrasp(stand, restarts=0, wait=1)  # type: ignore[arg-type]
    angles = set()
    for _ in range(60):
        stand.now = regrasp.command(stand.told(Outcome.UNREACHABLE, Outcome.UNREACHABLE), targets)
        angles.add(round(float(regrasp._start[0, 2]), 6))
        never.command(stand.told(Outcome.UNREACHABLE, Outcome.UNREACHABLE), targets)
    assert regrasp.starts.tolist() == [2, 2] and never.starts.tolist() == [0, 0]
    assert len(angles) == 2  # different ones
    regrasp.command(stand.told(Outcome.REACHED, Outcome.UNREACHABLE), targets)
    assert regrasp.starts.tolist() == [0, 2]
    regrasp.begin(torch.tensor([False, True]))
    assert regrasp.starts.tolist() == [0, 0]


def test_settings_outside_their_range_are_refused() -> None:
    with pytest.raises(ValueError, match="regrasp: restarts must be an integer of at least 0, got -1"):
        Regrasp(Stand(), restarts=-1)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="regrasp: out"):
        Regrasp(Stand(), out=1.5)  # type: ignore[arg-type]


@pytest.mark.slow  # seconds; the order of things is tested above
def test_goals_that_a_hidden_tube_keeps_from_are_met() -> None:
    """Two goals at which the control stalls with the inner tube alone out, 16 and 3 mm off: held within 1 mm."""
    goals = [[-0.00015, 0.00599, 0.02796], [-0.00099, 0.00231, 0.01196]]
    for restarts, least, most in ((0, 2e-3, 2e-2), (4, 0.0, 1e-3)):
        env = registry.make("ConcentricTubeRobot", num_worlds=8, seed=3, goals="list", goal_list=goals)
        data, policy = env.reset(), InversePolicy(env, restarts=restarts)
        for _ in range(env.max_episode_steps):
            data = env.step(policy(data))["next"]
        distance = env.measure_distance()
        assert len(env.goal.unique(dim=0)) == 2
        assert (distance > least).all() and (distance < most).all()
