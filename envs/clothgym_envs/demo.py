"""`clothgym demo`: the tour. Leaves recordings, pictures and one HTML page that says what was measured."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

import clothgym as cg
from clothgym.benchmarks.report import Page, Table
from clothgym.commands import JsonOption, answer, progress_bar, reserved_stdout, say

STRATEGIES = ("none", "local", "global", "hybrid")
SQUARE_STEPS, SQUARE_FRAMES = 25, (0, 5, 12, 25)
SHELL_STEPS, SHELL_FRAMES = 60, (0, 4, 12, 60)
_ENV = "clothgym/UntangleLayers-v0"
_SEED = 20_001


def register(app: typer.Typer) -> None:
    """Adds `demo`."""
    app.command("demo", help=_HELP)(demo)


_HELP = """The tour: 25 tangled squares under four strategies, two shells on a torso pushed through each other, one scripted
episode of UntangleLayers, recorded and replayed.

Leaves recordings (.rrd), pictures and one page, index.html, in logs/demo.
"""


def demo(
    out: Annotated[Path, typer.Option(help="Folder for everything the tour leaves.")] = Path("logs/demo"),
    jobs: Annotated[int, typer.Option(min=1, max=64, help="Processes for the four strategies.")] = 2,
    as_json: JsonOption = False,
) -> None:
    started = time.perf_counter()
    with reserved_stdout(as_json):
        out.mkdir(parents=True, exist_ok=True)
        first = _first_picture(out)
        say(f"first picture after {time.perf_counter() - started:.1f} s: {first}")
        with progress_bar("demo", 4) as advance:
            advance(0, "squares")
            squares = _squares(out, jobs)
            advance(1, "torso shells")
            shells = _shells(out)
            advance(2, "episode")
            episode = _episode(out)
            advance(3, "page")
            page = _page(out, squares, shells, episode)
        seconds = time.perf_counter() - started
    document = {
        "page": str(page),
        "squares": [{k: v for k, v in s.items() if k != "pictures"} for s in squares],
        "shells": {k: v for k, v in shells.items() if k != "pictures"},
        "episode": {k: v for k, v in episode.items() if k != "pictures"},
        "seconds": seconds,
    }
    answer(document, [_square_table(squares), _shell_table(shells), _episode_table(episode)], as_json)
    say(f"done in {seconds:.1f} s; open {page}")
    for name in sorted(p.name for p in out.glob("*.rrd")):
        say(f"  clothgym replay {out / name} --view")


def _first_picture(out: Path) -> Path:
    """The tangled squares before anything moves."""
    from clothgym.recording import frames, pictures

    simulation = cg.Simulation(cg.scenes.make("squares"), dataclasses.replace(_fidelity("none")))
    path = out / "squares_start.png"
    frames.save_png(path, pictures.draw(simulation, _square_camera(), 640, 480, antialias=2))
    return path


def _fidelity(strategy: str) -> cg.Fidelity:
    return dataclasses.replace(cg.Fidelity.preset("balanced"), untangling=strategy)


def _square_camera() -> Any:
    from clothgym.recording.frames import Camera

    return Camera((2.0, 1.6, 2.8), (0.0, 0.62, 0.0))


def _watch(
    simulation: cg.Simulation,
    steps: int,
    shown: tuple[int, ...],
    camera: Any,
    recording: Path | None,
    measure: Callable[[cg.Simulation], dict[str, float]] | None = None,
) -> dict[str, Any]:
    """Runs a scene and keeps its history, pictures and, where rerun is installed, a recording."""
    from clothgym.recording import pictures

    log = _recording(recording)
    history: dict[str, list[float]] = {}
    images: list[tuple[np.ndarray, str]] = []
    seconds = 0.0
    if log is not None:
        log.open_simulation(simulation)
    try:
        for step in range(steps + 1):
            if step > 0:
                started = time.perf_counter()
                simulation.step()
                seconds += time.perf_counter() - started
            metrics = simulation.metrics()
            values = {k: float(metrics[k]) for k in ("hits", "contour_count", "contour_length", "max_strain")}
            if measure is not None:
                values |= measure(simulation)
            for key, value in values.items():
                history.setdefault(key, []).append(value)
            if log is not None:
                log.log_simulation(step, simulation, scalars=values)
            if step in shown:
                caption = f"step {step}: {metrics['hits']} hits, {metrics['contour_length']:.2f} m"
                images.append((pictures.draw(simulation, camera, 360, 330, antialias=2), caption))
    finally:
        if log is not None:
            log.close()
    clean = [n for n, hits in enumerate(history["hits"]) if hits == 0]
    return {
        "history": history,
        "pictures": images,
        "first_clean_step": clean[0] if clean else None,
        "ms_per_step": 1e3 * seconds / steps,
    }


def _recording(path: Path | None) -> Any:
    """A recording, or None where rerun is not installed."""
    if path is None:
        return None
    try:
        from clothgym.recording.rerun_log import RerunLog

        return RerunLog(path)
    except cg.MissingExtraError:
        return None


def _square(strategy: str, out: Path) -> dict[str, Any]:
    simulation = cg.Simulation(cg.scenes.make("squares"), _fidelity(strategy))
    result = _watch(simulation, SQUARE_STEPS, SQUARE_FRAMES, _square_camera(), out / f"squares_{strategy}.rrd")
    return {"strategy": strategy} | result


def _squares(out: Path, jobs: int) -> list[dict[str, Any]]:
    from joblib import Parallel, delayed

    return list(Parallel(n_jobs=jobs)(delayed(_square)(s, out) for s in STRATEGIES))


def _shells(out: Path) -> dict[str, Any]:
    from clothgym.recording.frames import Camera
    from clothgym.scenes import shells

    simulation = cg.Simulation(cg.scenes.make("shells"), _fidelity("hybrid"))
    camera = Camera.framing(simulation.positions, direction=(0.5, 0.15, 1.0), aspect=360 / 330)

    def side(sim: cg.Simulation) -> dict[str, float]:
        return {"side_error": shells.side_error(np.array(sim.positions))}

    return _watch(simulation, SHELL_STEPS, SHELL_FRAMES, camera, out / "shells_hybrid.rrd", side)


def _episode(out: Path) -> dict[str, Any]:
    """One scripted episode, recorded, and simulated again from its recording."""
    import gymnasium as gym

    import clothgym_envs  # noqa: F401
    from clothgym_envs import policies

    env: Any = gym.make(_ENV, render_mode="rgb_array")
    path = out / "untangle_layers.rrd"
    recorded = _recording(path) is not None
    if recorded:
        from clothgym_envs.recorder import RerunRecorder

        env = RerunRecorder(env, path)
    policy = policies.get(_ENV, "pull_apart")
    observation, info = env.reset(seed=_SEED)
    policy.reset(env)
    images = [(env.render(), f"start: {info['hits']} hits")]
    total, steps, over = 0.0, 0, False
    while not over:
        observation, reward, terminated, truncated, info = env.step(policy.act(observation, info))
        total += float(reward)
        steps += 1
        over = terminated or truncated
        if steps % 12 == 0 or over:
            images.append((env.render(), f"step {steps}: {info['hits']} hits"))
    env.close()
    result: dict[str, Any] = {
        "policy": "pull_apart",
        "seed": _SEED,
        "steps": steps,
        "return": total,
        "is_success": info["is_success"],
        "side_error": info["side_error"],
        "pictures": images,
        "replay": "no recording: rerun is not installed",
    }
    if recorded:
        from clothgym_envs.recorder import read_episode, replay

        episode, recording = read_episode(path)
        again = replay(episode, recording.positions(int(recording.steps[-1])))
        result["replay"] = "equal bit for bit" if again["equal"] else f"differs: {again['first_difference']}"
    return result


# --- tables, plots, page ------------------------------------------------------------------------------------------------


def _square_table(squares: list[dict[str, Any]]) -> Table:
    rows = []
    for s in squares:
        length = s["history"]["contour_length"]
        rows.append(
            (
                s["strategy"],
                int(s["history"]["hits"][0]),
                int(s["history"]["contour_count"][0]),
                length[10] / length[0],
                s["first_clean_step"],
                int(s["history"]["hits"][-1]),
                max(s["history"]["max_strain"]),
                s["ms_per_step"],
            )
        )
    columns = (
        "strategy", "hits at start", "contours at start", "L/L0 at step 10", "first clean step",
        f"hits at step {SQUARE_STEPS}", "max strain", "ms a step",
    )  # fmt: skip
    return Table("25 squares [Volino 2006, Fig. 6]", columns, rows)


def _shell_table(shells: dict[str, Any]) -> Table:
    h = shells["history"]
    rows = [
        ("hits at start", int(h["hits"][0])),
        ("hits at the end", int(h["hits"][-1])),
        ("first clean step", shells["first_clean_step"]),
        ("wrong side at start", h["side_error"][0]),
        ("wrong side at the end", h["side_error"][-1]),
        ("max strain", max(h["max_strain"])),
        ("ms a step", shells["ms_per_step"]),
    ]
    return Table("Two shells on a torso, untangled (hybrid)", ("what", "value"), rows)


def _episode_table(episode: dict[str, Any]) -> Table:
    names = ("policy", "seed", "steps", "return", "is_success", "side_error", "replay")
    return Table(f"One episode of {_ENV}", ("what", "value"), [(n, episode[n]) for n in names])


def _history_plot(out: Path, squares: list[dict[str, Any]]) -> Path | None:
    try:
        from clothgym.benchmarks.machine import pyplot

        plt = pyplot()
    except cg.MissingExtraError:
        return None
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.4))
    for s in squares:
        length = np.array(s["history"]["contour_length"])
        axes[0].plot(length / length[0], label=s["strategy"])
        axes[1].plot(s["history"]["max_strain"], label=s["strategy"])
    axes[0].set(xlabel="step (0.01 s)", ylabel="contour length L / L0", ylim=(0, None))
    axes[1].set(xlabel="step (0.01 s)", ylabel="largest strain", ylim=(0, None))
    axes[0].legend()
    figure.tight_layout()
    path = out / "squares.png"
    figure.savefig(path, dpi=110)
    plt.close(figure)
    return path


def _page(out: Path, squares: list[dict[str, Any]], shells: dict[str, Any], episode: dict[str, Any]) -> Path:
    from clothgym.recording.frames import save_png, tile

    page = Page("clothgym demo")
    page.add_heading("25 tangled squares")
    page.add_text(
        "25 squares of 288 triangles are thrown into each other and fall. Blue lines are intersection contours. Without "
        "untangling they fall as a clump; look how the global and hybrid schemes clear them in the air."
    )
    page.add_table(_square_table(squares))
    plot = _history_plot(out, squares)
    if plot is not None:
        page.add_image(plot, "Contour length and strain over the steps, per strategy")
    for s in squares:
        sheet = tile([image for image, _ in s["pictures"]], [f"{s['strategy']} {c}" for _, c in s["pictures"]], 4)
        save_png(out / f"squares_{s['strategy']}.png", sheet)
        page.add_image(out / f"squares_{s['strategy']}.png", f"strategy {s['strategy']}")
    page.add_heading("Two shells on a torso")
    page.add_text(
        "Two layers of cloth around the torso of the CC0 body, the inner one pushed out through the outer one. Untangled "
        "is not enough: every vertex must come back to its own side."
    )
    page.add_table(_shell_table(shells))
    save_png(out / "shells.png", tile([i for i, _ in shells["pictures"]], [c for _, c in shells["pictures"]], 4))
    page.add_image(out / "shells.png", "hybrid scheme")
    page.add_heading("An episode of UntangleLayers")
    page.add_text("A scripted policy pinches the upper sheet at the contour, lifts it and drags it out.")
    page.add_table(_episode_table(episode))
    save_png(out / "episode.png", tile([i for i, _ in episode["pictures"]], [c for _, c in episode["pictures"]], 4))
    page.add_image(out / "episode.png", "policy pull_apart")
    recordings = sorted(p.name for p in out.glob("*.rrd"))
    page.add_text(
        "Recordings to open with clothgym replay FILE --view: " + ", ".join(recordings)
        if recordings
        else 'No recordings: install rerun with pip install "clothgym[rerun]".'
    )
    return page.write(out / "index.html")
