"""Wind: acceleration of every vertex, once a step."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from clothgym.model import ClothModel
from clothgym.stages.frame import Frame


class Wind:
    name = "wind"
    reads: tuple[str, ...] = ("positions", "velocities")
    writes: tuple[str, ...] = ("external",)

    def __init__(self, model: ClothModel) -> None:
        from clothgym.kernels.wind import wind_acceleration

        self.kernel: Callable[..., Any] = wind_acceleration
        self.wind = np.asarray(model.scene.wind, float)
        self.drag = model.scene.wind_drag

    def run(self, frame: Frame) -> None:
        if len(frame.external) == 0:
            frame.external = np.zeros((frame.model.vertex_count, 3))
        state, model = frame.state, frame.model
        self.kernel(
            state.positions,
            state.velocities,
            model.faces,
            model.inverse_masses,
            self.wind,
            self.drag,
            model.scene.step,
            frame.external,
        )
