"""What hooks of a task may answer: each wrong answer is told by hook and class, at construction or the first call.

The tasks here walk a point about a plane (fake.py). Those whose first call is to be refused are right in all else.
"""

import warnings

import pytest
import torch
from tensordict import TensorDict

from softwarp.envs import SoftEnv, registry
from softwarp.envs.answers import Answers, check_class
from tests.unit.envs.fake import PointConfig, PointEnv

N = 4


def changed(**hooks):
    """A task with other hooks, by the name Odd."""
    return type("Odd", (PointEnv,), hooks)


def act(env, action=(0.5, 0.5)):
    actions = torch.tensor(action).expand(N, 2).clone()
    return env.step(TensorDict({"action": actions}, batch_size=[N]))["next"]


def begin(task, **options):
    env = task(PointConfig(settle=False, **options), num_worlds=N, seed=0)
    env.reset()
    return env


ones, zeros = torch.ones(N), torch.zeros(N)
WRONG = {
    "neither kind of action": ({"action_size": property(lambda self: 0)}, "continuous or discrete.*action_size 0"),
    "both kinds": ({"action_count": property(lambda self: 3)}, "got action_size 2 and action_count 3"),
    "no number": ({"action_size": property(lambda self: 2.0)}, r"Odd.action_size must be an integer.*got 2\.0"),
    "negative": ({"action_size": property(lambda self: -2)}, "Odd.action_size must be an integer of at least 0"),
    "no bounds": ({"observation_bounds": lambda self: {}}, "observation_bounds must return a dictionary"),
    "one bound": ({"observation_bounds": lambda self: {"observation": ones}}, "a pair of tensors"),
    "taken key": ({"observation_bounds": lambda self: {"reward": (-ones, ones)}}, "names of its own, got 'reward'"),
    "infinite": ({"observation_bounds": lambda self: {"observation": (-ones, ones / 0.0)}}, "must be finite"),
    "crossed": ({"observation_bounds": lambda self: {"observation": (ones, -ones)}}, "below its upper bound"),
    "double bounds": ({"observation_bounds": lambda self: {"observation": (-ones.double(), ones)}}, "two float32"),
    "batched bounds": ({"observation_bounds": lambda self: {"observation": (-ones[None], ones[None])}}, "one shape"),
    "mask": ({"action_mask": lambda self: ones > 0}, "action_mask must be None, as actions are continuous"),
    "no dictionary": ({"observe": lambda self: self.sim.x}, r"observe must return a dictionary.*\['observation'\]"),
    "other key": (
        {"observe": lambda self: {"obs": self.sim.x}},
        "keys of observation_bounds, 'observation', got 'obs'",
    ),
    "fewer": ({"observe": lambda self: {"observation": self.sim.x}}, r"shape \(4, 4\), got torch.float32 \(4, 2\)"),
    "double": ({"observe": lambda self: {"observation": torch.zeros(N, 4).double()}}, r"float32, got.*\.to\(torch"),
    "elsewhere": (
        {"observe": lambda self: {"observation": torch.zeros(N, 4, device="meta")}},
        "must be on cpu, got.*meta",
    ),
    "column": ({"measure_distance": lambda self: zeros[:, None]}, r"measure_distance must have shape \(4,\).*\(4, 1\)"),
    "float": ({"measure_distance": lambda self: 0.0}, "measure_distance must be a tensor.*got 0.0"),
    "no flags": ({"is_success": lambda self, distance: distance}, r"is_success must be torch.bool.*\.to\(torch.bool\)"),
    "nothing": ({"is_terminated": lambda self, distance: None}, "is_terminated must be a tensor.*got None"),
    "one reward": ({"reward_terms": lambda self, action, distance: distance}, "reward_terms must return a dictionary"),
    "sum": (
        {"reward_terms": lambda self, action, distance: {"near": distance.sum()}},
        r"'near' must have shape \(4,\)",
    ),
    "own": (
        {"reward_terms": lambda self, action, distance: {"failure": zeros}},
        "'failure' is a term of the base class",
    ),
    "double reward": (
        {"reward_terms": lambda self, action, distance: {"near": zeros.double()}},
        "must be torch.float32",
    ),
    "everywhere": (
        {"reward_terms": lambda self, action, distance: {"near": distance / 0.0 * 0.0, "far": zeros}},
        "reward_terms: 'near' must be finite, got nan or infinity in each of 4 worlds at the first step",
    ),
    "lost goal": (
        {"measure_distance": lambda self: zeros / 0.0},
        "measure_distance must be finite.*at the first reset",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_answers_are_refused_by_name(case):
    """At construction, reset or the first step; and again by whoever goes on."""
    hooks, message = WRONG[case]
    with pytest.raises(ValueError, match=message) as told:
        act(begin(changed(**hooks)))
    assert str(told.value).startswith("Odd")


def test_a_refused_answer_is_refused_again():
    env = begin(changed(reward_terms=lambda self, action, distance: {"near": distance * self.by}, by=1.0))
    env.by = torch.nan
    for _ in range(2):
        with pytest.raises(ValueError, match="'near' must be finite"):
            act(env)


def test_names_of_reward_terms_stay():
    def reward_terms(self, action, distance):
        return {"near": distance} if self.step_count[0] == 0 else {"near": distance, "late": distance}

    with pytest.raises(ValueError, match="gave 'near' first, then 'near', 'late'; return the same names always"):
        act(begin(changed(reward_terms=reward_terms)))


def test_flags_and_counts_add_up_as_rewards():
    def reward_terms(self, action, distance):
        return {"here": distance < 100.0, "twice": torch.full_like(distance, 2, dtype=torch.int64)}

    data = act(begin(changed(reward_terms=reward_terms)))
    assert data["reward"].dtype == torch.float32 and data["reward"].flatten().tolist() == [3.0] * N


def test_lacking_and_misspelt_hooks_are_told():
    lacking = {name: value for name, value in vars(PointEnv).items() if name != "observe" and not name.startswith("_")}
    with pytest.raises(ValueError, match=r"Lacks lacks the hook observe; observe: did you mean 'observed'\?"):
        type("Lacks", (SoftEnv,), lacking | {"observed": PointEnv.observe})(PointConfig(), num_worlds=1)
    with pytest.raises(ValueError, match=r"Odd.is_sucess is called by nobody; did you mean 'is_success'\?"):
        bare = {name: value for name, value in lacking.items() if name != "is_success"}
        type("Odd", (SoftEnv,), bare | {"observe": PointEnv.observe, "is_sucess": PointEnv.is_success})(PointConfig())

    class Helped(PointEnv):
        def goal_point(self):
            return self.goal

        def observe(self):
            return {"observation": torch.cat((self.sim.x, self.goal_point()), dim=1)}

        def _cameras(self):
            return None

    assert act(begin(Helped))["reward"].shape == (N, 1), "helpers that are called, or begin with an underscore"


@pytest.mark.parametrize("name", registry.ENVIRONMENTS)
def test_our_own_tasks_have_no_misspelt_hooks(name):
    check_class(registry.spec(name).env_class(), SoftEnv)


@pytest.mark.parametrize("part", ["reward", "observation", "distance"])
def test_what_is_not_finite_in_some_worlds_is_told_and_kept_away(part):
    """Worlds 1 and 3 alone end as failed; hook, key, count and worlds are told at once, and at ten times as much."""
    spoilt = torch.tensor([0.0, torch.nan, 0.0, torch.nan])

    class Odd(PointEnv):
        is_odd = False

        def by(self, name):
            return spoilt if self.is_odd and name == part else torch.zeros(N)

        def reward_terms(self, action, distance):
            terms = super().reward_terms(action, torch.zeros(N))
            return terms | {"progress": terms["progress"] + self.by("reward")}

        def observe(self):
            return {"observation": super().observe()["observation"] + self.by("observation")[:, None]}

        def measure_distance(self):
            return super().measure_distance() + self.by("distance")

    env, healthy = begin(Odd), begin(Odd)
    env.is_odd = True
    where = {
        "reward": "reward_terms: 'progress'",
        "observation": "observe: 'observation'",
        "distance": "measure_distance",
    }
    with pytest.warns(UserWarning, match=rf"Odd.{where[part]} was not finite in 2 steps so far \(world 1, 3\)"):
        data, good = act(env), act(healthy)
    for key in ("observation", "reward", "terminated", "distance"):
        assert torch.isfinite(data[key]).all() and torch.equal(data[key][::2], good[key][::2]), key
    assert data["terminated"][1::2].all() and (data["reward"][1::2] == -env.config.failure_penalty).all()
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        for _ in range(8):
            act(env)
    assert not told, "18 by now"
    with pytest.warns(UserWarning, match="in 20 steps so far"):
        act(env)


def test_worlds_that_the_simulator_gave_up_are_no_hooks_fault():
    env = begin(
        changed(
            observe=lambda self: {"observation": torch.cat((self.sim.x / (self.sim.status < 3)[:, None], self.goal), 1)}
        )
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        data = act(env, (200.0, 0.0))
    assert (data["world_status"] == 3).all()


def test_captured_stages_tell_when_they_are_asked():
    """Nothing is read back before ``hear``; the first look refuses what is finite nowhere, later ones warn."""
    env = begin(PointEnv)
    answers, status = Answers(env, N, torch.device("cpu")), torch.zeros(N, dtype=torch.int32)
    nowhere = {"near": torch.full((N,), torch.nan)}
    some = {"near": torch.tensor([1.0, torch.inf, 1.0, 1.0])}
    seen = {"observation": torch.zeros(N, 4)}
    good = answers.screen("step", status, zeros, nowhere, seen, at_once=False)
    assert not good.any()
    answers.hear_news(env.sim)  # of steps that were not captured
    with pytest.raises(ValueError, match="'near' must be finite"):
        answers.hear(env.sim)
    assert answers.screen("step", status, zeros, some, seen, at_once=False).tolist() == [True, False, True, True]
    with pytest.warns(UserWarning, match=r"'near' was not finite in 1 step so far \(world 1\)"):
        answers.hear(env.sim)
    answers.screen("step", status, zeros, nowhere, seen, at_once=False)
    answers.screen("step", status + 3, zeros, nowhere, seen, at_once=False)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        answers.hear(env.sim)  # 5 by now
    for _ in range(2):
        answers.screen("step", status, zeros, nowhere, seen, at_once=False)
    with pytest.warns(UserWarning, match=r"in 13 steps so far \(world 0, 1, 2, 3\)"):
        answers.hear(env.sim)


def test_a_reset_that_touches_other_worlds_is_refused():
    def reset_worlds(self, mask):
        self.goal.add_(1.0)

    env = begin(changed(reset_worlds=reset_worlds))
    with pytest.raises(ValueError, match=r"world state 'goal' changed in others \(world 1, 3\).*torch.where\(mask"):
        env.reset_where(torch.tensor([True, False, True, False]))
