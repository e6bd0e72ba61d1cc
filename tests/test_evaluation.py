"""Evaluation: intervals against known answers, rows that depend on nothing but the seed, and the command."""

from __future__ import annotations

import json
import signal
from importlib.metadata import EntryPoint

import clothgym_envs
import numpy as np
import pytest
from clothgym_envs import evaluation, policies
from clothgym_envs.base import LEVELS, TEST_SEEDS
from clothgym_envs.evaluation import bootstrap_interval, evaluate, interquartile_mean, wilson_interval
from scipy import stats

from clothgym import cli

LAYERS = "clothgym/UntangleLayers-v0"


class Told:
    """An environment that plays episodes out of a book: by seed, what happens in the last step."""

    class action_space:
        shape = (2,)

    def __init__(self, book: dict[int, dict] | None = None, stop_at: int | None = None) -> None:
        self.book, self.stop_at, self.unwrapped = book or {}, stop_at, self

    def _info(self, **values) -> dict:
        last = {"is_success": False, "progress": 0.25, "failure": 0, "max_strain": 0.1, "force_max": 0.0}
        terms = {"reward/length": 1.0, "reward/failure": 0.0}
        return last | {"episode_seed": self.episode_seed, "side_error": 0.5} | terms | values

    def reset(self, seed: int) -> tuple:
        self.episode_seed, self.steps = seed, 0
        return np.zeros(1), self._info(**{"reward/length": 0.0})

    def step(self, action) -> tuple:
        self.steps += 1
        if self.episode_seed == self.stop_at:
            signal.raise_signal(signal.SIGINT)
        told = self.book.get(self.episode_seed, {})
        if self.steps < 3:
            return np.zeros(1), 1.0, False, False, self._info(max_strain=0.1 * self.steps)
        info = self._info(**told)
        return np.zeros(1), info["reward/length"] + info["reward/failure"], bool(told), not told, info


WON = {"is_success": True, "progress": 0.9, "side_error": 0.0}
FAILED = {"failure": 3, "reward/failure": -20.0, "reward/length": 0.0, "progress": 0.0}


@pytest.fixture
def told(monkeypatch):
    def prepare(book: dict[int, dict] | None = None, stop_at: int | None = None) -> None:
        monkeypatch.setattr(evaluation, "_environment", lambda *setup: Told(book, stop_at))

    return prepare


# statistics


@pytest.mark.parametrize(("successes", "count"), [(0, 1), (1, 1), (0, 100), (100, 100), (37, 100), (3, 7), (50, 100)])
def test_wilson(successes, count):
    known = stats.binomtest(successes, count).proportion_ci(method="wilson")
    assert wilson_interval(successes, count) == pytest.approx((known.low, known.high), abs=1e-12)


def test_wilson_of_nothing():
    for successes, count in ((0, 0), (3, 2), (-1, 5)):
        with pytest.raises(ValueError, match=f"successes = {successes} of {count}"):
            wilson_interval(successes, count)


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 7, 8, 100])
def test_interquartile_mean(count):
    values = np.random.default_rng(count).standard_normal(count) ** 3
    assert interquartile_mean(values) == pytest.approx(stats.trim_mean(values, 0.25))


def test_interquartile_mean_leaves_out_the_extremes():
    assert interquartile_mean([1e9, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, -1e9]) == 3.5


def test_bootstrap_is_repeatable_and_covers():
    rng = np.random.default_rng(3)
    inside = {"mean": 0, "iqm": 0}
    trials = 150
    for _ in range(trials):
        values = rng.normal(2.0, 1.0, 40)
        for statistic in inside:
            low, high = bootstrap_interval(values, statistic)
            assert (low, high) == bootstrap_interval(values, statistic)
            inside[statistic] += low <= 2.0 <= high
    for hits in inside.values():
        assert 0.88 <= hits / trials <= 0.99
    assert bootstrap_interval([4.0]) == (4.0, 4.0)
    wide, narrow = (bootstrap_interval(rng.normal(size=count)) for count in (20, 2000))
    assert wide[1] - wide[0] > 4.0 * (narrow[1] - narrow[0])


def test_bootstrap_of_the_mean_is_near_the_normal_one():
    values = np.random.default_rng(1).normal(size=400)
    low, high = bootstrap_interval(values)
    assert high - low == pytest.approx(2 * 1.96 * values.std() / 20.0, rel=0.08)


def test_bootstrap_refuses():
    with pytest.raises(ValueError, match="values"):
        bootstrap_interval([])
    with pytest.raises(ValueError, match="statistic = 'median'"):
        bootstrap_interval([1.0], "median")


# rows and summary


def test_a_row_tells_the_episode(told):
    env = Told({7: WON})
    row = evaluation.run_episode(env, policies.get(LAYERS, "zero"), 7)
    assert row == {
        "seed": 7,
        "return": 3.0,
        "steps": 3,
        "is_success": True,
        "progress": 0.9,
        "failure": 0,
        "max_strain": 0.2,
        "force_max": 0.0,
        "side_error": 0.0,
        "reward/length": 3.0,
        "reward/failure": 0.0,
    }


def test_failed_episodes_are_counted_and_never_left_out(told):
    told({0: WON, 1: WON, 2: FAILED})
    result = evaluate(LAYERS, "zero", range(5))
    assert [row["seed"] for row in result["rows"]] == [0, 1, 2, 3, 4]
    assert result["episodes"] == 5
    assert result["success"] == 0.4
    assert result["success_interval"] == wilson_interval(2, 5)
    assert result["failures"] == 1
    assert result["failure_kinds"] == {"strain": 1}
    returns = [3.0, 3.0, -18.0, 3.0, 3.0]
    assert [row["return"] for row in result["rows"]] == returns
    told_return = result["metrics"]["return"]
    assert told_return["mean"] == pytest.approx(np.mean(returns))
    assert told_return["iqm"] == interquartile_mean(returns) == 3.0
    assert told_return["interval"] == bootstrap_interval(returns)
    assert told_return["iqm_interval"] == bootstrap_interval(returns, "iqm")
    assert result["metrics"]["progress"]["mean"] == pytest.approx((1.0 + 1.0 + 0.0 + 0.25 + 0.25) / 5), "1 for success"
    assert result["metrics"]["max_strain"]["max"] == 0.2
    assert "failure" not in result["metrics"]


def test_seeds_are_checked(told):
    told()
    for seeds, text in (([], "at least one"), ([1, 1], "each once"), ([-1], "seed = -1"), ([0.5], "seed = 0.5")):
        with pytest.raises(ValueError, match=text):
            evaluate(LAYERS, "zero", seeds)
    with pytest.raises(ValueError, match="policy = 'nobody'"):
        evaluate(LAYERS, "nobody", [1])
    with pytest.raises(ValueError, match="jobs = 0"):
        evaluate(LAYERS, "zero", [1], jobs=0)


def test_a_policy_of_ones_own(told):
    told({5: WON})
    made = []

    def maker() -> policies.Policy:
        made.append(policies.Zero())
        return made[-1]

    assert evaluate(LAYERS, maker, [5])["success"] == 1.0
    assert len(made) == 2, "one to see that it can be made, one for the episode"


def test_rows_do_not_depend_on_the_number_of_jobs():
    """Real episodes: two successes and one other."""
    seen: list[int] = []
    seeds = [1, 6, 2]
    one = evaluate(LAYERS, "pull_apart", seeds, progress=lambda row: seen.append(row["seed"]))
    assert seen == seeds
    two = evaluate(LAYERS, "pull_apart", seeds, jobs=2)
    assert json.dumps(two) == json.dumps(one)
    assert [row["seed"] for row in two["rows"]] == seeds
    assert evaluate(LAYERS, "pull_apart", [2])["rows"][0] == one["rows"][2], "nor on the episodes before"


# scores


def test_score(monkeypatch):
    entry = {
        "m_zero": {"m": 0.2, "policy": "zero", "episodes": 100},
        "m_ref": {"m": 0.7, "policy": "cem", "episodes": 40},
    }
    monkeypatch.setattr(evaluation, "reference_scores", lambda: {f"{LAYERS} easy draft": entry})
    for progress, expected in ((0.2, 0.0), (0.7, 1.0), (0.45, 0.5), (0.95, 1.5), (0.1, 0.0)):
        value, note = evaluation.score(f"clothgym_envs:{LAYERS}", "easy", "draft", progress)
        assert value == pytest.approx(expected)
        assert "cem (0.700, 40 episodes)" in note
    assert evaluation.score(LAYERS, "hard", "draft", 0.5)[0] is None
    value, note = evaluation.score(LAYERS, "easy", evaluation.Fidelity(), 0.5)
    assert value is None
    assert "no reference is committed for level easy at fidelity own" in note


def test_committed_constants():
    scores = evaluation.reference_scores()
    assert f"{LAYERS} easy draft" in scores
    for key, entry in scores.items():
        env_id, level, fidelity = key.split(" ")
        assert env_id in clothgym_envs.ENVIRONMENTS
        assert level in LEVELS
        assert fidelity in ("draft", "balanced", "accurate")
        names = policies.names(env_id)
        assert entry["m_zero"]["policy"] in ("zero", "random")
        assert entry["m_ref"]["policy"] in set(names) - {"zero", "random"}
        assert entry["m_ref"]["m"] - entry["m_zero"]["m"] >= 0.3, "below, a task is redesigned, not shipped"
        assert entry["m_ref"]["episodes"] >= 20
        assert entry["engine"]
        assert entry["seeds"][0] == TEST_SEEDS.start
        for name, told in entry["policies"].items():
            assert name in names
            assert 0.0 <= told["m"] <= 1.0
            assert told["success_interval"] == pytest.approx(
                wilson_interval(round(told["success"] * told["episodes"]), told["episodes"])
            )
        best = max(told["m"] for told in entry["policies"].values())
        assert entry["m_ref"]["m"] == best
        assert entry["m_zero"]["m"] == max(entry["policies"][n]["m"] for n in ("zero", "random"))
        for name in ("zero", "random"):
            assert entry["policies"][name]["success"] == 0.0


# the command


@pytest.fixture
def say(monkeypatch, tmp_path, capsys):
    entry = EntryPoint("evaluate", "clothgym_envs.evaluation:register", cli.ENTRY_POINTS)
    monkeypatch.setattr(cli, "entry_points", lambda: {"evaluate": entry})
    monkeypatch.delenv("CLOTHGYM_DEBUG", raising=False)
    monkeypatch.chdir(tmp_path)

    def say(*words: str) -> tuple[int, str, str]:
        capsys.readouterr()
        code = cli.main(["evaluate", *words])
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return say


def test_command_as_json(say, told, tmp_path):
    told({20_000: WON, 20_002: FAILED})
    words = ("UntangleLayers", "--policy", "zero", "--episodes", "4", "--out", "deep/rows.jsonl", "--json")
    code, out, err = say(*words)
    assert (code, err) == (0, "")
    document = json.loads(out)
    assert {"success", "success_interval", "score", "metrics", "episodes", "failures"} <= set(document)
    assert document["env_id"] == LAYERS
    assert (document["success"], document["episodes"], document["failures"]) == (0.25, 4, 1)
    assert document["success_interval"] == pytest.approx(list(wilson_interval(1, 4)))
    lines = [json.loads(line) for line in (tmp_path / "deep" / "rows.jsonl").read_text().splitlines()]
    assert [line["seed"] for line in lines] == [20_000, 20_001, 20_002, 20_003]
    assert len({line["key"] for line in lines}) == 4
    assert all({"versions", "commit", "machine", "level", "fidelity", "policy"} <= set(line) for line in lines)


def test_command_as_table(say, told):
    told({20_000: WON, 20_001: FAILED})
    code, out, _ = say(LAYERS, "--policy", "random", "--episodes", "2")
    assert code == 0
    assert f"random on {LAYERS}" in out
    assert "0.500  [0.095, 0.905]" in out
    assert "Failed episodes" in out
    assert "20001" in out
    assert "strain" in out


def test_the_test_seeds_are_the_default(say, told):
    told()
    code, out, _ = say(LAYERS, "--policy", "zero", "--json")
    assert code == 0
    assert [row["seed"] for row in json.loads(out)["rows"]] == list(TEST_SEEDS)


def test_ctrl_c_keeps_the_finished_episodes(say, told, tmp_path):
    told({20_000: WON}, stop_at=20_002)
    code, out, err = say("UntangleLayers", "--policy", "zero", "--out", "rows.jsonl")
    assert code == 130
    assert out == ""
    assert err == "clothgym evaluate: stopped after 2 of 100 episodes; 2 are in rows.jsonl\n"
    lines = [json.loads(line) for line in (tmp_path / "rows.jsonl").read_text().splitlines()]
    assert [line["seed"] for line in lines] == [20_000, 20_001]
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_mistakes_are_one_line(say, tmp_path):
    for words, complaint in (
        (["UntangleLayer"], "Missing option '--policy'"),
        (["UntangleShirt", "--policy", "zero"], "no such environment; did you mean clothgym/UntangleLayers-v0?"),
        (["UntangleLayers", "--policy", "nobody"], "policy = 'nobody': expected one of zero, random, pull_apart"),
        (["UntangleLayers", "--policy", "policy.pkl"], "files of this kind are not loaded"),
        (
            ["UntangleLayers", "--policy", "zero", "--level", "mild"],
            "level = 'mild': expected one of easy, medium, hard",
        ),
        (["UntangleLayers", "--policy", "zero", "--fidelity", "best"], "fidelity = 'best'"),
        (["UntangleLayers", "--policy", "zero", "--episodes", "101"], "--episodes"),
        (["UntangleLayers", "--policy", "zero", "--jobs", "0"], "--jobs"),
        (["UntangleLayers", "--policy", "zero", "--out", str(tmp_path)], "s a directory"),
    ):
        code, out, err = say(*words)
        assert (code, out) == (2, ""), words
        assert complaint in err
        assert err.count("\n") == 1
        assert err.startswith("clothgym evaluate: ")
