"""SHAC beside PPO: evaluations over wall clock and samples, to a JSON."""
import json, sys, time
from pathlib import Path
import torch
import softwarp as sw
from softwarp.policies.policy import NetworkConfig
from softwarp.training.algorithms import make_algorithm
from softwarp.training.evaluation import run_episodes
from softwarp.training.options import PPOConfig, SHACConfig

out, device, budget, worlds, seeds = Path(sys.argv[1]), sys.argv[2], float(sys.argv[3]), int(sys.argv[4]), int(sys.argv[5])
rows = []
def cfg(kind, task):
    gamma = 0.97
    if kind == "ppo":
        return PPOConfig(horizon=25, gamma=gamma)
    return SHACConfig(horizon=16, gamma=gamma)
def sync():
    if device != "cpu": torch.cuda.synchronize()
for task, mesh in (("Diamond", "coarse"), ("Trunk", "coarse")):
    judge = sw.make(task, num_worlds=min(worlds, 64), device=device, seed=1000003, goal_split="eval", mesh=mesh)
    for kind in ("shac", "ppo"):
        for seed in range(seeds):
            torch.manual_seed(seed)
            env = sw.make(task, num_worlds=worlds, device=device, seed=seed, mesh=mesh)
            begun = time.monotonic()
            a = make_algorithm(env, NetworkConfig(), cfg(kind, task))
            a.update(0.0); sync()   # kernels, captures
            setup, spent, told = time.monotonic() - begun, 0.0, []
            next_at = 0.0
            while spent < budget:
                t0 = time.monotonic(); m = a.update(min(spent / budget, 1.0)); sync(); spent += time.monotonic() - t0
                if spent >= next_at or spent >= budget:
                    s = run_episodes(judge, a.policy, seed=5).summary()
                    told.append([round(spent, 2), a.rollout.steps, round(s["return"], 2), round(s["success"], 3), round(1e3 * s.get("distance", 0), 2)])
                    next_at = spent + budget / 6
            rows.append({"task": task, "mesh": mesh, "algo": kind, "seed": seed, "setup": round(setup, 1), "steps": a.rollout.steps, "seconds": round(spent, 2),
                         "columns": ["seconds", "steps", "return", "success", "distance_mm"], "evaluations": told, "last": {k: round(float(v), 4) for k, v in m.items()}, "failures": int(a.rollout.failures)})
            print(rows[-1], flush=True)
            out.write_text(json.dumps(rows, indent=1))
            del a, env
