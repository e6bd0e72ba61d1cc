"""The command `clothgym train`."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Annotated, Any

import typer

from clothgym.benchmarks.report import Table
from clothgym.commands import JsonOption, answer, progress_bar, reserved_stdout, say

_HELP = """Trains a policy with stable-baselines3 (extra rl) and keeps it, with its learning curve, in a folder.

The folder gets `policy.zip` (the last policy), `best.zip` (the best on the validation seeds: by success, then return),
`checkpoints/`, `config.json`, `curve.jsonl`, `curve.png` (with the extra plot). Score a policy on the test seeds with
`clothgym evaluate ENV --policy DIR/best.zip`.

The same options give the same policy on the same machine. Exit code: 0 done, 2 bad input, 130 stopped (the folder keeps
what was learnt; --resume goes on).
"""


def register(app: typer.Typer) -> None:
    """Adds the command."""
    app.command("train", help=_HELP)(train_command)


def train_command(
    env_id: Annotated[
        str, typer.Argument(metavar="ENV", help="An id such as clothgym/DressRing-v0, or module:Name-v0 of your own.")
    ],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder of the run.", show_default=False)],
    algo: Annotated[str | None, typer.Option(help="ppo (default), sac, td3 or a2c.", show_default=False)] = None,
    steps: Annotated[
        int | None, typer.Option(help="Environment steps (default 100000), rounded up to whole rollouts.")
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Of all that is drawn (default 0).")] = None,
    level: Annotated[str | None, typer.Option(help="easy (default), medium or hard.")] = None,
    fidelity: Annotated[str | None, typer.Option(help="draft (default), balanced or accurate.")] = None,
    envs: Annotated[
        int | None, typer.Option(help="Environments side by side (default 2); the result depends on it.")
    ] = None,
    every: Annotated[
        int | None, typer.Option(help="Steps between two validations (default a twentieth of steps, at least 1000).")
    ] = None,
    episodes: Annotated[int | None, typer.Option(help="Episodes of a validation (default 20).")] = None,
    overrides: Annotated[
        list[str] | None, typer.Option("--set", metavar="NAME=VALUE", help="Another hyperparameter; repeatable.")
    ] = None,
    subproc: Annotated[
        bool | None,
        typer.Option("--subproc/--no-subproc", help="A process per environment (default with more than one)."),
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with the run in DIR.")] = False,
    as_json: JsonOption = False,
) -> None:
    from clothgym_baselines.hyperparameters import parse_override
    from clothgym_baselines.training import train

    chosen = dict(parse_override(text) for text in overrides or [])
    name = _full_id(env_id)
    with reserved_stdout(as_json), contextlib.ExitStack() as stack:
        bar: list[Any] = []

        def started(run: dict[str, Any]) -> None:
            bar.append(stack.enter_context(progress_bar(f"{run['algo']} on {run['env_id']}", run["steps"])))

        result = train(
            name, out=out, algo=algo, steps=steps, seed=seed, level=level, fidelity=fidelity, envs=envs, every=every,
            episodes=episodes, overrides=chosen, processes=subproc, resume=resume, started=started, validated=_tell,
            advance=lambda done, text: bar[0](done, text),
        )  # fmt: skip
    document = {
        "folder": str(result.folder),
        "env_id": name,
        "steps": result.steps,
        "seconds": result.seconds,
        "best": result.best,
        "last": result.curve[-1],
        "digest": result.digest,
        "picture": None if result.picture is None else str(result.picture),
        "curve": result.curve,
    }
    answer(document, [_table(document)], as_json)
    if result.picture is None:
        say('curve.png was not drawn: matplotlib is not installed; install it with: pip install "clothgym[plot]"')


def _full_id(name: str) -> str:
    """An id of ours from what the user typed; one of another package, with its module before a colon, as it is."""
    from clothgym_envs.commands import full_id

    bare = name.removeprefix("clothgym_envs:")
    return bare if ":" in bare else full_id(bare)


def _tell(row: dict[str, Any]) -> None:
    low, high = row["success_interval"]
    say(
        f"{row['steps']:>9} steps {row['seconds']:8.0f} s   success {row['success']:.2f} [{low:.2f}, {high:.2f}]   "
        f"return {row['return']:.2f}"
    )


def _table(document: dict[str, Any]) -> Table:
    best, last = document["best"], document["last"]
    rows = [(name, last[name], best[name]) for name in ("steps", "seconds", "success", "return", "failures")]
    return Table(
        f"Trained on {document['env_id']}: {document['folder']}",
        ("validation", "last (policy.zip)", "best (best.zip)"),
        rows,
        f"Score it on the test seeds: clothgym evaluate {document['env_id']} --policy {document['folder']}/best.zip"
        if document["env_id"].startswith("clothgym/")
        else "",
    )
