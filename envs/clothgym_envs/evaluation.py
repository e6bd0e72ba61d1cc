"""How good is a policy: episodes on the test seeds, intervals, scores; and the command `clothgym evaluate`."""

from __future__ import annotations

import contextlib
import functools
import importlib.metadata
import json
import os
import signal
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from importlib import resources
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import ArrayLike

from clothgym.arrays import FloatArray, check_number
from clothgym.benchmarks.machine import SINGLE_THREAD, provenance
from clothgym.benchmarks.report import Table, to_json_text, write_atomically
from clothgym.commands import JsonOption, Stopped, answer, ctrl_c_between_steps, progress_bar, reserved_stdout
from clothgym.fidelity import Fidelity
from clothgym_envs import policies
from clothgym_envs.base import FAILURES, TEST_SEEDS

PEAKS = ("max_strain", "force_max", "penetration_depth")
"""Of these a row tells the largest of the episode, of everything else in info the last."""
_RESAMPLES = 2000
_BOOTSTRAP_SEED = 0

_HELP = """Scores a policy on the test seeds: success with its Wilson interval, progress, return, failures.

The score is 0 for the better of doing nothing and acting at random, 1 for the best scripted policy; a learner may pass 1.

Exit code: 0 done, 2 bad input, 130 stopped (--out keeps the finished episodes).
"""

PolicyMaker = Callable[[], policies.Policy]
POLICY_FILES = "clothgym.policies"
"""Entry-point group: what a file's name ends with (zip) -> a function that makes a policy from a path, and does not run
code out of the file."""


def register(app: typer.Typer) -> None:
    """Adds the command."""
    app.command("evaluate", help=_HELP)(evaluate_command)


# --- statistics -----------------------------------------------------------------------------------------------------


def wilson_interval(successes: int, count: int, z: float = 1.959963984540054) -> tuple[float, float]:
    """Wilson score interval of a rate; z of 1.96 gives 95 %.

    Raises:
        ValueError: no trials, or more successes than trials.
    """
    if count < 1 or not 0 <= successes <= count:
        raise ValueError(f"successes = {successes} of {count}: expected 0 to count, and at least one trial")
    rate, weight = successes / count, z * z / count
    middle = (rate + 0.5 * weight) / (1.0 + weight)
    half = z / (1.0 + weight) * np.sqrt(rate * (1.0 - rate) / count + 0.25 * weight / count)
    # at the ends rounding would leave the bound beside 0 or 1
    low = 0.0 if successes == 0 else middle - half
    high = 1.0 if successes == count else middle + half
    return float(low), float(high)


def interquartile_mean(values: ArrayLike) -> float:
    """Mean of the middle half: a quarter of the values (rounded down) is left out at each end."""
    ordered = np.sort(np.asarray(values, float), axis=-1)
    return float(_middle_mean(ordered))


def _middle_mean(ordered: FloatArray) -> Any:
    cut = ordered.shape[-1] // 4
    return ordered[..., cut : ordered.shape[-1] - cut].mean(axis=-1)


def bootstrap_interval(values: ArrayLike, statistic: str = "mean", seed: int = _BOOTSTRAP_SEED) -> tuple[float, float]:
    """95 % percentile interval of "mean" or "iqm" over 2000 resamples drawn with a seed.

    Raises:
        ValueError: no values, another statistic.
    """
    data = np.asarray(values, float)
    if data.ndim != 1 or len(data) == 0:
        raise ValueError(f"values: expected at least one number, got shape {data.shape}")
    if statistic not in ("mean", "iqm"):
        raise ValueError(f"statistic = {statistic!r}: expected one of mean, iqm")
    drawn = data[np.random.default_rng(seed).integers(0, len(data), (_RESAMPLES, len(data)))]
    results = drawn.mean(axis=1) if statistic == "mean" else _middle_mean(np.sort(drawn, axis=1))
    low, high = np.percentile(results, (2.5, 97.5))
    return float(low), float(high)


# --- scores ---------------------------------------------------------------------------------------------------------


@functools.cache
def reference_scores() -> dict[str, Any]:
    """The committed constants, keyed "id level fidelity": m_zero, m_ref, where they come from."""
    return json.loads(resources.files("clothgym_envs").joinpath("scores.json").read_text("utf-8"))["scores"]


def score(env_id: str, level: str, fidelity: str | Fidelity, progress: float) -> tuple[float | None, str]:
    """max(0, (m - m_zero) / (m_ref - m_zero)) for a mean final progress m, and where the constants come from; None and the
    reason where there are none."""
    name = fidelity if isinstance(fidelity, str) else "own"
    entry = reference_scores().get(f"{env_id.removeprefix('clothgym_envs:')} {level} {name}")
    if entry is None:
        return None, f"no reference is committed for level {level} at fidelity {name}"
    low, high = entry["m_zero"], entry["m_ref"]
    note = f"0 = {low['policy']} ({low['m']:.3f}), 1 = {high['policy']} ({high['m']:.3f}, {high['episodes']} episodes)"
    return max(0.0, (progress - low["m"]) / (high["m"] - low["m"])), note


# --- policies -------------------------------------------------------------------------------------------------------


def policy_maker(env_id: str, policy: str) -> PolicyMaker:
    """What makes a policy, by name or from a file; pickles.

    Raises:
        ValueError: no such environment or policy, a kind of file that is not loaded, a damaged file.
    """
    kind = Path(policy).suffix.removeprefix(".")
    if policy in policies.names(env_id) or not (kind or os.sep in policy):
        policies.get(env_id, policy)
        return functools.partial(policies.get, env_id, policy)
    loaders = {entry.name: entry for entry in importlib.metadata.entry_points(group=POLICY_FILES)}
    if kind not in loaders:
        expected = ", ".join([*policies.names(env_id), *(f"a .{name} file" for name in sorted(loaders))])
        raise ValueError(
            f"policy = {policy!r}: files of this kind are not loaded, since they could run code; expected one of {expected}"
        )
    maker = functools.partial(loaders[kind].load(), os.path.abspath(policy))  # workers may live in another folder
    maker()
    return maker


# --- episodes -------------------------------------------------------------------------------------------------------


def run_episode(
    env: Any, policy: policies.Policy, seed: int, after_step: Callable[[], None] = lambda: None
) -> dict[str, Any]:
    """Plays one episode.

    Returns:
        seed, return, steps, `reward/<name>` summed up, and what info told at the end (of `PEAKS`, the largest).
    """
    observation, info = env.reset(seed=seed)
    policy.reset(env)
    peaks = {name: float(info[name]) for name in PEAKS if name in info}
    terms = {name: 0.0 for name in info if name.startswith("reward/")}
    total, steps, over = 0.0, 0, False
    while not over:
        observation, reward, terminated, truncated, info = env.step(policy.act(observation, info))
        total, steps, over = total + float(reward), steps + 1, terminated or truncated
        peaks = {name: max(value, float(info[name])) for name, value in peaks.items()}
        terms = {name: value + float(info[name]) for name, value in terms.items()}
        after_step()
    last = {name: value for name, value in info.items() if not name.startswith("reward/") and name != "episode_seed"}
    return {"seed": int(seed), "return": total, "steps": steps} | last | peaks | terms


def evaluate(
    env_id: str,
    policy: str | PolicyMaker,
    seeds: Iterable[int] = TEST_SEEDS,
    level: str = "easy",
    fidelity: str | Fidelity = "draft",
    jobs: int = 1,
    progress: Callable[[dict[str, Any]], None] = lambda row: None,
    may_stop: Callable[[], None] = lambda: None,
) -> dict[str, Any]:
    """Plays one episode per seed; the result is the same for any number of jobs.

    Args:
        env_id: an id of this package.
        policy: name of a scripted policy, a file, or a function that makes one (for more than one job it must pickle).
        seeds: of the episodes.
        level, fidelity: of the environment.
        jobs: processes.
        progress: called with the row of each episode as it ends, in any order.
        may_stop: called often; may raise KeyboardInterrupt.

    Returns:
        What `summary` tells, and `rows` in the order of the seeds.

    Raises:
        ValueError: an unknown policy or environment, a bad seed, a seed given twice, no seeds.
    """
    chosen = [int(check_number(seed, "seed", 0, 2**63 - 1, integer=True)) for seed in seeds]
    if not chosen or len(set(chosen)) != len(chosen):
        raise ValueError(
            f"seeds: expected at least one, each once, got {len(chosen)} with {len(set(chosen))} different"
        )
    check_number(jobs, "jobs", 1, 1024, integer=True)
    maker = policy_maker(env_id, policy) if isinstance(policy, str) else policy
    maker()  # a wrong name or file is told before anything is simulated
    rows: dict[int, dict[str, Any]] = {}
    for row in _rows(env_id, maker, chosen, (level, fidelity), min(jobs, len(chosen)), may_stop):
        rows[row["seed"]] = row
        progress(row)
        may_stop()
    ordered = [rows[seed] for seed in chosen]
    return summary(env_id, ordered, level, fidelity) | {"rows": ordered}


def _rows(
    env_id: str,
    maker: PolicyMaker,
    seeds: Sequence[int],
    setup: tuple[str, str | Fidelity],
    jobs: int,
    may_stop: Callable[[], None],
) -> Iterator[dict[str, Any]]:
    """The rows as they come."""
    if jobs == 1:
        env = _environment(env_id, *setup)
        for seed in seeds:
            yield run_episode(env, maker(), seed, may_stop)
        return
    import joblib

    _environment(env_id, *setup)  # a wrong level is told here, not by a worker
    with joblib.parallel_config(backend="loky", n_jobs=jobs, inner_max_num_threads=1), single_threads():
        parallel = joblib.Parallel(return_as="generator_unordered", batch_size=1, pre_dispatch=jobs)
        results = parallel(joblib.delayed(_worker_episode)(env_id, maker, seed, setup) for seed in seeds)
        with contextlib.closing(results):
            yield from results


def _worker_episode(env_id: str, maker: PolicyMaker, seed: int, setup: tuple[str, str | Fidelity]) -> dict[str, Any]:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to handle
    return run_episode(_environment(env_id, *setup), maker(), seed)


@functools.lru_cache(maxsize=1)
def _environment(env_id: str, level: str, fidelity: str | Fidelity) -> Any:
    """Made once a process: an episode does not depend on those before it."""
    import gymnasium as gym

    return gym.make(f"clothgym_envs:{env_id.removeprefix('clothgym_envs:')}", level=level, fidelity=fidelity)


@contextlib.contextmanager
def single_threads() -> Iterator[None]:
    """Workers inherit one thread each: parallelism is over episodes."""
    before = {name: os.environ.get(name) for name in SINGLE_THREAD}
    os.environ.update(SINGLE_THREAD)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def summary(
    env_id: str, rows: Sequence[dict[str, Any]], level: str = "easy", fidelity: str | Fidelity = "draft"
) -> dict[str, Any]:
    """What rows of `run_episode` amount to. Failed episodes count like all others, and are counted.

    Returns:
        success (rate), success_interval (Wilson, 95 %), score (None without a committed reference), score_note, episodes,
        failures (count), failure_kinds (name -> count), metrics: name -> {mean, interval}, for the return also iqm and
        iqm_interval (bootstrap, 95 %), for peaks the largest.
    """
    successes = sum(bool(row["is_success"]) for row in rows)
    progress = [1.0 if row["is_success"] else float(row["progress"]) for row in rows]
    m = float(np.mean(progress))
    value, note = score(env_id, level, fidelity, m)
    metrics: dict[str, dict[str, Any]] = {"progress": {"mean": m, "interval": bootstrap_interval(progress)}}
    returns = [row["return"] for row in rows]
    metrics["return"] = {
        "mean": float(np.mean(returns)),
        "interval": bootstrap_interval(returns),
        "iqm": interquartile_mean(returns),
        "iqm_interval": bootstrap_interval(returns, "iqm"),
    }
    other = [name for name in rows[0] if _is_measure(name, rows[0][name])]
    for name in other:
        values = [float(row[name]) for row in rows]
        metrics[name] = {"mean": float(np.mean(values)), "interval": bootstrap_interval(values)}
        if name in PEAKS:
            metrics[name]["max"] = max(values)
    kinds = [FAILURES.get(row["failure"], str(row["failure"])) for row in rows if row["failure"]]
    return {
        "success": successes / len(rows),
        "success_interval": wilson_interval(successes, len(rows)),
        "score": value,
        "score_note": note,
        "episodes": len(rows),
        "failures": len(kinds),
        "failure_kinds": {kind: kinds.count(kind) for kind in sorted(set(kinds))},
        "metrics": metrics,
    }


def _is_measure(name: str, value: Any) -> bool:
    number = isinstance(value, int | float) and not isinstance(value, bool)
    return number and name not in ("seed", "return", "progress", "failure") and not name.startswith("reward/")


# --- the command ----------------------------------------------------------------------------------------------------


def evaluate_command(
    env_id: Annotated[str, typer.Argument(metavar="ENV", help="An id such as clothgym/UntangleLayers-v0.")],
    policy: Annotated[
        str,
        typer.Option(
            "--policy",
            metavar="NAME|FILE",
            help="zero, random, a scripted one of the task, or policy.zip of a training.",
        ),
    ],
    level: Annotated[str, typer.Option(help="easy, medium or hard.")] = "easy",
    fidelity: Annotated[str, typer.Option(help="draft, balanced or accurate.")] = "draft",
    episodes: Annotated[
        int, typer.Option(min=1, max=len(TEST_SEEDS), help="How many of the test seeds 20000 to 20099, from the first.")
    ] = len(TEST_SEEDS),
    jobs: Annotated[int, typer.Option(min=1, help="Processes; the result does not depend on it.")] = 1,
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="FILE.jsonl", help="Writes a line per episode as it ends.", show_default=False),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    with reserved_stdout(as_json):
        document = _evaluate_episodes(env_id, policy, level, fidelity, episodes, jobs, out)
    tables = [_result_table(document), _metrics_table(document)]
    failed = [row for row in document["rows"] if row["failure"]]
    if failed:
        rows = [(row["seed"], row["steps"], FAILURES.get(row["failure"], row["failure"])) for row in failed]
        tables.append(Table("Failed episodes (counted above)", ("seed", "steps", "failure"), rows))
    answer(document, tables, as_json)


def _evaluate_episodes(
    env: str, policy: str, level: str, fidelity: str, episodes: int, jobs: int, out: Path | None
) -> dict[str, Any]:
    from clothgym_envs.commands import full_id

    env_id = full_id(env)
    maker = policy_maker(env_id, policy)
    origin = provenance()
    started, rows = time.perf_counter(), []
    setup = {"env_id": env_id, "policy": policy, "level": level, "fidelity": fidelity}
    prefix = f"{env_id}/{policy}/{level}/{fidelity}"

    def line(row: dict[str, Any]) -> str:
        return to_json_text({"key": f"{prefix}/{row['seed']}"} | setup | row | origin) + "\n"

    with contextlib.ExitStack() as stack:
        may_stop = stack.enter_context(ctrl_c_between_steps())
        if out is not None:
            out.parent.mkdir(parents=True, exist_ok=True)
        file = None if out is None else stack.enter_context(out.open("w", encoding="utf-8"))
        bar = stack.enter_context(progress_bar(f"{policy} on {env_id}", episodes))

        def finished(row: dict[str, Any]) -> None:
            rows.append(row)
            if file is not None:
                file.write(line(row))
                file.flush()
            bar(len(rows), f"success {sum(r['is_success'] for r in rows)}/{len(rows)}")

        try:
            result = evaluate(env_id, maker, TEST_SEEDS[:episodes], level, fidelity, jobs, finished, may_stop)
        except KeyboardInterrupt:
            kept = f"; {len(rows)} are in {out}" if out is not None else "; --out FILE.jsonl would keep them"
            raise Stopped(f"stopped after {len(rows)} of {episodes} episodes{kept}") from None
    if out is not None:  # in the order of the seeds, whoever was first
        write_atomically(out, "".join(line(row) for row in result["rows"]).encode())
    return (
        setup | result | {"seconds": time.perf_counter() - started, "out": None if out is None else str(out)} | origin
    )


def _result_table(document: dict[str, Any]) -> Table:
    low, high = document["success_interval"]
    rows = [
        ("level, fidelity", f"{document['level']}, {document['fidelity']}"),
        ("episodes", document["episodes"]),
        ("success", f"{document['success']:.3f}  [{low:.3f}, {high:.3f}]"),
        ("failures", document["failures"]),
        ("score", document["score"]),
        ("seconds", document["seconds"]),
    ]
    return Table(
        f"{document['policy']} on {document['env_id']}", ("what", "value"), rows, f"score: {document['score_note']}"
    )


def _metrics_table(document: dict[str, Any]) -> Table:
    rows = []
    for name, values in document["metrics"].items():
        rows.append((name, values["mean"], *values["interval"], values.get("max")))
        if "iqm" in values:
            rows.append((f"{name}, interquartile mean", values["iqm"], *values["iqm_interval"], None))
    return Table("At the end of the episodes", ("metric", "mean", "95 % from", "to", "largest"), rows)
