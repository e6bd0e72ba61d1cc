"""Commands of the environments: `clothgym record` and `clothgym replay`."""

from __future__ import annotations

import difflib
import socket
import subprocess
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from clothgym.benchmarks.report import Table
from clothgym.commands import JsonOption, Stopped, answer, progress_bar, reserved_stdout


def register_record(app: typer.Typer) -> None:
    """Adds `record`."""
    app.command("record", help=_RECORD_HELP)(record)


def register_replay(app: typer.Typer) -> None:
    """Adds `replay`."""
    app.command("replay", help=_REPLAY_HELP)(replay)


_RECORD_HELP = """Runs one episode and writes it into a rerun file, with all it takes to simulate it again.

Look at it with `clothgym replay OUT.rrd --view`, check it with `clothgym replay OUT.rrd --verify`.
"""

_REPLAY_HELP = """Tells what a recording holds; with --verify, simulates it again and compares bit for bit.

Exit code: 0 equal (or nothing to compare), 1 differs, 2 no recording, or a damaged one.
"""


def record(
    env_id: Annotated[str, typer.Argument(metavar="ENV", help="An id such as clothgym/DressSleeve-v0.")],
    out: Annotated[Path, typer.Argument(metavar="OUT.rrd", help="The file to write.")],
    policy: Annotated[
        str,
        typer.Option(help="A policy by name (zero, random, a scripted one of the task) or a file of `clothgym train`."),
    ] = "zero",
    seed: Annotated[int, typer.Option(min=0, help="Seed of the episode.")] = 0,
    level: Annotated[str | None, typer.Option(help="easy, medium or hard.")] = None,
    fidelity: Annotated[str | None, typer.Option(help="draft, balanced or accurate.")] = None,
    steps: Annotated[int | None, typer.Option(min=1, help="Stop after this many steps.")] = None,
    view: Annotated[bool, typer.Option("--view", help="Also show it live (on the loopback).")] = False,
    as_json: JsonOption = False,
) -> None:
    with reserved_stdout(as_json):
        document = _record_episode(env_id, out, policy, seed, {"level": level, "fidelity": fidelity}, steps, view)
    names = ("file", "env_id", "policy", "seed", "steps", "return", "is_success", "progress", "ended", "size_kb")
    answer(document, [Table("Recorded", ("what", "value"), [(n, document.get(n)) for n in names])], as_json)


def replay(
    file: Annotated[Path, typer.Argument(metavar="FILE.rrd", help="A recording.")],
    verify: Annotated[bool, typer.Option("--verify", help="Simulate it again and compare bit for bit.")] = False,
    view: Annotated[bool, typer.Option("--view", help="Open it in rerun's viewer (on the loopback).")] = False,
    partial: Annotated[bool, typer.Option("--partial", help="Accept a file that was cut short; use what is whole.")] = (
        False
    ),
    as_json: JsonOption = False,
) -> None:
    from clothgym.recording.rerun_read import read_recording
    from clothgym_envs.recorder import read_episode
    from clothgym_envs.recorder import replay as simulate_again

    episode = None
    recording = read_recording(file, partial=partial)
    if "episode" in recording.documents:
        episode, recording = read_episode(recording, partial=partial)
    document = _summary(recording, episode)
    tables = [Table("Recording", ("what", "value"), [(n, v) for n, v in document.items() if not isinstance(v, dict)])]
    if verify:
        if episode is None:
            raise ValueError(f"{file}: holds no episode to verify (it was not written by RerunRecorder)")
        final = recording.positions(len(episode))
        with reserved_stdout(as_json), progress_bar("simulating again", max(len(episode), 1)) as advance:
            try:
                document["verify"] = simulate_again(episode, final, advance)
            except ValueError as error:
                raise ValueError(f"{file}: {error}") from error
        tables.append(_verify_table(document["verify"]))
    answer(document, tables, as_json)
    if view:
        _view(file)
    if verify and not document["verify"]["equal"]:
        raise typer.Exit(1)


def _record_episode(
    env_id: str, out: Path, policy_name: str, seed: int, choices: dict[str, str | None], steps: int | None, view: bool
) -> dict[str, Any]:
    """Plays one episode under the recorder; Ctrl-C keeps the finished steps."""
    import gymnasium as gym

    from clothgym_envs import evaluation
    from clothgym_envs.recorder import RerunRecorder

    if "{" in str(out) or "}" in str(out):
        raise ValueError(f"OUT.rrd = '{out}': braces may not stand in it")
    name = full_id(env_id)
    policy = evaluation.policy_maker(name, policy_name)()
    kwargs: dict[str, Any] = {k: v for k, v in choices.items() if v is not None}
    env = RerunRecorder(gym.make(name, **kwargs), out, spawn=view)
    horizon = steps or (env.spec.max_episode_steps if env.spec is not None else None) or 1000
    total, count, ended = 0.0, 0, "cut" if steps else "running"
    try:
        with progress_bar(f"recording {name}", horizon) as advance:
            observation, info = env.reset(seed=seed)
            policy.reset(env)
            while steps is None or count < steps:
                observation, reward, terminated, truncated, info = env.step(policy.act(observation, info))
                total, count = total + float(reward), count + 1
                advance(count, f"return {total:.2f}")
                if terminated or truncated:
                    ended = "terminated" if terminated else "truncated"
                    break
    except KeyboardInterrupt:
        raise Stopped(f"stopped: {count} steps are in {out}") from None
    finally:
        env.close()
    return {
        "file": str(out),
        "env_id": name,
        "policy": policy_name,
        "seed": seed,
        "episode_seed": info.get("episode_seed", seed) if count else seed,
        "steps": count,
        "return": total,
        "is_success": bool(info.get("is_success", False)) if count else False,
        "progress": float(info.get("progress", 0.0)) if count else 0.0,
        "failure": int(info.get("failure", 0)) if count else 0,
        "ended": ended,
        "size_kb": round(out.stat().st_size / 1e3, 1),
    }


def full_id(name: str) -> str:
    """A registered id from what the user typed: with or without the prefix and the version."""
    import gymnasium as gym

    import clothgym_envs  # noqa: F401  (registers the ids)

    known = sorted(i for i in gym.registry if i.startswith("clothgym/"))
    for candidate in (name, f"clothgym/{name}", f"{name}-v0", f"clothgym/{name}-v0"):
        if candidate in known:
            return candidate
    near = difflib.get_close_matches(f"clothgym/{name.removeprefix('clothgym/')}", known, n=1, cutoff=0.4)
    hint = f"did you mean {near[0]}?" if near else f"expected one of {', '.join(known)}"
    raise ValueError(f"ENV = {name!r}: no such environment; {hint}")


def _summary(recording: Any, episode: Any) -> dict[str, Any]:
    """What a file holds, as plain values."""
    last = int(recording.steps[-1]) if len(recording.steps) else 0
    document: dict[str, Any] = {
        "file": str(recording.path),
        "complete": recording.complete,
        "blueprint": recording.has_blueprint,
        "last_step": last,
        "simulated_seconds": round(float(recording.sim_time[-1]), 6) if len(recording.steps) else 0.0,
        "vertices": sum(track.positions.shape[1] for track in recording.cloths.values()),
        "cloths": list(recording.cloths),
        "bodies": list(recording.bodies),
        "scalars": sorted(recording.scalars),
        "size_kb": round(recording.path.stat().st_size / 1e3, 1),
    }
    if episode is not None:
        document |= {
            "env_id": episode.env_id,
            "kwargs": episode.kwargs,
            "episode_seed": episode.episode_seed,
            "options": episode.options,
            "actions": len(episode),
            "return": float(episode.rewards.sum()),
            "terminated": episode.terminated,
            "truncated": episode.truncated,
            "failure": episode.failure,
            "obstacles": list(episode.obstacles),
            "versions": episode.versions,
        }
    return document


def _verify_table(result: dict[str, Any]) -> Table:
    rows: list[tuple[str, Any]] = [("equal, bit for bit", result["equal"]), ("steps compared", result["steps"])]
    difference = result["first_difference"]
    if difference is not None:
        rows.append(("first step that differs", difference["step"]))
        rows.append((f"{difference['what']}: recorded", difference["recorded"]))
        rows.append((f"{difference['what']}: now", difference["now"]))
    if result["fidelity_differs"]:
        rows.append(("fidelity", "is another one now"))
    rows += [(f"{name}: recorded, now", f"{a}, {b}") for name, (a, b) in result["differing_versions"].items()]
    return Table("Simulated again", ("what", "value"), rows)


def _view(file: Path) -> None:
    """Opens the viewer and waits until it is closed."""
    from clothgym.recording.rerun_read import viewer_command

    with socket.socket() as probe:  # a port of its own, so that a viewer of another run is left alone
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    code = subprocess.run(viewer_command(str(file.resolve()), port=port), stdout=sys.stderr, check=False).returncode
    if code:
        raise ValueError(f"--view: the viewer ended with exit code {code}; it needs a display and a graphics driver")
