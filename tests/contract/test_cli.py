"""The command as a user types it: exit codes, messages without tracebacks, and one short run through all verbs."""

import functools
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from experiments import demo, render
from softwarp import cli
from softwarp.training.checkpoints import hold
from tests import forked

ROOT = Path(__file__).parents[2]


def softwarp(*arguments, cwd, check=None, fresh=False, **environment):
    """Run the command from source in another folder; returns the finished process, a forked one unless fresh."""
    own = fresh or environment
    done = typed(arguments, cwd, environment) if own else forked.run(["-m", "softwarp", *arguments], cwd)
    assert "Traceback" not in done.stderr, done.stderr
    if check is not None:
        assert done.returncode == check, done.stderr
    return done


def typed(arguments, cwd, environment):
    """The finished process of an interpreter of its own."""
    return subprocess.run(
        [sys.executable, "-m", "softwarp", *map(str, arguments)],
        cwd=cwd,
        env=os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"} | environment,
        capture_output=True,
        text=True,
        check=False,
    )


def message(done):
    """The last line written to standard error."""
    return done.stderr.strip().splitlines()[-1]


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["trian"], "softwarp there is no 'trian'; did you mean train or transfer?"),
        (["train", "env=trnk"], "softwarp train: env: there is no 'trnk'; did you mean 'trunk'"),
        (["train", "device=cuda:7"], "softwarp train: device 'cuda:7' is not available; this machine has cpu"),
        (
            ["train", "experiment=fast/cartstemcontact", "algo=ppo"],
            "experiment=fast/cartstemcontact algo=ppo: these do not go together (Key 'batch' not in 'PPOConfig'",
        ),
        (["train", "seed=-1"], "seed must be an integer of at least 0, got -1"),
        (["train", "seed=9223372036854775808"], "seed must be an integer of at least 0"),
        (["train", "out="], "softwarp train: out must be the path of a file or folder, got ''"),
        (["render", "nowhere", "out="], "softwarp render: out=: render writes files with one of the endings"),
        (["record", "out=", "env=cart_stem"], "softwarp record: out=: demonstrations need the ending .npz"),
        (
            ["render", "foreign.pt", "film.mp4", "width=1000000000"],
            "render: width must be an integer of at least 1 and",
        ),
        (["train", "num_worlds=0"], "softwarp train: num_worlds must be an integer of at least 1, got 0"),
        (["train", "--resume", "nowhere"], "softwarp train: run nowhere: no such folder or checkpoint"),
        (["demo", "foo=bar"], "softwarp demo: setting 'foo=bar': there is no 'foo'"),
        (["demo", "env=Nope", "device=cpu"], "softwarp demo: env: there is no 'Nope'"),
        (["eval", "nowhere"], "softwarp eval: run nowhere: no such folder or checkpoint"),
        (["eval", "env=cart_stm", "policy=scripted"], "there is no 'cart_stm'; did you mean"),
        (["eval", "foreign.pt", "episode=3"], "there is no 'episode'; did you mean 'episodes'?"),
        (["eval", "foreign.pt"], "softwarp eval: checkpoint foreign.pt: cut short or not a checkpoint"),
        (
            ["render", "nowhere", "film.avi"],
            "softwarp render: out=film.avi: render writes files with one of the endings",
        ),
        (
            ["export", "nowhere", "scene.fbx"],
            "softwarp export: out=scene.fbx: export writes files with one of the endings",
        ),
    ],
)
def test_bad_input_is_told_in_a_line(tmp_path, monkeypatch, capsys, arguments, told):
    """Exit code 2 and a message that names the thing and the remedy; no run folder is left behind."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "foreign.pt").write_text("not a checkpoint")
    assert cli.main(arguments) == 2
    assert told in capsys.readouterr().err.splitlines()[-1]
    assert [path.name for path in tmp_path.iterdir()] == ["foreign.pt"]


@pytest.mark.parametrize("verb", ["paper", "baselines", "sweep"])
def test_a_setting_is_no_folder(tmp_path, monkeypatch, capsys, verb):
    """One in the folder's place is told at once, instead of hours of work in a folder of that name."""
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as ended:
        cli.main([verb, "env=trunk"])
    assert ended.value.code == 2
    told = f"softwarp {verb}: error: argument folder: 'env=trunk' is no folder; name one that everything goes to first"
    assert told in capsys.readouterr().err.splitlines()[-1]
    assert not list(tmp_path.iterdir())


def test_what_cannot_be_written_is_told_in_a_line(capsys):
    """Exit code 1: the command was right, its place was not."""
    assert cli.main(["train", "out=/proc/run"]) == 1
    told = "train: cannot write /proc/run/run.json: No such file or directory; choose"
    assert told in capsys.readouterr().err.splitlines()[-1]


def test_running_the_module_is_running_the_command(tmp_path):
    """``python -m softwarp`` passes arguments on and exits with the verb's code."""
    done = softwarp("trian", cwd=tmp_path, check=2, fresh=True)
    assert message(done) == "softwarp there is no 'trian'; did you mean train or transfer?"


def test_help_and_lists(tmp_path):
    """The verbs are listed; each explains itself; list names what there is."""
    assert "train" in softwarp("--help", cwd=tmp_path, check=0).stdout
    assert "--resume" in softwarp("train", "--help", cwd=tmp_path, check=0).stdout
    listed = softwarp("list", cwd=tmp_path, check=0).stdout
    assert "env=trunk" in listed
    assert "algo=ppo" in listed
    assert "no runs in runs/ yet" in listed


def test_doctor(tmp_path):
    """All checks that matter pass here; a kernel cache that cannot be written is told and fails."""
    done = softwarp("doctor", cwd=tmp_path, check=0)
    assert "softwarp is ready" in done.stdout
    assert done.stdout.count("ok  ") == len([line for line in done.stdout.splitlines() if line[:4] in ("ok  ", "FAIL")])
    spoiled = "import os, sys; os.environ['WARP_CACHE_PATH'] = '/proc/warp'; from softwarp import cli; "
    done = forked.run(["-c", f"{spoiled}sys.exit(cli.main(['doctor']))"], tmp_path)
    assert done.returncode == 1 and "FAIL  warp cache" in done.stdout


def test_warm_of_an_unknown_environment(tmp_path):
    """The nearest name is told before anything is compiled."""
    done = softwarp("warm", "CartPool", cwd=tmp_path, check=2)
    assert "did you mean 'CartPole'" in message(done)
    done = softwarp("warm", "CartPole", "--jobs", "0", cwd=tmp_path, check=2)
    assert "--jobs must be at least 1, got 0" in message(done)


@pytest.mark.slow
def test_warm_fills_a_cache(tmp_path):
    """Kernels of one world and of lanes are kept, and another process finds all it needs there, named or Warp's own."""
    cache = tmp_path / "cache"
    softwarp("warm", "CartPole", "--cache", cache, "--jobs", "1", cwd=tmp_path, check=0)
    kept = sorted(path.name for path in cache.rglob("wp_softwarp*"))
    assert any("cholesky_wide.scalar_f32" in name for name in kept)
    assert any("cholesky_strips.lanes_f32" in name for name in kept)
    softwarp("warm", "CartPole", "--cache", cache, "--jobs", "1", cwd=tmp_path, check=0)
    softwarp("warm", "CartPole", "--jobs", "1", cwd=tmp_path, check=0, WARP_CACHE_PATH=str(cache))
    assert sorted(path.name for path in cache.rglob("wp_softwarp*")) == kept


def test_all_verbs_on_a_short_run(tmp_path, monkeypatch, capsys):
    """Train two updates, resume, evaluate with baselines, every file is there and tells the truth."""
    monkeypatch.chdir(tmp_path)

    def run_verb(*arguments):
        assert cli.main(arguments) == 0, capsys.readouterr().err
        return capsys.readouterr().out

    short = ["env.mesh=coarse", "env.max_episode_steps=4", "num_worlds=4", "algo.horizon=4", "evaluation_episodes=4"]
    run_verb("train", "env=trunk", "algo=ppo", *short, "total_steps=48", "out=runs/a")
    run = tmp_path / "runs" / "a"
    files = {".lock", "best.pt", "config.yaml", "curve.png", "evaluation.csv", "progress.csv", "run.json"}
    assert {path.name for path in run.iterdir()} == files | {"checkpoints", "tensorboard"}
    assert json.loads((run / "run.json").read_text())["device"]["name"] == "cpu"

    assert cli.main(["train", "out=runs/a"]) == 2
    assert "holds a run already" in capsys.readouterr().err
    run_verb("train", "--resume", "runs/a", "total_steps=80")
    assert "80 steps" in run_verb("list")

    first = min((run / "checkpoints").iterdir())
    (tmp_path / "stray.pt").write_bytes(first.read_bytes())
    assert cli.main(["train", "--resume", "stray.pt"]) == 2
    assert "stray.pt: lies in no run folder" in capsys.readouterr().err
    with hold(run):
        assert cli.main(["train", "--resume", "runs/a"]) == 2
    assert "softwarp train: run folder runs/a: another process trains there" in capsys.readouterr().err
    for later in sorted((run / "checkpoints").iterdir())[1:]:
        later.rename(tmp_path / later.name)
    assert "runs/a  0 steps" in run_verb("list")
    run_verb("train", "--resume", str(first), "total_steps=80")
    assert [row.split(",")[0] for row in (run / "progress.csv").read_text().splitlines()] == ["update", *"1234"]

    run_verb("eval", "runs/a", "episodes=5", "--baselines", "--json", "e.json")
    told = json.loads((tmp_path / "e.json").read_text())
    assert set(told["policies"]) == {"trained", "nothing", "random", "scripted"}
    assert {summary["episodes"] for summary in told["policies"].values()} == {5.0}
    again = json.loads(run_verb("eval", "runs/a/best.pt", "episodes=5", "--json"))
    assert again["policies"]["trained"] == told["policies"]["trained"]  # test_commands renders and exports such a run


def test_demo(tmp_path, monkeypatch, capsys):
    """All stages of ``softwarp demo``, by the function that it calls: a policy, its test, pictures, a film, a scene."""
    monkeypatch.setattr(render, "RenderConfig", functools.partial(render.RenderConfig, width=64, height=48))
    small = ["num_worlds=2", "total_steps=16", "algo.horizon=8", "algo.minibatches=2", "env.max_episode_steps=4"]
    assert demo.main(str(tmp_path / "made"), None, [*small, "evaluations=1", "evaluation_episodes=2"]) == 0
    told = capsys.readouterr().out
    listed = [Path(line.split()[-1]) for line in told.splitlines() if line.startswith("  ") and str(tmp_path) in line]
    made = [path for path in listed if path.suffix and path.is_file()]
    assert {path.suffix for path in made} >= {".pt", ".png", ".json", ".usdc"}
    assert len([path for path in made if path.suffix in (".mp4", ".gif")]) == 1
    assert all(path.stat().st_size > 300 for path in made)
    policies = json.loads((tmp_path / "made" / "evaluation.json").read_text())["policies"]
    assert set(policies) == {"trained", "nothing", "random", "scripted"}
    assert [f"{stage}/4" in told for stage in (1, 2, 3, 4)] == [True] * 4


def test_policy_of_another_observation_is_refused(tmp_path, monkeypatch, capsys):
    """Changing what the environment observes leaves the policy without its input."""
    monkeypatch.chdir(tmp_path)
    short = ["env.mesh=coarse", "env.max_episode_steps=2", "num_worlds=2", "algo.horizon=2", "evaluations=0"]
    assert cli.main(["train", *short, "total_steps=8", "logger=quiet", "out=run"]) == 0
    assert cli.main(["eval", "run", "env.observation=paper"]) == 2
    assert "but this environment has" in capsys.readouterr().err


@pytest.mark.slow
def test_sweep_makes_a_run_per_setting(tmp_path):
    """``-m seed=0,1`` hands over to Hydra: two runs, each in a folder of its own."""
    short = ["env.mesh=coarse", "env.max_episode_steps=2", "num_worlds=2", "algo.horizon=2", "evaluations=0"]
    softwarp("train", "-m", "seed=0,1", *short, "total_steps=8", "logger=quiet", cwd=tmp_path, check=0)
    runs = sorted((tmp_path / "runs").glob("sweep_*/*/checkpoints/step_*.pt"))
    assert len({path.parent.parent for path in runs}) == 2
