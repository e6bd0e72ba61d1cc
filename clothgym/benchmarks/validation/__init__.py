"""`clothgym bench validation`: scenes with known answers, with every solver.

Each case measures quantities; each quantity has a measured value, a known answer from theory that no simulation enters, an
error, and mostly a target. Families are files here; `known` holds the answers.
"""

from __future__ import annotations

from clothgym.benchmarks.frame import Benchmark
from clothgym.benchmarks.validation.families import cases, prepare, run
from clothgym.benchmarks.validation.shown import plots, tables

__all__ = ["benchmark"]

_NOTES = (
    "Measured value, known answer and relative error (absolute where the answer is zero) of scenes that theory answers: "
    "oscillator, pendulum, hanging chain, hanging column, catenary, waves, cantilever, friction, rebound, drape, free flight. "
    "Solvers are named integrator+membrane, without a membrane they have springs. Targets: cantilever 1 %; pendulum, column, "
    "catenary 0.5 %; friction 2 %. 'Fails as predicted' marks answers that theory says a model must miss: the response of "
    "[Vassilev 2001] eq. 12 is no Coulomb friction and creeps down every slope; flexion springs do not resist small bending. "
    "Constants of lateral buckling are quoted from memory and carry no target. Quick runs have fewer cells and loads."
)

benchmark = Benchmark(
    name="validation",
    title="Scenes with known answers, by solver",
    cases=cases,
    run=run,
    tables=tables,
    plots=plots,
    prepare=prepare,
    notes=_NOTES,
)
