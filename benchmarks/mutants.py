"""Small wrong changes that tests must notice, for ``softwarp bench mutations``.

Each is a place where one letter decides what a user gets and nothing else would tell: a sign, a factor, a seed, an
option that stops where it should be passed on. Add one when a defect was found that no test had seen.
tests/contract/test_mutations.py keeps every ``old`` in its file.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Mutant:
    """One change.

    Attributes:
        name: What goes wrong.
        file: Path in the repository.
        old: Text that stands in it exactly once.
        new: Text in its place.
        tests: Files or tests, as pytest takes them, of which one has to fail.
    """

    name: str
    file: str
    old: str
    new: str
    tests: tuple[str, ...]


PPO, SAC, AVEC = (f"tests/unit/training/test_{name}.py" for name in ("ppo", "sac", "avec"))
PPO_LOSSES = (f"{PPO}::test_losses_by_hand", f"{PPO}::test_gradient_of_a_step_by_hand")
ADVANTAGES = (f"{PPO}::test_advantages_follow_the_recursion",)
TARGETS = tuple(f"{SAC}::test_soft_bellman_target_by_hand_for_{kind}" for kind in ("choices", "continuous_actions"))
SLOW_COPIES = (f"{SAC}::test_slow_copies_go_a_share_of_the_way",)
PRIORITIES = (f"{SAC}::test_priorities_weigh_the_errors", f"{SAC}::test_priority_weights_reach_the_loss")
EVALUATION, REPLAY = (f"tests/unit/training/test_{name}.py" for name in ("evaluation", "replay"))
HELD_OUT = "tests/unit/experiments/test_held_out.py"
ENVS = "tests/unit/envs/test_base.py"
SEQUENCES = "tests/unit/planning/test_sequences.py"
JOINTS, RIGID = "tests/physics/test_joints.py", "tests/physics/test_contact_rigid.py"

LEARNING = (
    Mutant(
        "training is evaluated on the goals it trains on",
        "experiments/train.py",
        'options["goal_split"] = "eval"',
        'options["goal_split"] = "train"',
        (HELD_OUT,),
    ),
    Mutant(
        "untrained policies are judged on the goals of training",
        "experiments/eval.py",
        'options["goal_split"] = "eval"',
        'options["goal_split"] = "train"',
        (HELD_OUT,),
    ),
    Mutant(
        "policies are judged by the draws that chose them",
        "experiments/verbs.py",
        "seed: Seed = 2_000_003  # of the goals; differs",
        "seed: Seed = 1_000_003  # of the goals; differs",
        (HELD_OUT,),
    ),
    Mutant(
        "eval forgets the seed that it was given",
        "experiments/eval.py",
        "seed=settings.seed, episodes=settings.episodes",
        "seed=config.evaluation_seed, episodes=settings.episodes",
        (HELD_OUT,),
    ),
    Mutant(
        "rewards after an episode's end count",
        "softwarp/training/evaluation.py",
        'after["reward"].squeeze(-1) * active',
        'after["reward"].squeeze(-1)',
        (EVALUATION,),
    ),
    Mutant(
        "failures after an episode's end count",
        "softwarp/training/evaluation.py",
        "failed |= active & done &",
        "failed |= done &",
        (EVALUATION,),
    ),
    Mutant("PPO clips by a width of its own", "softwarp/training/ppo.py", "=config.clip,", "=0.2,", PPO_LOSSES),
    Mutant(
        "PPO lowers the entropy",
        "softwarp/training/ppo.py",
        'result["loss_objective"] + result["loss_entropy"]',
        'result["loss_objective"] - result["loss_entropy"]',
        PPO_LOSSES,
    ),
    Mutant(
        "PPO's advantages keep their scale",
        "softwarp/training/ppo.py",
        "(advantage - mean) / spread.clamp_min(1e-6)",
        "advantage - mean",
        ADVANTAGES,
    ),
    Mutant(
        "GAE forgets lambda",
        "softwarp/training/ppo.py",
        "lmbda=config.gae_lambda",
        "lmbda=0.95",
        ADVANTAGES,
    ),
    Mutant(
        "SAC discounts by a factor of its own",
        "softwarp/training/sac.py",
        "make_value_estimator(gamma=config.gamma)",
        "make_value_estimator(gamma=0.99)",
        TARGETS,
    ),
    Mutant(
        "SAC's choices are asked to be as random as can be",
        "softwarp/training/sac.py",
        "entropy = 0.3 * math.log(",
        "entropy = 0.98 * math.log(",
        (f"{SAC}::test_target_entropy",),
    ),
    Mutant(
        "SAC's slow copies move at a rate of their own",
        "softwarp/training/sac.py",
        "SoftUpdate(self.loss, tau=config.tau)",
        "SoftUpdate(self.loss, tau=0.005)",
        SLOW_COPIES,
    ),
    Mutant(
        "SAC's slow copies stand still",
        "softwarp/training/sac.py",
        "        self.slow_copy.step()\n",
        "",
        SLOW_COPIES,
    ),
    Mutant(
        "priorities do not weigh squared errors",
        "softwarp/training/sac.py",
        "error.square() if weight is None else weight * error.square()",
        "error.square()",
        PRIORITIES,
    ),
    Mutant(
        "priorities do not weigh AVEC's mean error",
        "softwarp/training/sac.py",
        "loss.critic_bias, weight, loss.ranks.mean)",
        "loss.critic_bias, None, loss.ranks.mean)",
        PRIORITIES,
    ),
    Mutant(
        "AVEC takes the mean error away twice",
        "softwarp/training/algorithm.py",
        "target + (1.0 - bias) * mean",
        "target + 2.0 * (1.0 - bias) * mean",
        (AVEC,),
    ),
    Mutant(
        "replayed weights have the sign of the priorities",
        "softwarp/training/replay.py",
        ".pow(-BETA)",
        ".pow(BETA)",
        (REPLAY,),
    ),
    Mutant(
        "returns of an episode go on in the next",
        "softwarp/training/rollout.py",
        "(self.step_count, self.running_return, self.discounted)",
        "(self.step_count, self.discounted)",
        ("tests/unit/training/test_rollout.py",),
    ),
    Mutant(
        "the scale of rewards knows no ends of episodes",
        "softwarp/training/rollout.py",
        "(self.step_count, self.running_return, self.discounted)",
        "(self.step_count, self.running_return)",
        ("tests/unit/training/test_rollout.py",),
    ),
    Mutant(
        "stray actions are the numbers that chose them",
        "softwarp/training/demonstrations.py",
        "random(Spaces.of(env), seed + 1)",
        "random(Spaces.of(env), seed)",
        ("tests/unit/training/test_cloning.py::test_stray_actions_are_drawn_apart_from_when_they_are_taken",),
    ),
    Mutant(
        "SAC's gradients are as long as they are",
        "softwarp/training/sac.py",
        "nn.utils.clip_grad_norm_(self.trained, config.max_grad_norm)",
        "nn.utils.clip_grad_norm_(self.trained, 1e9)",
        (f"{SAC}::test_long_gradients_are_cut_and_a_fixed_temperature_stays",),
    ),
    Mutant(
        "the last policy passes for the best",
        "softwarp/training/loop.py",
        "if score(summary) > counters.best_score:",
        "if True:",
        ("tests/unit/training/test_loop.py::test_best_policy_is_that_of_the_best_evaluation",),
    ),
    Mutant(
        "a clone is the last fit instead of the best",
        "softwarp/training/cloning.py",
        "    learner.load_state_dict(best)\n",
        "",
        ("tests/unit/training/test_cloning.py::test_clone_is_the_best_fit_of_what_it_did_not_learn",),
    ),
    Mutant(
        "held-out episodes set the scale of observations",
        "softwarp/training/cloning.py",
        "update(observation[~is_held_out])",
        "update(observation)",
        ("tests/unit/training/test_cloning.py::test_clone_is_the_best_fit_of_what_it_did_not_learn",),
    ),
    Mutant(
        "filled-up steps of shorter episodes are cloned as well",
        "softwarp/training/cloning.py",
        "_loss(policy, features[counts], sample[counts])",
        "_loss(policy, features, sample)",
        ("tests/unit/training/test_cloning.py::test_episodes_of_different_length_are_fitted_as_they_are_lived",),
    ),
    Mutant(
        "the critic's warm-up moves what the actor shares with it",
        "softwarp/training/ppo.py",
        "            features = features.detach()\n",
        "            features = features * 1.0\n",
        ("tests/unit/training/test_cloning.py::test_what_actor_and_critic_have_in_common_stands_still_in_the_warm_up",),
    ),
    Mutant(
        "a resumed run loses the checkpoint it came from",
        "softwarp/training/checkpoints.py",
        'removeprefix("step_")) > step',
        'removeprefix("step_")) >= step',
        ("tests/contract/test_resume.py::test_later_checkpoints_go_when_an_earlier_one_is_resumed",),
    ),
    Mutant(
        "later batches of an evaluation repeat the first",
        "softwarp/training/evaluation.py",
        "range(_RESETS * batch)",
        "range(0)",
        (EVALUATION,),
    ),
    Mutant(
        "trained policies are evaluated with their noise",
        "softwarp/training/evaluation.py",
        "ExplorationType.DETERMINISTIC if deterministic",
        "ExplorationType.RANDOM if deterministic",
        (EVALUATION,),
    ),
)

ENVIRONMENTS = (
    Mutant(
        "the trunk's stiffness and damping are the same numbers",
        "softwarp/envs/tasks/trunk.py",
        "_STREAM_YOUNGS, _STREAM_DAMPING, _STREAM_GRAVITY = range(1, 4)",
        "_STREAM_YOUNGS, _STREAM_DAMPING, _STREAM_GRAVITY = 1, 1, 3",
        ("tests/contract/test_envs.py::test_every_draw_has_a_stream_of_its_own",),
    ),
    Mutant(
        "the trunk's gravity and goals are the same numbers",
        "softwarp/envs/tasks/trunk.py",
        "_STREAM_YOUNGS, _STREAM_DAMPING, _STREAM_GRAVITY = range(1, 4)",
        "_STREAM_YOUNGS, _STREAM_DAMPING, _STREAM_GRAVITY = 1, 2, 0",
        ("tests/contract/test_envs.py::test_every_draw_has_a_stream_of_its_own",),
    ),
    Mutant(
        "the generator mixes a round less",
        "softwarp/kernels/algebra/philox.py",
        "_ROUNDS = 10",
        "_ROUNDS = 9",
        ("tests/unit/envs/test_randomization.py",),
    ),
    Mutant(
        "episodes of a world draw alike",
        "softwarp/envs/base.py",
        "        self._episode.add_(mask)\n",
        "",
        (ENVS,),
    ),
    Mutant(
        "a failed world is rewarded",
        "softwarp/envs/base.py",
        "= -self.config.failure_penalty",
        "= self.config.failure_penalty",
        (ENVS,),
    ),
    Mutant(
        "episodes last a step too long",
        "softwarp/envs/base.py",
        "truncated = (self.step_count >= self.max_episode_steps)[:, None]",
        "truncated = (self.step_count > self.max_episode_steps)[:, None]",
        (ENVS,),
    ),
    Mutant(
        "progress is rewarded for going away",
        "softwarp/envs/rewards.py",
        "    return (previous - distance) / scale",
        "    return (distance - previous) / scale",
        ("tests/unit/envs/test_rewards.py",),
    ),
    Mutant(
        "unseen goals hold those of training",
        "softwarp/envs/tasks/cable_reach.py",
        '"eval": rows[cut:]',
        '"eval": rows',
        (
            "tests/contract/test_env_trunk.py",
            "tests/unit/envs/tasks/test_diamond.py",
        ),
    ),
    Mutant(
        "worlds of a vector environment start alike",
        "softwarp/gym.py",
        '[checks.seed(seed, "reset: seed") + i for i in range(self.num_envs)]',
        '[checks.seed(seed, "reset: seed") for i in range(self.num_envs)]',
        ("tests/contract/test_env_gym.py",),
    ),
)

STEPS = (
    Mutant(
        "bounce_speed does not reach the solver",
        "softwarp/simulation.py",
        "bounce_speed=bounce_speed,",
        "bounce_speed=0.01,",
        (RIGID,),
    ),
    Mutant(
        "recovery_speed does not reach the solver",
        "softwarp/simulation.py",
        "recovery_speed=recovery_speed,",
        "recovery_speed=0.5,",
        ("tests/unit/scene/test_contact.py", JOINTS),
    ),
    Mutant(
        "joints recover at a speed of their own",
        "softwarp/solvers/terms/joints.py",
        "s.options.recovery_speed",
        "0.5",
        (JOINTS,),
    ),
    Mutant(
        "recovery_time does not reach the solver",
        "softwarp/simulation.py",
        "recovery_time=recovery_time,",
        "recovery_time=0.02,",
        ("tests/unit/test_simulation.py::test_every_option_reaches_the_solver",),
    ),
    Mutant(
        "three worlds are put into lanes",
        "softwarp/solvers/partition.py",
        "LANES_FROM = 4 ",
        "LANES_FROM = 3 ",
        ("tests/unit/solvers/test_partition.py",),
    ),
    Mutant(
        "restitution ignores how fast a body came",
        "softwarp/kernels/rows/contact.py",
        "x_scale * (restitution * before + slip[0])",
        "x_scale * slip[0]",
        (RIGID + "::test_restitution",),
    ),
    Mutant(
        "a cable's rate limit is taken per second",
        "softwarp/kernels/rows/cable.py",
        "max_rate_in[w, cable] * h",
        "max_rate_in[w, cable]",
        ("tests/physics/test_cables.py",),
    ),
    Mutant(
        "joints are kept within one limit only",
        "softwarp/kernels/rows/joint.py",
        "ceiling = wp.min(wp.max((high - q) * scale, -recovery * h), ceiling) - target",
        "ceiling = ceiling - target",
        (JOINTS,),
    ),
    Mutant(
        "stiffness damps by half",
        "softwarp/kernels/elements/assembly.py",
        "body_stiffness_scale_out[w, body] = (S(h) + beta) * h",
        "body_stiffness_scale_out[w, body] = (S(h) + beta * real(0.5)) * h",
        ("tests/physics/test_vibration.py", "tests/physics/test_dynamics.py"),
    ),
    Mutant(
        "neo-Hookean stress has half its pressure",
        "softwarp/kernels/elements/materials.py",
        "return mu, (lam * wp.log(J) - mu) / J, type(mu)(0.0)",
        "return mu, (type(mu)(0.5) * lam * wp.log(J) - mu) / J, type(mu)(0.0)",
        ("tests/physics/test_elements.py",),
    ),
    Mutant(
        "rods shear as softly as they bend",
        "softwarp/kernels/elements/rod.py",
        "shear = div(e, nu * real(2.0) + S(real(2.0)))",
        "shear = div(e, nu + S(real(2.0)))",
        ("tests/unit/kernels/test_rod.py",),
    ),
    Mutant(
        "chambers push with half their pressure",
        "softwarp/kernels/rows/cavity.py",
        "sixth = real(1.0) / real(6.0)\n        point_gradient_out",
        "sixth = real(0.5) / real(6.0)\n        point_gradient_out",
        ("tests/unit/kernels/test_cavity.py",),
    ),
)

FILES_AND_PLANS = (
    Mutant(
        "a film that starts late begins in the middle",
        "softwarp/io/usd.py",
        "exact = (time - time[0]) * fps",
        "exact = time * fps",
        ("tests/unit/io/test_usd.py",),
    ),
    Mutant(
        "optimistic planning overlooks deep leaves",
        "softwarp/planning/opd.py",
        "gamma ** tree.depth[node] / (1.0 - gamma)",
        "gamma ** tree.depth[node]",
        ("tests/unit/planning/test_opd.py",),
    ),
    Mutant(
        "CEM's noise grows along a sequence",
        "softwarp/planning/cem.py",
        "np.sqrt(1.0 - persistence**2)",
        "1.0",
        (SEQUENCES,),
    ),
    Mutant(
        "MPPI forgets to run its mean",
        "softwarp/planning/mppi.py",
        "        noise[0] = 0.0\n",
        "",
        (SEQUENCES,),
    ),
    Mutant(
        "CEM forgets what it knew",
        "softwarp/planning/cem.py",
        "stay * self._mean + (1.0 - stay) * elites.mean(axis=0)",
        "elites.mean(axis=0)",
        (SEQUENCES,),
    ),
    Mutant(
        "UCT explores without a root",
        "softwarp/planning/uct.py",
        "math.sqrt(log_visits / visits)",
        "log_visits / visits",
        ("tests/unit/planning/test_uct.py",),
    ),
    Mutant(
        "plans are rewarded for failing",
        "softwarp/planning/objective.py",
        "masked_fill(failed, 0.0)",
        "masked_fill(failed, 1.0)",
        ("tests/unit/planning/test_env_model.py",),
    ),
    Mutant(
        "held actions are worth their sum",
        "softwarp/planning/env_model.py",
        "        held.rewards /= lasts\n",
        "",
        ("tests/unit/planning/test_env_model.py",),
    ),
    Mutant(
        "films run on the clock of the simulation",
        "softwarp/io/trajectory.py",
        "tick = self.time[0] + np.arange",
        "tick = np.arange",
        ("tests/unit/io/test_trajectory.py::test_frames_at_picks_the_nearest",),
    ),
)

MUTANTS: tuple[Mutant, ...] = (*LEARNING, *ENVIRONMENTS, *STEPS, *FILES_AND_PLANS)
