"""Training: rollouts, PPO, checkpoints, logs and evaluation. Each file is one of them."""
