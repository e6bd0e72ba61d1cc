"""Bodies that move: their maps are drawn anew for each step [Vassilev 2001, section 5]."""

from __future__ import annotations

from typing import Any

from clothgym.body import joined_at
from clothgym.scene import Scene
from clothgym.stages.frame import Frame


class MoveBodies:
    """Puts the bodies where they are at the end of the step: cloth is pushed aside before it would be passed."""

    name = "move bodies"
    reads: tuple[str, ...] = ()
    writes: tuple[str, ...] = ("bodies",)

    def __init__(self, scene: Scene, response: Any) -> None:
        self.scene, self.response = scene, response

    def run(self, frame: Frame) -> None:
        self.response.move(joined_at(self.scene.bodies, frame.state.time + self.scene.step))
