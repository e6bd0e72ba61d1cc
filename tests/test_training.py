"""Training: it learns, the same seed gives the same policy, kills and Ctrl-C lose little, and the seeds are kept apart."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from importlib.metadata import EntryPoint

import gymnasium as gym
import numpy as np
import pytest
import reach_env
import torch
from clothgym_baselines import load_policy, train, training
from clothgym_baselines.hyperparameters import DEFAULTS, hyperparameters, parse_override
from clothgym_baselines.run_folder import RunFolder
from clothgym_envs.base import TRAIN_SEEDS, VALIDATION_SEEDS

from clothgym import cli

pytestmark = pytest.mark.filterwarnings("error")

ENV = "reach_env:Reach-v0"
QUICK = {"n_steps": 64, "batch_size": 64, "learning_rate": 2e-3}
SHORT = {"n_steps": 32, "batch_size": 32, "n_epochs": 2}


def short(out, **options):
    """Two rollouts of 64 steps in this process, with three small validations."""
    overrides = SHORT | options.pop("overrides", {})
    chosen = {"steps": 128, "every": 64, "episodes": 3, "processes": False, **options}
    return train(ENV, out=out, overrides=overrides, **chosen)


@pytest.fixture(scope="module")
def learnt(tmp_path_factory):
    return train(
        ENV, out=tmp_path_factory.mktemp("runs") / "learnt", steps=3000, every=1000, overrides=QUICK, processes=False
    )


# learning


def test_ppo_learns(learnt):
    assert [row["steps"] for row in learnt.curve] == [0, 1024, 2048, 3072]
    assert learnt.steps == 3072, "rounded up to whole rollouts"
    assert learnt.curve[0]["success"] <= 0.3
    assert learnt.best["success"] >= 0.9
    assert learnt.best["return"] > learnt.curve[0]["return"] + 0.5
    low, high = learnt.curve[0]["success_interval"]
    assert low <= learnt.curve[0]["success"] <= high


def test_ppo_learns_to_dress_in_less_than_two_minutes(tmp_path):
    """The table's own settings; a fifth of what the README's run takes."""
    run = train("clothgym/DressRing-v0", steps=10_240, seed=0, out=tmp_path / "ring", processes=False, episodes=10)
    untrained = run.curve[0]
    assert untrained["success"] == 0.0 and abs(untrained["return"]) < 0.5
    assert run.best["success"] >= 0.5
    assert run.best["return"] > 7.0
    assert all(row["failures"] == 0 for row in run.curve)


def test_what_a_run_leaves(learnt):
    folder = learnt.folder
    rows = [json.loads(line) for line in (folder / "curve.jsonl").read_text().splitlines()]
    assert rows == json.loads(json.dumps(learnt.curve))
    assert sorted(p.name for p in (folder / "checkpoints").iterdir()) == [
        f"step_{row['steps']:010d}.zip" for row in rows
    ]
    config = json.loads((folder / "config.json").read_text())
    assert config["run"]["hyperparameters"] == hyperparameters("ppo", ENV, QUICK)
    assert config["run"] | {"hyperparameters": {}} == {
        "env_id": ENV, "algo": "ppo", "steps": 3000, "seed": 0, "level": None, "fidelity": None, "envs": 2, "every": 1000,
        "episodes": 20, "hyperparameters": {},
    }  # fmt: skip
    assert {"machine", "commit"} <= set(config)
    assert {"clothgym", "stable-baselines3", "torch"} <= set(config["versions"])
    assert learnt.picture == folder / "curve.png"
    assert learnt.picture.read_bytes().startswith(b"\x89PNG")
    assert load_policy(folder / "best.zip").about["steps"] == learnt.best["steps"]
    assert load_policy(folder / "policy.zip").about["steps"] == 3072


def test_the_best_policy_does_what_its_row_tells(learnt):
    policy, env = load_policy(learnt.folder / "best.zip"), gym.make(ENV)
    returns = []
    for seed in VALIDATION_SEEDS[:20]:
        observation, info = env.reset(seed=seed)
        policy.reset(env)
        returns.append(0.0)
        over = False
        while not over:
            observation, reward, terminated, truncated, info = env.step(policy.act(observation, info))
            returns[-1] += reward
            over = terminated or truncated
    assert np.mean(returns) == pytest.approx(learnt.best["return"], abs=1e-12)


@pytest.mark.parametrize(
    ("algo", "overrides"),
    [
        ("a2c", {}),
        ("sac", {"learning_starts": 50, "net_arch": [16, 16], "batch_size": 32}),
        ("td3", {"learning_starts": 50, "net_arch": [16, 16], "batch_size": 32}),
    ],
)
def test_the_other_algorithms_run_and_resume(algo, overrides, tmp_path):
    options = {"out": tmp_path / "run", "algo": algo, "every": 64, "episodes": 2, "processes": False}
    first = train(ENV, steps=128, overrides=overrides, **options)
    again = train(ENV, steps=128, overrides=overrides, **(options | {"out": tmp_path / "other"}))
    assert again.digest == first.digest
    longer = train(ENV, steps=192, resume=True, **options)
    assert [row["steps"] for row in longer.curve] == [0, 64, 128, 192]
    assert longer.digest != first.digest
    if algo != "a2c":
        with np.load(tmp_path / "run" / "checkpoints" / "replay.npz") as replay:
            assert tuple(replay["position"]) == (96, 0), "two environments: what the first part saw is still there"
            with np.load(tmp_path / "other" / "checkpoints" / "replay.npz") as before:
                assert (replay["observations"][:64] == before["observations"]).all()


# what decides the result


def test_the_seed_decides(tmp_path):
    first = short(tmp_path / "a")
    assert short(tmp_path / "b").digest == first.digest
    assert short(tmp_path / "c", every=1000, episodes=5).digest == first.digest, "validation is not noticed"
    assert short(tmp_path / "d", seed=1).digest != first.digest
    assert short(tmp_path / "e", overrides={"gamma": 0.9}).digest != first.digest


def test_processes_change_nothing(tmp_path):
    here, there = short(tmp_path / "a"), short(tmp_path / "b", processes=True)
    assert there.digest == here.digest
    assert [row | {"seconds": 0} for row in there.curve] == [row | {"seconds": 0} for row in here.curve]


def test_torch_keeps_its_threads(tmp_path):
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        short(tmp_path, steps=1, every=1000, episodes=1)
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


def test_seeds_are_kept_apart(tmp_path, monkeypatch):
    seen = []
    reset = reach_env.Reach.reset

    def noted(self, *, seed=None, options=None):
        told = reset(self, seed=seed, options=options)
        seen.append((seed, self.episode_seed))
        return told

    monkeypatch.setattr(reach_env.Reach, "reset", noted)
    short(tmp_path, seed=40)
    given = [seed for seed, _ in seen if seed is not None]
    assert [seed for seed in given if seed in TRAIN_SEEDS] == [40, 41], "environment i starts with seed + i"
    validation = [seed for seed in given if seed not in TRAIN_SEEDS]
    assert validation == 3 * [10_000, 10_001, 10_002]
    drawn = [episode for seed, episode in seen if seed is None]
    assert len(drawn) > 10
    assert all(episode in TRAIN_SEEDS for episode in drawn)
    first = {episode for seed, episode in seen if episode in TRAIN_SEEDS}
    seen.clear()
    short(tmp_path, resume=True, steps=256)
    begun = [seed for seed, _ in seen if seed is not None and seed in TRAIN_SEEDS]
    assert len(begun) == 2
    assert not first & set(begun), "a resumed run does not play the episodes of its start again"


# going on


def test_resume_takes_up_weights_and_optimiser(tmp_path):
    first = short(tmp_path)
    same = short(tmp_path, resume=True)
    assert (same.digest, same.steps, same.curve) == (first.digest, first.steps, first.curve), "nothing was left to do"
    folder = RunFolder(tmp_path)
    run = json.loads((tmp_path / "config.json").read_text())["run"]
    environments = training.vectorised(ENV, {}, 2, False)
    model = training.build_model(run, environments, 128)
    assert not model.policy.optimizer.state_dict()["state"]
    training._restore(model, folder, folder.checkpoints()[-1])
    assert training.weights_digest(model) == first.digest
    assert model._n_updates == 4
    steps = {int(state["step"]) for state in model.policy.optimizer.state_dict()["state"].values()}
    assert steps == {8}, "4 epochs of 2 minibatches"
    longer = short(tmp_path, resume=True, steps=200)
    assert longer.steps == 256
    assert [row["steps"] for row in longer.curve] == [0, 64, 128, 192, 256]
    assert longer.seconds > first.seconds
    config = json.loads((tmp_path / "config.json").read_text())
    assert config["run"]["steps"] == 200
    assert [part["from_step"] for part in config["resumed"]] == [128, 128]


def test_resume_is_repeatable_and_takes_what_is_not_given_from_the_run(tmp_path):
    for name in ("a", "b"):
        short(tmp_path / name, seed=3)
    a = short(tmp_path / "a", resume=True, steps=256, seed=3)
    b = train(ENV, out=tmp_path / "b", resume=True, steps=256, processes=False)
    assert a.digest == b.digest


def test_a_kill_loses_what_came_after_the_checkpoint(tmp_path):
    first = short(tmp_path)
    (tmp_path / "checkpoints" / "step_0000000128.zip").unlink()
    with (tmp_path / "curve.jsonl").open("a") as file:
        file.write('{"steps": 192, "succ')
    again = short(tmp_path, resume=True)
    assert [row["steps"] for row in again.curve] == [0, 64, 128]
    rows = [json.loads(line) for line in (tmp_path / "curve.jsonl").read_text().splitlines()]
    assert [row["steps"] for row in rows] == [0, 64, 128]
    assert rows[1] == json.loads(json.dumps(first.curve[1]))


def test_a_run_that_was_killed_before_its_first_checkpoint(tmp_path):
    first = short(tmp_path / "a")
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "config.json").write_bytes((tmp_path / "a" / "config.json").read_bytes())
    assert short(tmp_path / "b", resume=True).digest == first.digest


def test_a_folder_with_a_run_is_left_alone(tmp_path):
    short(tmp_path)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    with pytest.raises(ValueError, match="holds a run: continue it with --resume"):
        short(tmp_path)
    for options, complaint in (
        ({"seed": 1}, r"seed = 1: the run in .*config\.json has 0"),
        ({"algo": "sac"}, "algo = 'sac': the run in .* has 'ppo'"),
        ({"envs": 1}, "envs = 1: the run in .* has 2"),
        ({"every": 32}, "every = 32: the run in .* has 64"),
        ({"level": "hard"}, "level = 'hard': the run in .* has None"),
        ({"steps": 64}, "steps = 64: the run in .* has 128, which can only grow"),
        ({"overrides": {"gamma": 0.5}}, "gamma = 0.5: the run in .* has 0.98"),
    ):
        with pytest.raises(ValueError, match=complaint):
            short(tmp_path, resume=True, **options)
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


def test_folders_that_hold_no_run(tmp_path):
    with pytest.raises(ValueError, match=r"config\.json is missing: nothing to resume"):
        short(tmp_path / "new", resume=True)
    (tmp_path / "policy.zip").write_bytes(b"")
    with pytest.raises(ValueError, match=r"config\.json is missing beside policy\.zip: holds other files"):
        short(tmp_path)
    with pytest.raises(ValueError, match="is a file"):
        short(tmp_path / "policy.zip")
    for text in ("{", "[]", '{"run": 1}', '{"run": {"algo": "ppo"}}'):
        (tmp_path / "config.json").write_text(text)
        with pytest.raises(ValueError, match=r"config\.json: "):
            short(tmp_path, resume=True)


# bad input


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        ({"algo": "dqn"}, "algo = 'dqn': expected one of ppo, sac, td3, a2c"),
        ({"steps": 0}, "steps = 0"),
        ({"seed": 9_999}, "seed = 9999: out of range"),
        ({"envs": 0}, "envs = 0"),
        ({"episodes": 101}, "episodes = 101"),
        ({"level": "mild"}, "level = 'mild': expected one of easy, medium, hard"),
        ({"fidelity": "best"}, "fidelity = 'best'"),
        ({"fidelity": "draft"}, "unexpected keyword argument 'fidelity'"),
        ({"overrides": {"gama": 1}}, "gama = 1: ppo has no such hyperparameter; expected one of learning_rate"),
        ({"overrides": {"gamma": 1.5}}, "gamma = 1.5: out of range"),
        ({"overrides": {"n_steps": 1.5}}, "n_steps = 1.5: expected an integer"),
        ({"overrides": {"batch_size": 48}}, "batch_size = 48: must divide n_steps x envs = 32 x 2"),
        ({"overrides": {"net_arch": [64, -1]}}, "net_arch = -1"),
        ({"overrides": {"net_arch": 64}}, "net_arch = 64"),
        ({"overrides": {"activation_fn": "os.system"}}, "activation_fn = 'os.system'"),
        ({"overrides": {"ent_coef": "auto"}}, "ent_coef = 'auto'"),
        ({"overrides": {"ortho_init": 1}}, "ortho_init = 1"),
    ],
)
def test_bad_input_is_one_line_and_leaves_nothing(options, complaint, tmp_path):
    with pytest.raises(ValueError, match=complaint) as caught:
        short(tmp_path / "run", **options)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "run").exists()


def test_environments_that_cannot_be_learnt(tmp_path):
    for env_id, complaint in (
        ("reach_env:Reach-v7", "ENV = 'reach_env:Reach-v7'"),
        ("no_module:Reach-v0", "No module named 'no_module'"),
        ("FrozenLake-v1", r"observation_space = Discrete\(16\): expected a Box of one axis in float32"),
    ):
        with pytest.raises(ValueError, match=complaint) as caught:
            train(env_id, out=tmp_path / "run")
        assert "\n" not in str(caught.value)


def test_overrides_as_text():
    assert parse_override("gamma=0.9") == ("gamma", 0.9)
    assert parse_override("net_arch=64,32") == ("net_arch", [64, 32])
    assert parse_override(" ent_coef = auto") == ("ent_coef", "auto")
    assert parse_override("ortho_init=false") == ("ortho_init", False)
    for text in ("gamma", "=1"):
        with pytest.raises(ValueError, match="expected name=value"):
            parse_override(text)


@pytest.mark.parametrize("algo", DEFAULTS)
def test_the_table_passes_its_own_checks(algo):
    values = DEFAULTS[algo]
    assert hyperparameters(algo, ENV, values) == values


def test_a_process_that_dies_is_told(tmp_path):
    with pytest.raises(RuntimeError, match="a process with an environment died"):
        train("reach_env:Dying-v0", out=tmp_path, steps=64, overrides=SHORT, episodes=1, processes=True, envs=1)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_importing_the_package_does_not_import_torch():
    code = "import sys, clothgym_baselines, clothgym_baselines.commands; print('torch' in sys.modules)"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert run.stdout.strip() == "False"


# the command


@pytest.fixture
def say(monkeypatch, tmp_path, capsys):
    entry = EntryPoint("train", "clothgym_baselines.commands:register", cli.ENTRY_POINTS)
    monkeypatch.setattr(cli, "entry_points", lambda: {"train": entry})
    monkeypatch.delenv("CLOTHGYM_DEBUG", raising=False)
    monkeypatch.chdir(tmp_path)

    def say(*words: str) -> tuple[int, str, str]:
        capsys.readouterr()
        code = cli.main(["train", *words])
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return say


WORDS = (ENV, "--steps", "128", "--every", "64", "--episodes", "3", "--no-subproc", "--out", "run")
SETS = ("--set", "n_steps=32", "--set", "batch_size=32", "--set", "n_epochs=2")


def test_command_as_json(say, tmp_path):
    code, out, err = say(*WORDS, *SETS, "--json")
    assert code == 0
    document = json.loads(out)
    assert document["digest"] == short(tmp_path / "other").digest
    assert document["steps"] == 128
    assert document["best"] in document["curve"]
    assert len(err.splitlines()) == 3, "a line per validation"
    assert "128 steps" in err.splitlines()[-1]


def test_command_as_table(say, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    code, out, err = say(*WORDS, *SETS)
    assert code == 0
    assert f"Trained on {ENV}: run" in out
    assert "clothgym evaluate" not in out, "which knows our own environments only"
    assert 'pip install "clothgym[plot]"' in err


def test_ctrl_c_keeps_what_was_learnt(say, tmp_path, monkeypatch):
    reset = reach_env.Reach.reset
    count = []

    def interrupted(self, **options):
        count.append(1)
        if len(count) == 25:
            signal.raise_signal(signal.SIGINT)
        return reset(self, **options)

    monkeypatch.setattr(reach_env.Reach, "reset", interrupted)
    code, out, err = say(*WORDS, *SETS)
    assert (code, out) == (130, "")
    line = err.splitlines()[-1]
    assert line == "clothgym train: stopped after 64 of 128 steps; run/policy.zip is kept, --resume goes on"
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    assert load_policy(tmp_path / "run" / "policy.zip").about["steps"] == 64
    code, out, err = say(*WORDS, *SETS, "--resume", "--json")
    assert code == 0
    assert [row["steps"] for row in json.loads(out)["curve"]] == [0, 64, 128]


def test_mistakes_are_one_line(say, monkeypatch):
    for words, complaint in (
        ((ENV,), "Missing option '--out'"),
        (("UntangleShirt", "--out", "run"), "no such environment; did you mean clothgym/UntangleLayers-v0?"),
        ((*WORDS, "--set", "gamma"), "--set 'gamma': expected name=value"),
        ((*WORDS, "--set", "gamma=2"), "gamma = 2: out of range [0, 1]"),
        ((*WORDS, "--algo", "dqn"), "algo = 'dqn'"),
        ((*WORDS, "--resume"), "nothing to resume"),
        (("UntangleLayers", "--out", "run", "--level", "mild"), "level = 'mild'"),
    ):
        code, out, err = say(*words)
        assert (code, out) == (2, ""), words
        assert complaint in err
        assert err.count("\n") == 1
    monkeypatch.setitem(sys.modules, "stable_baselines3", None)
    code, out, err = say(*WORDS)
    assert (code, out) == (2, "")
    assert err == 'clothgym train: stable_baselines3 is not installed; install it with: pip install "clothgym[rl]"\n'
