"""Presets say what they claim: the paper's options, networks and budgets, and every pair of task and algorithm."""

import pytest

from experiments.baselines import ALGORITHMS, TASKS, cells
from experiments.config import TrainConfig, compose, make_env_config
from softwarp.envs import registry

BUDGETS = {"cartstem": 320_000, "cartstemcontact": 360_000, "catchtheobject": 120_000}  # environment steps per seed
UPDATES = {"cartstem": 200, "cartstemcontact": 600, "catchtheobject": 200}
BATCHES = {"cartstem": 256, "cartstemcontact": 200, "catchtheobject": 256}


def preset(name, *overrides):
    """A preset; its environment is named too, which is the only one then that is looked up."""
    task = next(task for task in TASKS if name.partition("/")[2].partition("_")[0] == task)
    env = f"env={registry.spec(TASKS[task]).file_name}"
    return compose("train", TrainConfig, [f"experiment={name}", env, *overrides])


def pairs(tmp_path="."):
    return [(cell.task, cell.algorithm) for cell in cells(tmp_path, list(TASKS), ALGORITHMS, [0])]


@pytest.mark.parametrize(("task", "algorithm"), pairs())
def test_paper_presets_follow_the_paper(task, algorithm):
    """Appendix C: discount, rate, network, bias, batch sizes; the published script: budgets and updates."""
    config = preset(f"paper/{task}_{algorithm}")
    name, env_config = make_env_config(config.env)
    assert name == TASKS[task]
    assert env_config == registry.spec(name).config_class().paper()
    algo = config.algo
    assert (algo.name, algo.critic_bias) == (algorithm[:3], 0.0 if "avec" in algorithm else 1.0)
    assert (algo.gamma, algo.learning_rate, algo.schedule) == (0.99, 1e-4, "constant")
    assert (config.network.hidden, config.network.activation) == ([512, 512, 512], "tanh")
    assert config.total_steps == BUDGETS[task]
    assert (config.evaluation_episodes, config.evaluation_deterministic) == (5, False)
    if algo.name == "ppo":
        per_update = algo.horizon * config.num_worlds
        assert per_update == 20 * env_config.max_episode_steps == BUDGETS[task] // UPDATES[task]
        assert per_update / algo.minibatches == pytest.approx(BATCHES[task], rel=0.2)
    else:
        assert algo.batch == BATCHES[task]
        assert algo.update_ratio == 1.0


@pytest.mark.parametrize(
    ("task", "algorithm"),
    [pytest.param(*pair, marks=pytest.mark.slow if pair[0] != "cartstem" else ()) for pair in pairs()],
)
def test_fast_presets_differ_in_nothing_but_avec(task, algorithm):
    """For each pair there is a fast preset; AVEC is compared with its base algorithm under equal settings."""
    base = algorithm.removesuffix("_avec")
    config, other = preset(f"fast/{task}_{base}", f"algo={algorithm}"), preset(f"fast/{task}_{base}")
    assert config.algo.critic_bias == (0.0 if "avec" in algorithm else 1.0)
    config.algo.critic_bias = other.algo.critic_bias = 1.0
    assert config == other


@pytest.mark.parametrize("task", TASKS)
def test_the_recommended_preset_is_one_of_them(task):
    """``fast/<task>`` names the algorithm that solves it."""
    assert preset(f"fast/{task}") in [
        preset(f"fast/{task}_{name}") for name in ("ppo", "sac") if (task, name) in pairs()
    ]
