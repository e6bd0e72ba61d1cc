"""Policy files: the same actions as the model, and no file runs code, fills the memory or says more than one line."""

from __future__ import annotations

import ast
import base64
import importlib.metadata
import io
import json
import pickle
import zipfile
from importlib.metadata import EntryPoint
from pathlib import Path

import clothgym_envs
import gymnasium as gym
import numpy as np
import pytest
import reach_env
import stable_baselines3 as sb3
import torch
from clothgym_baselines import load_policy, policy_file, save_policy
from clothgym_envs import evaluation, policies
from stable_baselines3.common.save_util import load_from_zip_file

from clothgym import cli

pytestmark = pytest.mark.filterwarnings("error")

LAYERS = "clothgym/UntangleLayers-v0"
SMALL = {"net_arch": [8, 8]}


def model(algo: str = "PPO", env: gym.Env | None = None, **policy_kwargs):
    options = {"buffer_size": 10} if algo in ("SAC", "TD3") else {"n_steps": 4}
    if algo == "PPO":
        options["batch_size"] = 4
    env = reach_env.Reach() if env is None else env
    return getattr(sb3, algo)("MlpPolicy", env, seed=1, device="cpu", policy_kwargs=policy_kwargs or None, **options)


@pytest.fixture(scope="module")
def good() -> bytes:
    return policy_file.to_bytes(model(**SMALL), "reach_env:Reach-v0")


def changed(data: bytes, members: dict[str, bytes | None], **about) -> bytes:
    """The file with other members (None = without it) and other fields in its description (... = without it)."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        content = {name: archive.read(name) for name in archive.namelist()}
    told = json.loads(content[policy_file.ABOUT]) | about
    told = {name: value for name, value in told.items() if value is not ...}
    content |= {policy_file.ABOUT: json.dumps(told).encode()} | members
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, value in content.items():
            if value is not None:
                archive.writestr(name, value)
    return buffer.getvalue()


# the same actions


@pytest.mark.parametrize(
    ("algo", "policy_kwargs"),
    [
        ("PPO", {}),
        ("PPO", {"net_arch": {"pi": [16], "vf": [8, 8]}, "activation_fn": torch.nn.ELU, "log_std_init": -1.0}),
        ("PPO", {"net_arch": [], "ortho_init": False}),
        ("A2C", {"net_arch": [32, 16]}),
        ("SAC", {"net_arch": {"pi": [16], "qf": [8]}, "n_critics": 1}),
        ("TD3", {"net_arch": [16, 16]}),
    ],
)
def test_actions_are_those_of_the_model(algo, policy_kwargs, tmp_path):
    env = reach_env.Reach(wide=5)
    trained = model(algo, env, **policy_kwargs)
    with torch.no_grad():
        for parameter in trained.policy.parameters():
            parameter.mul_(6.0)  # some actions reach the bounds
    path = save_policy(trained, tmp_path / "policy.zip", "reach_env:Reach-v0", seed=3)
    policy, theirs = load_policy(path), type(trained).load(path, device="cpu")
    assert policy.about["env_id"] == "reach_env:Reach-v0"
    assert policy.about["seed"] == 3
    policy.reset(env)
    observations = np.random.default_rng(0).uniform(-2.0, 2.0, (50, 7)).astype(np.float32)
    actions = np.array([policy.act(observation, {}) for observation in observations])
    for other in (trained, theirs):
        expected = [other.predict(observation, deterministic=True)[0] for observation in observations]
        assert (actions == np.array(expected)).all(), "bit for bit"
    assert actions.dtype == np.float32
    assert actions.shape == (50, 1)
    assert np.abs(actions).max() <= 1.0
    assert np.unique(actions).size > 5


def test_choices():
    env = gym.make("CartPole-v1")
    trained = model(env=env, **SMALL)
    policy = policy_file.from_bytes(policy_file.to_bytes(trained))
    policy.reset(env)
    observations = np.random.default_rng(0).normal(size=(50, 4)).astype(np.float32)
    actions = [int(policy.act(observation, {})) for observation in observations]
    assert actions == [int(trained.predict(observation, deterministic=True)[0]) for observation in observations]
    assert set(actions) == {0, 1}


def test_reading_leaves_torch_as_it_was(good):
    before, threads = torch.random.get_rng_state(), torch.get_num_threads()
    policy = policy_file.from_bytes(good)
    torch.set_num_threads(2)
    try:
        policy.act(np.zeros(2, np.float32), {})
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(threads)
    assert (torch.random.get_rng_state() == before).all(), "a training that validates must not notice"


def test_models_that_plain_json_cannot_tell():
    with pytest.raises(ValueError, match="model = 'dqn'"):
        policy_file.to_bytes(sb3.DQN("MlpPolicy", "CartPole-v1", buffer_size=10))
    with pytest.raises(ValueError, match=r"policy_kwargs\['use_sde'\]"):
        policy_file.to_bytes(sb3.SAC("MlpPolicy", reach_env.Reach(), buffer_size=10, use_sde=True))
    with pytest.raises(ValueError, match="activation_fn = 'hardtanh'"):
        policy_file.to_bytes(model(activation_fn=torch.nn.Hardtanh))
    own = type("Own", (sb3.ppo.MlpPolicy,), {})
    with pytest.raises(ValueError, match="its policy is Own"):
        policy_file.to_bytes(sb3.PPO(own, reach_env.Reach(), n_steps=4, batch_size=4))


# files that mean harm


class Harm:
    """Unpickling it makes a file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple:
        return Path.touch, (self.path,)


def test_pickles_are_not_opened(good, tmp_path):
    """Both payloads are live: the usual way of loading runs them, ours does not."""
    mark = tmp_path / "was_here"
    serialized = base64.b64encode(pickle.dumps(Harm(mark))).decode()
    data = json.dumps({"policy_class": {":type:": "x", ":serialized:": serialized}}).encode()
    weights = io.BytesIO()
    torch.save({"log_std": Harm(mark)}, weights)
    path = tmp_path / "policy.zip"
    path.write_bytes(changed(good, {"data": data, "policy.pth": weights.getvalue()}))
    policy = load_policy(path)
    assert policy.act(np.zeros(2, np.float32), {}).shape == (1,)
    path.write_bytes(changed(good, {"data": data, policy_file.ABOUT: None}))
    with pytest.raises(ValueError, match=r"save_policy\(model, path\)"):
        load_policy(path)
    for name in (policy_file.ABOUT, policy_file.WEIGHTS):
        path.write_bytes(changed(good, {name: pickle.dumps(Harm(mark))}))
        with pytest.raises(ValueError, match="clothgym"):
            load_policy(path)
    assert not mark.exists()

    path.write_bytes(changed(good, {"data": data}))
    load_from_zip_file(path)
    assert mark.exists()
    mark.unlink()
    torch.load(io.BytesIO(weights.getvalue()), weights_only=False)
    assert mark.exists()


def test_bombs(good, tmp_path, monkeypatch):
    path = tmp_path / "policy.zip"
    for limit, member in (("MAX_ABOUT", policy_file.ABOUT), ("MAX_WEIGHTS", policy_file.WEIGHTS)):
        size = getattr(policy_file, limit)
        assert size <= 256_000_000
        with monkeypatch.context() as patch:
            patch.setattr(policy_file, limit, 1_000_000)
            bomb = io.BytesIO(changed(good, {member: None}))
            with zipfile.ZipFile(bomb, "a", zipfile.ZIP_DEFLATED) as archive:
                archive.writestr(member, bytes(20_000_000))
            assert len(bomb.getvalue()) < 100_000
            path.write_bytes(bomb.getvalue())
            with pytest.raises(ValueError, match=f"{member}: larger than 1000000 bytes"):
                load_policy(path)
    packed = io.BytesIO(changed(good, {policy_file.WEIGHTS: None}))
    with zipfile.ZipFile(packed, "a", zipfile.ZIP_BZIP2) as archive:
        archive.writestr(policy_file.WEIGHTS, bytes(100))
    path.write_bytes(packed.getvalue())
    with pytest.raises(ValueError, match="compressed in another way"):
        load_policy(path)
    path.write_bytes(changed(good, {f"member{n}": b"" for n in range(policy_file.MAX_MEMBERS)}))
    with pytest.raises(ValueError, match="members: no policy file"):
        load_policy(path)
    with path.open("wb") as file:
        file.truncate(policy_file.MAX_FILE + 1)
    with pytest.raises(ValueError, match="no policy is larger than"):
        load_policy(path)


BOX = {"kind": "box", "shape": [1], "low": [-1.0], "high": [1.0]}


@pytest.mark.parametrize(
    ("about", "complaint"),
    [
        ({"format": "clothgym policy 9"}, "format = 'clothgym policy 9': expected 'clothgym policy 1'"),
        ({"algo": "dqn"}, "algo = 'dqn': expected one of ppo"),
        ({"algo": ["ppo"]}, "algo = "),
        ({"algo": "sac"}, "policy_kwargs|weights"),
        ({"env_id": 3}, "env_id = 3"),
        ({"observation_space": ...}, "observation_space = None"),
        ({"observation_space": {"kind": "box", "shape": [3]}}, r"weights\['mlp_extractor.policy_net.0.weight'\] = \[8, 2\]"),
        ({"observation_space": {"kind": "box", "shape": [10**9]}}, "observation_space.shape = 1000000000: out of range"),
        ({"observation_space": {"kind": "box", "shape": [2, 2]}}, "observation_space.shape"),
        ({"observation_space": {"kind": "discrete", "n": 2}}, "observation_space.kind = 'discrete'"),
        ({"action_space": BOX | {"low": [1.0]}}, "action_space.low: not below high"),
        ({"action_space": BOX | {"high": [float("inf")]}}, "action_space.high = inf"),
        ({"action_space": BOX | {"low": []}}, "action_space.low: expected 1 numbers"),
        ({"action_space": {"kind": "discrete", "n": 100_000}}, r"net_arch: needs \d+ weights, clothgym.weights has"),
        ({"policy_kwargs": {"net_arch": [4096] * 8}}, r"net_arch: needs \d+ weights, clothgym.weights has"),
        ({"policy_kwargs": {"net_arch": [8] * 9}}, "policy_kwargs.net_arch = .*expected up to 8 widths"),
        ({"policy_kwargs": {"net_arch": [10**9]}}, "policy_kwargs.net_arch = 1000000000"),
        ({"policy_kwargs": {"net_arch": {"pi": [8], "zz": [8]}}}, "expected pi and vf"),
        ({"policy_kwargs": {}}, "net_arch among them"),
        ({"policy_kwargs": SMALL | {"features_extractor_class": "os.system"}}, "policy_kwargs.features_extractor_class"),
        ({"policy_kwargs": SMALL | {"activation_fn": "system"}}, "policy_kwargs.activation_fn = 'system'"),
        ({"policy_kwargs": SMALL | {"ortho_init": "yes"}}, "policy_kwargs.ortho_init = 'yes'"),
        ({"weights": {}}, r"clothgym.weights: has \d+ bytes, weights tells of 0"),
        ({"weights": {"log_std": [10**5, 10**5]}}, r"clothgym.weights: has \d+ bytes"),
        ({"weights": {"log_std": [1, 1, 1]}}, r"weights\['log_std'\]"),
        ({"weights": {"log_std": [-1]}}, r"weights\['log_std'\] = -1"),
    ],
)  # fmt: skip
def test_a_wrong_description_is_one_line(good, about, complaint, tmp_path):
    path = tmp_path / "policy.zip"
    path.write_bytes(changed(good, {}, **about))
    with pytest.raises(ValueError, match=complaint) as caught:
        load_policy(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


def test_wrong_members(good, tmp_path):
    path = tmp_path / "policy.zip"
    with zipfile.ZipFile(io.BytesIO(good)) as archive:
        weights = archive.read(policy_file.WEIGHTS)
    nan = np.frombuffer(weights, "<f4").copy()
    nan[5] = np.nan
    for members, complaint in (
        ({policy_file.WEIGHTS: None}, "clothgym.weights is missing"),
        ({policy_file.WEIGHTS: weights[:-4]}, "clothgym.weights: has"),
        ({policy_file.WEIGHTS: weights[:-1]}, "clothgym.weights: has"),
        ({policy_file.WEIGHTS: nan.tobytes()}, "clothgym.weights: number 5 is not finite"),
        ({policy_file.ABOUT: b"{"}, "clothgym.json: no JSON"),
        ({policy_file.ABOUT: b"\xff"}, "clothgym.json: no JSON"),
        ({policy_file.ABOUT: b"[" * 100_000}, "clothgym.json: no JSON"),
        ({policy_file.ABOUT: b"[]"}, "format = 'list'"),
        ({policy_file.ABOUT: None}, "clothgym.json is missing: no policy file of clothgym"),
    ):
        path.write_bytes(changed(good, members))
        with pytest.raises(ValueError, match=complaint) as caught:
            load_policy(path)
        assert "\n" not in str(caught.value)


def test_what_is_no_policy_file(good, tmp_path):
    path = tmp_path / "policy.zip"
    for data in (b"", b"PK", b"not a zip at all", good[: len(good) // 2], good[:-1]):
        path.write_bytes(data)
        with pytest.raises(ValueError, match="no zip file, or a damaged one"):
            load_policy(path)
    with pytest.raises(ValueError, match="is no file"):
        load_policy(tmp_path)
    with pytest.raises(FileNotFoundError):
        load_policy(tmp_path / "nothing.zip")


def test_damaged_files_raise_nothing_else(good):
    """Bytes changed at random: each file is read, or refused by ValueError."""
    rng = np.random.default_rng(5)
    refused = 0
    ends = np.array([i for i in range(len(good) - 4) if good[i : i + 2] == b"PK"])
    for attempt in range(150):
        data = bytearray(good)
        # half of them in the headers, where the reader is misled rather than stopped by a sum
        places = rng.integers(0, len(data), 4) if attempt % 2 else rng.choice(ends, 2) + rng.integers(2, 60, 2)
        for place in places:
            data[min(int(place), len(data) - 1)] = int(rng.integers(256))
        try:
            policy_file.from_bytes(bytes(data))
        except ValueError:
            refused += 1
    assert 20 < refused < 150


# in environments


def test_a_policy_made_for_another_shape(good):
    policy = policy_file.from_bytes(good, "mine.zip")
    policy.reset(reach_env.Reach())
    with pytest.raises(
        ValueError, match=r"^mine.zip: observation_space: made for shape \(2,\) of reach_env:Reach-v0, "
    ):
        policy.reset(reach_env.Reach(wide=1))
    env = reach_env.Reach()
    env.action_space = gym.spaces.Box(-1.0, 1.0, (3,), np.float32)
    with pytest.raises(ValueError, match=r"action_space: made for shape \(1,\) within \[-1, 1\] .* has shape \(3,\)"):
        policy.reset(env)
    env.action_space = gym.spaces.Box(-2.0, 2.0, (1,), np.float32)
    with pytest.raises(ValueError, match=r"has shape \(1,\) within \[-2, 2\]"):
        policy.reset(env)


@pytest.fixture
def registered(monkeypatch):
    """The entry points as the package declares them, whether or not this installation knows them yet."""
    entries = {
        evaluation.POLICY_FILES: [
            EntryPoint("zip", "clothgym_baselines.policy_file:load_policy", evaluation.POLICY_FILES)
        ],
        cli.ENTRY_POINTS: [EntryPoint("evaluate", "clothgym_envs.evaluation:register", cli.ENTRY_POINTS)],
    }
    known = importlib.metadata.entry_points

    def declared(**chosen):
        group = chosen.get("group")
        return entries[group] if group in entries else known(**chosen)

    monkeypatch.setattr(importlib.metadata, "entry_points", declared)


def test_evaluate_takes_files_in_any_number_of_processes(registered, tmp_path, capsys):
    env = gym.make(f"clothgym_envs:{LAYERS}")
    path = save_policy(model(env=env, **SMALL), tmp_path / "policy.zip", LAYERS)
    assert cli.main(["evaluate", LAYERS, "--policy", str(path), "--episodes", "2", "--jobs", "2", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["policy"] == str(path)
    rows = evaluation.evaluate(LAYERS, str(path), [20_001])["rows"]
    assert document["rows"][1] == json.loads(json.dumps(rows[0]))
    assert document["rows"][0]["return"] != rows[0]["return"]


def test_evaluate_refuses_in_one_line(registered, good, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("other.zip").write_bytes(good)
    Path("broken.zip").write_bytes(good[:1000])
    Path("model.pkl").write_bytes(pickle.dumps(Harm(tmp_path / "was_here")))
    for words, complaint in (
        (["other.zip"], r"other.zip: observation_space: made for shape (2,)"),
        (["other.zip", "--jobs", "2"], r"other.zip: observation_space: made for shape (2,)"),
        (["broken.zip", "--out", "rows.jsonl"], "broken.zip: no zip file"),
        (["none.zip"], "none.zip: no such policy file"),
        (["model.pkl"], "policy = 'model.pkl': files of this kind are not loaded"),
        (["folder/zero"], "files of this kind are not loaded"),
        (["nobody"], "policy = 'nobody': expected one of zero, random"),
    ):
        capsys.readouterr()
        code = cli.main(["evaluate", LAYERS, "--policy", *words, "--episodes", "2"])
        captured = capsys.readouterr()
        assert (code, captured.out) == (2, ""), words
        assert complaint in captured.err
        assert captured.err.count("\n") == 1
    assert not Path("was_here").exists()
    assert not Path("rows.jsonl").exists(), "nothing is opened for a policy that cannot be read"


def test_names_go_before_files(registered, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "zero").write_bytes(b"")
    assert isinstance(evaluation.policy_maker(LAYERS, "zero")(), policies.Zero)


def test_environments_do_not_import_baselines():
    for path in Path(clothgym_envs.__file__).parent.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import | ast.ImportFrom):
                names = [alias.name for alias in node.names] + [getattr(node, "module", None) or ""]
                assert not any(
                    name.split(".")[0] in ("clothgym_baselines", "stable_baselines3", "torch") for name in names
                )
