"""Sewing patterns: curves, the file format, and what is wrong with a file in one line."""

from __future__ import annotations

import copy
import json
import math
from itertools import pairwise

import garmentcode as gc
import numpy as np
import pytest
from scipy.integrate import quad
from scipy.spatial.transform import Rotation

from clothgym import pattern as patterns
from clothgym import wardrobe
from clothgym.pattern import Edge, Panel, Pattern, Seam

TRIANGLE = np.array([[0.1, 0.2], [0.5, 0.3], [0.2, 0.9]])


def one(curve: Edge) -> Panel:
    """A triangle whose first edge is curved."""
    return Panel("p", TRIANGLE, (curve, Edge((1, 2)), Edge((2, 0))))


def bezier(points: list[np.ndarray], t: float) -> np.ndarray:
    """Bernstein's form."""
    n = len(points) - 1
    return sum(math.comb(n, k) * t**k * (1 - t) ** (n - k) * p for k, p in enumerate(points))


def bezier_speed(points: list[np.ndarray], t: float) -> float:
    n = len(points) - 1
    legs = [n * (q - p) for p, q in pairwise(points)]
    return float(np.linalg.norm(bezier(legs, t)))


@pytest.mark.parametrize(
    ("kind", "params"),
    [
        ("quadratic", (0.3, -0.2)),
        ("quadratic", (0.5, -0.9)),
        ("cubic", (0.2, -0.3, 0.9, -0.1)),
        ("cubic", (0, -0.5, 1, 0.1)),
    ],
)
def test_bezier_edges_lie_and_measure_as_their_formula_says(kind, params):
    panel = one(Edge((0, 1), kind, params))
    start, end = TRIANGLE[:2]
    e = end - start
    left = np.array([-e[1], e[0]])
    control = [start, *(start + u * e + v * left for u, v in zip(params[::2], params[1::2])), end]
    t = np.linspace(0, 1, 11)
    assert panel.curve(0, t) == pytest.approx(np.array([bezier(control, s) for s in t]), abs=1e-15)
    length = quad(lambda s: bezier_speed(control, s), 0, 1, epsabs=1e-13)[0]
    assert panel.length(0) == pytest.approx(length, rel=1e-10)
    samples = panel.sample(0, 9)
    assert (samples[0] == start).all() and (samples[-1] == end).all()
    # the same arc length between neighbours, measured by quadrature at the parameters found by projection
    fine = panel.curve(0, np.linspace(0, 1, 20001))
    at = [((fine - p) ** 2).sum(axis=1).argmin() for p in samples]
    reached = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(fine, axis=0), axis=1))])[at]
    assert np.diff(reached) == pytest.approx(length / 9, rel=2e-3)


@pytest.mark.parametrize("large", [0, 1])
@pytest.mark.parametrize("right", [0, 1])
def test_circle_edges_are_arcs_on_the_named_side(large, right):
    radius = 0.25
    panel = Panel("p", [[0, 0], [0.3, 0], [0.15, 5 if right else -5]], (Edge((0, 1), "circle", (radius, large, right)),
                  Edge((1, 2)), Edge((2, 0))))  # fmt: skip
    small = 2 * math.asin(0.15 / radius)
    angle = 2 * math.pi - small if large else small
    assert panel.length(0) == pytest.approx(radius * angle, rel=1e-12)
    points = panel.sample(0, 12)
    assert np.linalg.norm(np.diff(points, axis=0), axis=1) == pytest.approx(2 * radius * math.sin(angle / 24), rel=1e-9)
    depth = radius * (1 - math.cos(angle / 2))
    assert points[6] == pytest.approx([0.15, -depth if right else depth], abs=1e-12)  # right of (1, 0) is -y
    rise = math.sqrt(radius**2 - 0.15**2)  # of the centre, from the chord towards the longer arc
    centre = [0.15, rise * (-1 if bool(right) == bool(large) else 1)]
    assert np.linalg.norm(points - centre, axis=1) == pytest.approx(radius, rel=1e-12)


def test_half_circle_with_a_rounded_radius():
    panel = Panel("p", [[0, 0], [0.2, 0]], (Edge((0, 1), "circle", (0.09999, 0, 1)), Edge((1, 0))))
    assert panel.length(0) == pytest.approx(0.1 * math.pi)
    assert panel.signed_area == pytest.approx(0.5 * math.pi * 0.01, rel=2e-3)


def test_outline_keeps_corners_direction_and_spacing():
    panel = Pattern.load("sleeveless_shirt").panel("back")
    outline = panel.outline(0.013)
    steps = np.linalg.norm(np.roll(outline, -1, axis=0) - outline, axis=1)
    assert steps.max() <= 0.013 + 1e-12
    assert steps.min() > 0.006
    for corner in panel.vertices:
        assert (outline == corner).all(axis=1).sum() == 1
    total = sum(panel.length(k) for k in range(len(panel.edges)))
    assert steps.sum() == pytest.approx(total, rel=2e-3)
    with pytest.raises(ValueError, match="spacing = 0: expected a positive length"):
        panel.outline(0)


def test_area_has_the_sign_of_the_loop():
    values = gc.document({"front": gc.rectangle(40, 50), "back": gc.rectangle(40, 50, clockwise=True)})
    pattern = Pattern.from_json(values)
    assert pattern.panel("front").signed_area == pytest.approx(0.2)
    assert pattern.panel("back").signed_area == pytest.approx(-0.2)


def test_placement_turns_about_x_then_y_then_z():
    turned = gc.document({"p": gc.rectangle(10, 20, rotation=[20, -35, 70], translation=[1, 2, 300])})
    panel = Pattern.from_json(turned).panel("p")
    points = np.array([[0.1, 0.0], [-0.3, 0.7]])
    oracle = Rotation.from_euler("xyz", [20, -35, 70], degrees=True).apply(np.column_stack([points, [0, 0]]))
    assert panel.placed(points) == pytest.approx(oracle + np.array([0.01, 0.02, 3.0]), abs=1e-15)
    assert panel.rotation_matrix @ panel.rotation_matrix.T == pytest.approx(np.eye(3), abs=1e-15)


def curved(scale: float) -> dict:
    s = scale
    curves = {
        0: {"type": "circle", "params": [30 * s, 0, 1]},
        1: {"type": "quadratic", "params": [[0.4, -0.1]]},
        2: {"type": "cubic", "params": [[0.3, -0.1], [0.7, -0.2]]},
    }
    return gc.panel([[0, 0], [40 * s, 0], [40 * s, 50 * s], [0, 50 * s]], curves, translation=[s, 2 * s, 3 * s])


def test_units_are_metres_whatever_the_file_has():
    shapes = [
        Pattern.from_json(gc.document({"p": curved(scale)}, units_in_meter=units)).panel("p")
        for scale, units in ((1, 100), (10, 1000), (0.01, 1), (100 / 2.54 / 100, 1 / 0.0254))
    ]
    for shape in shapes:
        assert shape.outline(0.01) == pytest.approx(shapes[0].outline(0.01), abs=1e-12)
        assert shape.translation == pytest.approx((0.01, 0.02, 0.03))


def test_old_and_absolute_spellings_of_curves_mean_the_same():
    square = [[0, 0], [40, 0], [40, 50], [0, 50]]
    relative = gc.panel(
        square, {1: {"type": "quadratic", "params": [[0.4, -0.1]]}, 2: curved(1)["edges"][2]["curvature"]}
    )
    bare = copy.deepcopy(relative)
    bare["edges"][1]["curvature"] = [0.4, -0.1]
    absolute = copy.deepcopy(relative)  # edge 1 is (0, 50), its left (-50, 0); edge 2 is (-40, 0), its left (0, -40)
    absolute["edges"][1]["curvature"] = {"type": "quadratic", "params": [[40 + 5, 20]]}
    absolute["edges"][2]["curvature"] = {"type": "cubic", "params": [[40 - 12, 50 + 4], [40 - 28, 50 + 8]]}
    expected = Pattern.from_json(gc.document({"p": relative})).panel("p").outline(0.01)
    for values, coords in ((bare, "relative"), (relative, None), (absolute, "absolute")):
        read = Pattern.from_json(gc.document({"p": values}, curvature_coords=coords))
        assert read.panel("p").outline(0.01) == pytest.approx(expected, abs=1e-15)
        again = Pattern.from_json(read.to_json())
        assert again.panel("p").outline(0.01) == pytest.approx(expected, abs=1e-14)


def everything() -> dict:
    values = gc.document(
        {"b": {**curved(1), "label": "body", "fabric": "denim"}, "a": gc.rectangle(40, 50)},
        [gc.stitch("a", 0, "b", 3), gc.stitch("a", 1, "b", 1, "right_wrong")],
        normalized_edge_loops=True,
    )
    values["pattern"]["panels"]["b"]["edges"][2].update(label="hem", fold=3)
    values["pattern"]["panel_order"] = ["a", "b"]
    values["pattern"]["title"] = "anything"
    values["parameters"] = {"length": {"value": 1, "range": [0.5, 2]}}
    values["parameter_order"] = ["length"]
    values["parameter_constraints"] = {"c": [1]}
    values["properties"]["normalize_panel_translation"] = False
    return values


def test_a_file_survives_reading_and_writing():
    values = everything()
    pattern = Pattern.from_json(values)
    assert [panel.name for panel in pattern.panels] == ["a", "b"]
    assert pattern.seams == (Seam("a", 0, "b", 3), Seam("a", 1, "b", 1, right_wrong=True))
    assert pattern.panel("b").edges[2].label == "hem" and pattern.panel("b").label == "body"
    assert pattern.to_json() == values
    assert Pattern.from_json(json.dumps(values)).to_json() == values


def test_save_and_load(tmp_path):
    target = tmp_path / "thing_specification.json"
    Pattern.from_json(everything()).save(target)
    again = Pattern.load(target)
    assert again.name == "thing"
    assert again.to_json() == everything()
    assert Pattern.load(str(target)).to_json() == everything()


@pytest.mark.parametrize("name", ["shirt_mean", "dress_pencil"])
def test_foreign_files_survive_reading_and_writing(name):
    values = json.loads(gc.foreign(name).read_text())
    written = Pattern.load(gc.foreign(name)).to_json()

    def compare(a, b, path="file"):
        assert type(a) is type(b) or isinstance(a, int | float), path
        if isinstance(a, dict):
            assert a.keys() == b.keys(), path
            for key in a:
                compare(a[key], b[key], f"{path}.{key}")
        elif isinstance(a, list):
            assert len(a) == len(b), path
            for n, (x, y) in enumerate(zip(a, b)):
                compare(x, y, f"{path}[{n}]")
        elif isinstance(a, int | float) and not isinstance(a, bool):
            assert b == pytest.approx(a, rel=1e-12, abs=1e-12), path
        else:
            assert a == b, path

    compare(values, written)


def test_scaled_and_moved():
    pattern = Pattern.from_json(everything())
    for placement in (True, False):
        larger = pattern.scaled(1.5, placement=placement)
        for old, new in zip(pattern.panels, larger.panels):
            assert new.outline(0.015) == pytest.approx(1.5 * old.outline(0.01), abs=1e-12)
            factor = 1.5 if placement else 1.0
            assert new.translation == pytest.approx([factor * t for t in old.translation])
    assert larger.seams == pattern.seams
    moved = pattern.moved((0.1, -0.2, 0.3))
    point = np.array([[0.05, 0.07]])
    for old, new in zip(pattern.panels, moved.panels):
        assert new.placed(point) == pytest.approx(old.placed(point) + np.array([0.1, -0.2, 0.3]))
    with pytest.raises(ValueError, match="factor = -1: expected a positive number"):
        pattern.scaled(-1)
    with pytest.raises(ValueError, match="translation: nan is no finite number"):
        pattern.moved((0, math.nan, 0))


def test_patterns_of_the_package():
    assert set(patterns.names()) == set(wardrobe.NAMES) >= {"cuff", "skirt", "sleeveless_shirt"}
    for name in patterns.names():
        pattern = Pattern.load(name)
        assert pattern.name == name
        text = json.dumps(pattern.to_json())
        assert json.loads(text) == Pattern.from_json(text, name).to_json()
    with pytest.raises(ValueError, match="panel = 'sleeve': expected one of front, back"):
        Pattern.load("skirt").panel("sleeve")


# Crossing outlines, against a slow oracle


def segments_meet(p, q, r, s) -> bool:
    """Solves p + a (q - p) = r + b (s - r)."""
    matrix = np.column_stack([q - p, r - s])
    if abs(np.linalg.det(matrix)) < 1e-14:
        return False
    a, b = np.linalg.solve(matrix, r - p)
    return bool(0 <= a <= 1 and 0 <= b <= 1)


def test_crossings_agree_with_a_slow_search_on_random_polygons():
    rng = np.random.default_rng(5)
    crossing = 0
    for _ in range(300):
        n = int(rng.integers(4, 8))
        corners = rng.uniform(0, 1, (n, 2))
        after = np.roll(corners, -1, axis=0)
        expected = {
            (i, j)
            for i in range(n)
            for j in range(i + 2, n)
            if (i, j) != (0, n - 1) and segments_meet(corners[i], after[i], corners[j], after[j])
        }
        edges = tuple(Edge((k, (k + 1) % n)) for k in range(n))
        if expected:
            crossing += 1
            with pytest.raises(ValueError, match="outline crosses itself: edges") as caught:
                Panel("p", corners, edges)
            named = tuple(int(word) for word in str(caught.value).split() if word.isdigit())
            assert named in expected
        else:
            assert len(Panel("p", corners, edges).edges) == n
    assert 50 < crossing < 250


def test_curves_that_cross_are_found_and_near_ones_are_not():
    square = [[0, 0], [40, 0], [40, 50], [0, 50]]
    deep = {0: [0.5, 2.6]}  # the curve reaches 1.3 x 40 = 52 > 50
    with pytest.raises(ValueError, match="panel 'p': the outline crosses itself: edges 0 and 2 cross"):
        Pattern.from_json(gc.document({"p": gc.panel(square, deep)}))
    assert Pattern.from_json(gc.document({"p": gc.panel(square, {0: [0.5, 2.4]})})).panels
    loop = {0: {"type": "cubic", "params": [[2.0, 0.8], [-1.0, 0.8]]}}
    with pytest.raises(ValueError, match="edge 0 crosses itself"):
        Pattern.from_json(gc.document({"p": gc.panel(square, loop)}))


# Bad files


def broken(change) -> dict:
    values = gc.document(
        {"front": gc.rectangle(40, 50), "back": gc.rectangle(40, 50, clockwise=True)},
        [gc.stitch("front", 1, "back", 3), gc.stitch("front", 3, "back", 1)],
    )
    change(values, values["pattern"]["panels"]["front"], values["pattern"]["stitches"])
    return values


def _set(path, value):
    def change(values, front, stitches):
        target = {"front": front, "stitches": stitches, "all": values}[path[0]]
        for key in path[1:-1]:
            target = target[key]
        if value is KeyError:
            del target[path[-1]]
        else:
            target[path[-1]] = value

    return change


BAD = [
    (_set(("stitches", 1, 0, "panel"), "sleeve"), "stitch 1: no panel 'sleeve'; there are front, back"),
    (_set(("stitches", 1, 1, "edge"), 7), "stitch 1: panel 'back' has no edge 7, only 0 to 3"),
    (_set(("stitches", 1, 1, "edge"), -1), "stitch 1: panel 'back' has no edge -1, only 0 to 3"),
    (_set(("stitches", 1, 1, "edge"), 1.5), "stitch 1: edge: 1.5 is no index"),
    (_set(("stitches", 1, 1, "edge"), 3), "stitch 1: panel 'back': edge 3 is sewn already by stitch 0"),
    (_set(("stitches", 0), gc.stitch("front", 1, "front", 1)), "stitch 0: panel 'front': edge 1 is sewn to itself"),
    (_set(("stitches", 0), gc.stitch("front", 1, "back", 3, "sideways")), "stitch 0: 'sideways': expected right_wrong"),
    (_set(("stitches", 0), [{"panel": "front"}, {}]), "stitch 0: edge is missing"),
    (_set(("stitches", 0), "front"), "stitch 0: expected a list, got str"),
    (_set(("front", "edges", 2, "endpoints"), [2, 1]), "panel 'front': the outline is open: edge 2 ends at vertex 1, edge 3"),
    (_set(("front", "edges", 3, "endpoints"), [3, 9]), "panel 'front': edge 3: no vertex 9, only 0 to 3"),
    (_set(("front", "edges", 3, "endpoints"), [3]), "panel 'front': edge 3: endpoints: expected 2 vertex ids, got [3]"),
    (_set(("front", "edges", 3), KeyError), "panel 'front': the outline is open: edge 2 ends at vertex 3, edge 0 starts"),
    (_set(("front", "edges"), []), "panel 'front': 0 edges do not enclose an area"),
    (_set(("front", "vertices", 2), [-20.0, -25.0]), "panel 'front': the outline"),
    (_set(("front", "vertices", 1), [-20.0, -25.0]),
     "panel 'front': edge 0 has no length: it starts and ends at [-0.2, -0.25]"),
    (_set(("front", "vertices", 1), [-19.0, 40.0]), "panel 'front': the outline crosses itself: edges 0 and 2 cross"),
    (_set(("front", "vertices", 2), [20.0, -60.0]), "panel 'front': the outline"),
    (_set(("front", "vertices", 2), [20.0, math.nan]), "panel 'front': vertex 2: nan is no finite number"),
    (_set(("front", "vertices", 2), [20.0, "x"]), "panel 'front': vertex 2: 'x' is no finite number"),
    (_set(("front", "vertices", 2), [20.0]), "panel 'front': vertex 2: expected 2 numbers, got [20.0]"),
    (_set(("front", "translation"), [0, math.inf, 0]), "panel 'front': translation: inf is no finite number"),
    (_set(("front", "rotation"), KeyError), "panel 'front': rotation is missing"),
    (_set(("front", "edges", 1, "curvature"), {"type": "spiral", "params": [1]}),
     "panel 'front': edge 1: curvature type 'spiral': expected quadratic, cubic, circle"),
    (_set(("front", "edges", 1, "curvature"), {"type": "cubic", "params": [[0.5, 0.5]]}),
     "panel 'front': edge 1: cubic params: expected 4 numbers, got 2"),
    (_set(("front", "edges", 1, "curvature"), [0.5, math.nan]), "panel 'front': edge 1: quadratic params: nan is no finite"),
    (_set(("front", "edges", 1, "curvature"), {"type": "circle", "params": [10, 0, 1]}),
     "panel 'front': edge 1: no circle of radius 0.1 m joins points 0.5 m apart"),
    (_set(("front", "edges", 1, "curvature"), {"type": "circle", "params": [30, 2, 1]}),
     "panel 'front': edge 1: circle params (0.3, 2.0, 1.0): expected (radius > 0, large 0 or 1, right 0 or 1)"),
    (_set(("front", "edges", 1, "curvature"), 3), "panel 'front': edge 1: curvature: expected an object, got int"),
    (_set(("all", "properties", "units_in_meter"), KeyError), "properties: units_in_meter is missing"),
    (_set(("all", "properties", "units_in_meter"), 0), "properties: units_in_meter = 0: expected a positive number"),
    (_set(("all", "properties", "units_in_meter"), "cm"), "properties: units_in_meter: 'cm' is no finite number"),
    (_set(("all", "properties", "curvature_coords"), "polar"), "properties: curvature_coords = 'polar': expected relative"),
    (_set(("all", "pattern", "panel_order"), ["hood"]), "panel_order: no panel 'hood'; there are front, back"),
    (_set(("all", "pattern", "panels"), {}), "a pattern needs at least one panel"),
    (_set(("all", "pattern", "panels"), KeyError), "pattern: panels is missing"),
    (_set(("all", "pattern"), KeyError), "not a pattern: pattern is missing"),
]  # fmt: skip


@pytest.mark.parametrize(("change", "message"), BAD, ids=[message[:60] for _, message in BAD])
def test_bad_files_are_named_in_one_line(tmp_path, change, message):
    file = gc.write(tmp_path / "bad.json", broken(change))
    with pytest.raises(ValueError) as caught:
        Pattern.load(file)
    assert str(caught.value).startswith(f"{file}: {message}")
    assert "\n" not in str(caught.value)


def test_files_that_are_no_patterns(tmp_path):
    file = tmp_path / "x.json"
    for text, message in (("{", "not valid JSON: "), ("[1]", "not a pattern: expected an object, got list")):
        file.write_text(text)
        with pytest.raises(ValueError) as caught:
            Pattern.load(file)
        assert str(caught.value).startswith(f"{file}: {message}")
    file.write_bytes(b"\xff\xfe\x00picture")
    with pytest.raises(ValueError, match=r"x\.json: not valid JSON: not a text file"):
        Pattern.load(file)
    with pytest.raises(FileNotFoundError, match="no such pattern file, and none of cuff, dress, scarf"):
        Pattern.load(tmp_path / "absent.json")
    with pytest.raises(FileNotFoundError, match="cloak"):
        Pattern.load("cloak")
