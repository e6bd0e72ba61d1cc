"""`clothgym scenes`: the ready scenes; parameters and stages of one."""

from __future__ import annotations

import re
from typing import Annotated, Any

import typer

from clothgym.benchmarks.report import Table
from clothgym.commands import JsonOption, answer, reserved_stdout
from clothgym.commands.run import as_plain, read_fidelity, read_settings


def register(app: typer.Typer) -> None:
    """Adds the command."""
    app.command("scenes", help="Lists the ready scenes; with NAME the parameters, units and stages of one.")(scenes)


def scenes(
    name: Annotated[str | None, typer.Argument(help="A scene.", show_default=False)] = None,
    settings: Annotated[
        list[str] | None, typer.Option("--set", metavar="NAME=VALUE", help="A parameter, for the stages.")
    ] = None,
    fidelity: Annotated[str, typer.Option("--fidelity", metavar="F", help="A preset or a JSON file.")] = "balanced",
    as_json: JsonOption = False,
) -> None:
    with reserved_stdout(as_json):
        document, tables = _list() if name is None else _describe(name, settings or [], fidelity)
    answer(document, tables, as_json)


def _list() -> tuple[dict[str, Any], list[Table]]:
    import clothgym as cg

    found = [(name, cg.scenes.describe(name)) for name in cg.scenes.names()]
    document = {"scenes": [{"name": n, "text": d.text, "parameters": _parameters(d)} for n, d in found]}
    rows = [
        (n, _first_sentence(d.text), ", ".join(f"{p['name']}={p['default']}" for p in _parameters(d))) for n, d in found
    ]
    note = "more of one: clothgym scenes NAME; simulate it: clothgym run NAME"
    return document, [Table("Scenes", ("name", "what", "parameters"), rows, note)]


def _describe(name: str, settings: list[str], fidelity: str) -> tuple[dict[str, Any], list[Table]]:
    import clothgym as cg

    about = cg.scenes.describe(name)
    parameters = _parameters(about)
    simulation = cg.Simulation(cg.scenes.make(name, **read_settings(settings)), fidelity=read_fidelity(fidelity))
    stages = simulation.pipeline.describe()
    columns = ("name", "default", "unit", "low", "high", "choices", "meaning")
    document = {"name": name, "text": about.text, "parameters": parameters, "fidelity": fidelity, "stages": stages}
    tables = [
        Table(name, columns, [[p[c] for c in columns] for p in parameters], " ".join(about.text.split())),
        Table(f"Stages ({fidelity})", ("stage",), [[line] for line in str(stages).splitlines()]),
    ]
    return document, tables


def _parameters(about: Any) -> list[dict[str, Any]]:
    given = about.parameters.values() if isinstance(about.parameters, dict) else about.parameters
    names = ("name", "default", "unit", "low", "high", "choices", "meaning")
    return [as_plain({name: getattr(parameter, name, ()) for name in names}) for parameter in given]


def _first_sentence(text: str) -> str:
    """What comes before the first full stop; sources in brackets are left out (they hold full stops of their own)."""
    return re.sub(r"\s*\[[^\]]*\]", "", " ".join(text.split())).partition(". ")[0].rstrip(".")
