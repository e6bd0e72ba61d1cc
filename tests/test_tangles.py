"""Tangles with known clean states: the promised kind at every depth, no intersection when clean, and a judge by sides."""

from __future__ import annotations

import numpy as np
import pytest

import clothgym as cg
from clothgym.model import ClothModel
from clothgym.scenes.canonical import KINDS, draw
from clothgym.scenes.hard import DRAWN

EXPECTED = {**{kind: {kind} for kind in KINDS}, "Cross": {"Cross"}}
HARD = (
    ("strip_through_sheet", {}),
    ("strip_through_sheet", {"uneven": 0.05}),
    ("waist", {}),
    ("crumple", {}),
    ("fold_corner", {}),
    ("folds", {}),
    ("folds", {"layers": 3, "depth": 1.0}),
    *(("figure_two", {"row": row}) for row in ("top", "middle", "bottom")),
    ("garment_layers", {}),
    ("garment_layers", {"layers": 3}),
)


def hits_of(tangle, positions):
    return cg.intersections(positions, ClothModel(tangle.scene).faces)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("depth", "resolution"), [(0.5, 12), (2.0, 16), (5.0, 24)])
def test_a_canonical_tangle_has_the_kind_that_it_is_called(kind, depth, resolution):
    for seed in range(3):
        drawn = draw(kind, depth, resolution, seed)
        found = hits_of(drawn, drawn.scene.start)
        assert {contour.kind for contour in found.contours} == EXPECTED[kind]
        assert len(found.contours) == (3 if kind == "Cross" else 1)
        assert hits_of(drawn, drawn.clean).hit_count == 0
        assert drawn.edge == pytest.approx(0.4 / resolution)


def test_depth_is_what_it_says():
    """Measured on what is drawn: how far the misplaced part lies behind the other surface."""
    for kind, of, behind in (("Closed", 1, 0), ("BBII", 1, 0)):
        for depth in (1.0, 3.0, 5.0):
            drawn = draw(kind, depth, 24, 4, uneven=False)
            sheets = [cloth.mesh for cloth in drawn.scene.cloths]
            flat = sheets[behind].vertices
            # the other sheet is flat but for a low wave
            centre = flat.mean(axis=0)
            normal = np.linalg.svd(flat - centre)[2][2]
            heights = (sheets[of].vertices - centre) @ normal
            normal_up = np.sign(np.median(heights)) if kind == "Closed" else np.sign(heights[np.abs(heights).argmax()])
            slant = 1.0
            if kind == "BBII":
                width = np.linalg.norm(np.ptp(sheets[of].vertices, axis=0))
                slant = np.ptp(heights) / (np.ceil(2.5 * depth) + 3 if depth > 1.0 else 8) / drawn.edge
                assert width > 0
            assert -(normal_up * heights).min() / drawn.edge == pytest.approx(depth * slant, abs=0.25)
    for depth in (0.5, 2.0, 7.0):  # two half-overlapping sheets: the contour is as long as they overlap
        drawn = draw("BIBI", depth, 24, 4, uneven=False)
        assert hits_of(drawn, drawn.scene.start).length / drawn.edge == pytest.approx(depth, rel=0.02)


@pytest.mark.parametrize(("name", "settings"), HARD)
def test_other_tangles_are_tangled_and_their_clean_states_are_not(name, settings):
    for seed in range(2):
        drawn = DRAWN[name](**settings, seed=seed)
        assert drawn.scene.name == name or name == "figure_two"
        assert hits_of(drawn, drawn.scene.start).hit_count > 2
        assert hits_of(drawn, drawn.clean).hit_count == 0
        assert drawn.right(drawn.clean)
        assert drawn.side_error(drawn.clean) == 0.0


@pytest.mark.parametrize("kind", ["Closed", "BBII", "BLI", "LL", "Cross"])
def test_the_judge_tells_wrong_sides(kind):
    drawn = draw(kind, 2.0, 16, 1)
    assert drawn.right(drawn.clean)
    assert not drawn.right(drawn.scene.start)
    assert 0.0 < drawn.side_error(drawn.scene.start) < 0.5
    assert sum(int(rule.misplaced.sum()) for rule in drawn.rules) > 5


def test_what_is_clean_on_the_wrong_side_is_not_right():
    """Pulled all the way through there is no hit either: contours say resolved, sides say wrong."""
    drawn = draw("BBII", 2.0, 16, 3)
    count = len(drawn.scene.cloths[0].mesh.vertices)
    through = drawn.scene.start.copy()
    way = drawn.clean[count:] - drawn.scene.start[count:]
    through[count:] -= 4.0 * way
    assert hits_of(drawn, through).hit_count == 0
    assert not drawn.right(through)
    assert drawn.side_error(through) > 0.5
    moved = drawn.clean.copy()
    moved[count:] += 2.0 * way
    assert drawn.right(moved)


def test_no_side_is_wrong_where_two_sheets_cross_half():
    for kind in ("BIBI", "Eight"):
        drawn = draw(kind, 2.0, 16, 0)
        assert drawn.rules == ()
        assert drawn.right(drawn.scene.start)
        assert drawn.side_error(drawn.scene.start) == 0.0


def test_too_coarse_for_so_deep_a_tangle():
    with pytest.raises(ValueError, match=r"canonical\.depth = 20: takes a resolution of at least 44, got 16"):
        cg.scenes.make("canonical", depth=20.0, resolution=16)
    cg.scenes.make("canonical", kind="Closed", depth=20.0, resolution=44)


def test_the_strip_has_no_gradient_along_itself():
    from clothgym.benchmarks.untangling import instances

    found = instances.null({"tangle": "strip_through_sheet", "settings": {}, "seed": 0})
    assert found["hits"] > 10
    assert max(found["coherence"]) <= 1e-12
    uneven = instances.null({"tangle": "strip_through_sheet", "settings": {"uneven": 0.05}, "seed": 0})
    assert max(uneven["coherence"]) > 1e-4
    half = {"kind": "BIBI", "depth": 3.0, "resolution": 16}
    assert instances.null({"tangle": "canonical", "settings": half, "seed": 0})["coherence"][0] > 0.5
