"""Errors that a user may want to catch."""

from __future__ import annotations


class SimulationError(RuntimeError):
    """A run diverged. The last finite state is kept in the simulation.

    Attributes:
        stage: the stage after which it was noticed.
        quantity: what went out of bounds.
        time: simulated time of the last finite state [s].
    """

    def __init__(self, stage: str, quantity: str, time: float, remedy: str) -> None:
        self.stage, self.quantity, self.time = stage, quantity, time
        super().__init__(f"{quantity} after stage {stage} at t = {time:.4f} s; {remedy}")


class MissingExtraError(ImportError):
    """An optional package is not installed; the message names the command that installs it."""

    def __init__(self, package: str, extra: str) -> None:
        super().__init__(f'{package} is not installed; install it with: pip install "clothgym[{extra}]"')
