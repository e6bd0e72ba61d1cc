"""One scripted episode of each task, recorded, and simulated again from its recording."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from clothgym.benchmarks.report import Table
from clothgym_envs.tour.section import Section, recording

SEED = 20_001
EPISODES = {
    "clothgym/UntangleLayers-v0": (
        "pull_apart",
        "A scripted policy pinches the upper sheet at the contour, lifts it and drags it out.",
        lambda info: f"{info['hits']} hits",
    ),
    "clothgym/DressRing-v0": (
        "axis",
        "A scripted policy pulls a sewn cuff over a limb: its opening follows the limb's axis.",
        lambda info: f"depth {info['depth']:.2f}",
    ),
}
"""Id -> scripted policy, what it does, what stands under a picture."""


def run(out: Path, env_id: str) -> Section:
    """An episode on a test seed."""
    import gymnasium as gym

    import clothgym_envs  # noqa: F401
    from clothgym_envs import policies

    name, text, caption = EPISODES[env_id]
    task = env_id.removeprefix("clothgym/").removesuffix("-v0")
    stem = "".join(f"_{c.lower()}" if c.isupper() else c for c in task).lstrip("_")
    env: Any = gym.make(env_id, render_mode="rgb_array")
    path = out / f"{stem}.rrd"
    recorded = recording(path) is not None
    if recorded:
        from clothgym_envs.recorder import RerunRecorder

        env = RerunRecorder(env, path)
    policy = policies.get(env_id, name)
    observation, info = env.reset(seed=SEED)
    policy.reset(env)
    pictures = [(env.render(), f"start: {caption(info)}")]
    total, steps, over = 0.0, 0, False
    while not over:
        observation, reward, terminated, truncated, info = env.step(policy.act(observation, info))
        total += float(reward)
        steps += 1
        over = terminated or truncated
        if steps % 12 == 0 or over:
            pictures.append((env.render(), f"step {steps}: {caption(info)}"))
    env.close()
    document: dict[str, Any] = {
        "env_id": env_id,
        "policy": name,
        "seed": SEED,
        "steps": steps,
        "return": total,
        "is_success": info["is_success"],
        "max_strain": info["max_strain"],
        "force_max": info["force_max"],
        "replay": _replayed(path) if recorded else "no recording: rerun is not installed",
    }
    rows = [(key, value) for key, value in document.items() if key != "env_id"]
    tables = [Table(f"One episode of {env_id}", ("what", "value"), rows)]
    return Section(f"An episode of {task}", text, document, tables, [(f"{stem}.png", f"policy {name}", pictures)])


def _replayed(path: Path) -> str:
    from clothgym_envs.recorder import read_episode, replay

    episode, recorded = read_episode(path)
    again = replay(episode, recorded.positions(int(recorded.steps[-1])))
    return "equal bit for bit" if again["equal"] else f"differs: {again['first_difference']}"
