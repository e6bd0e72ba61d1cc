"""How a recording is laid out in the viewer, and how its entities are named."""

from __future__ import annotations

from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from clothgym.recording.rerun_viewer import import_rerun


def blueprint(bounds: tuple[ArrayLike, ArrayLike] | None = None) -> Any:
    """The layout that is stored in each file: the scene beside time series of what matters."""
    import_rerun()
    import rerun.blueprint as rrb

    eye = None
    if bounds is not None:
        low, high = (np.asarray(b, dtype=float) for b in bounds)
        middle, size = (low + high) / 2, max(float(np.linalg.norm(high - low)), 0.1)
        eye = rrb.EyeControls3D(
            position=middle + size * np.array([0.55, 0.45, 1.0]), look_target=middle, eye_up=(0.0, 1.0, 0.0)
        )
    left, right = rrb.Corner2D.LeftTop, rrb.Corner2D.RightTop
    plots = [
        ("contour length [m]", right, ["metrics/contour_length"]),
        ("reward", left, ["metrics/reward", "metrics/reward/**"]),
        ("largest strain", right, ["metrics/max_strain"]),
        ("progress", left, ["metrics/progress", "metrics/is_success"]),
        ("everything", right, ["metrics/**"]),
        ("force [N]", right, ["metrics/force_max"]),
        ("penetration [m]", right, ["metrics/penetration_depth"]),
    ]
    series: list[Any] = [
        rrb.TimeSeriesView(name=name, origin="/", contents=paths, plot_legend=corner) for name, corner, paths in plots
    ]
    views, others = series[:4], series[4:]
    others.append(rrb.TextDocumentView(name="episode", origin="clothgym/episode"))
    scene = rrb.Spatial3DView(name="scene", origin="world", eye_controls=eye)
    side = rrb.Vertical(*views, rrb.Tabs(*others))
    return rrb.Blueprint(
        rrb.Horizontal(scene, side, column_shares=[2, 1]),
        rrb.TimePanel(state="collapsed", timeline="sim_time"),
        collapse_panels=True,
    )


def ground_mesh(height: float, bounds: tuple[ArrayLike, ArrayLike] | None = None) -> Any:
    """A Mesh3D that lies level at a height [m], somewhat wider than what should be in view."""
    low, high = (np.zeros(3), np.ones(3)) if bounds is None else (np.asarray(b, float) for b in bounds)
    middle, half = (low + high) / 2, 0.75 * float(np.max(high - low)) + 0.25
    corners = [(middle[0] + a * half, height, middle[2] + b * half) for a, b in ((-1, -1), (-1, 1), (1, 1), (1, -1))]
    return import_rerun().Mesh3D(
        vertex_positions=corners,
        triangle_indices=[(0, 1, 2), (0, 2, 3)],
        vertex_normals=[(0, 1, 0)] * 4,
        albedo_factor=[96, 100, 106, 255],
    )


def entity_part(rr: ModuleType, name: str) -> str:
    """One part of an entity path; what would separate parts is escaped."""
    if not str(name).isprintable() or not str(name) or "\\" in str(name):
        raise ValueError(f"name = {name!r}: a recorded thing needs a printable name without a backslash")
    return str(rr.escape_entity_path_part(str(name)))
