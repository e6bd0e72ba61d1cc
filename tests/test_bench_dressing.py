"""`clothgym bench dressing` in little."""

from __future__ import annotations

import math

import pytest

from clothgym.benchmarks import dressing
from clothgym.benchmarks.dressing import collider


def row(**parameters):
    return {"key": str(parameters), "parameters": parameters, "result": dressing.run(parameters)}


@pytest.fixture(scope="module")
def rows():
    shared = {"kind": "accuracy", "body": "female", "pose": "a_pose", "map_size": 360}
    return [
        row(kind="draw", map_size=60, views="zy"),
        row(kind="ask", cuts=[1, 2]),
        *(row(**shared, views=views, form=form) for views, form in (("z", "face"), ("zy", "face"), ("z", "paper"))),
    ]


def test_planes_beat_depth_along_the_view_and_views_empty_what_is_not_filled(rows):
    planes, two, paper = (r["result"] for r in rows[2:])
    assert planes["shell_missed"] < 0.01 < 0.04 < paper["shell_missed"]
    assert planes["error_median"] < 1e-4 < paper["error_median"]
    assert planes["deep_missed"] == 0.0
    assert two["deep_missed"] == 0.0
    assert two["shell_missed"] < 0.01, "beside an arm before the trunk, what one pair takes for outside the other knows"
    assert two["filled"] < 0.5 * planes["filled"]
    assert planes["boxes_error"] < 1e-6, "the object-space collider is exact"


def test_every_case_has_its_place_in_the_tables(rows):
    for quick in (True, False):
        keys = [case.key for case in dressing.cases(quick)]
        assert len(set(keys)) == len(keys)
    shown = dressing.tables(rows)
    assert [table.title.split(",")[0] for table in shown] == [
        "Drawing the maps",
        "Asking for 10000 vertices",
        "Answers against exact distances",
        "Answers by region",
    ]
    assert all(isinstance(value, float) and math.isfinite(value) for value in shown[1].rows[0][1:])
    assert dressing.tables([]) == []


def test_the_paper_s_form_is_its_own_on_a_slab():
    """In front of something flat, depth along z is the distance."""
    import numpy as np
    import trimesh

    from clothgym.body import Body

    slab = trimesh.creation.box((1.0, 1.0, 0.1))
    points = np.array([[0.0, 0.1, 0.052], [0.2, 0.0, 0.057], [0.0, 0.0, -0.049], [0.503, 0.0, 0.0]])
    exact = np.array([0.002, 0.007, -0.001, 0.003])
    felt, error = collider._paper_answers(Body((slab.vertices, slab.faces)), 100, points, exact)
    assert felt.tolist() == [True, False, True, True]
    assert error[:3].max() < 1e-6
