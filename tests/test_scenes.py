"""The ready scenes: what their descriptions promise, and that bad parameters are named."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest

import clothgym as cg
from clothgym.model import FLEXION, SHEAR, STRUCTURAL, ClothModel

SMALL = {"hanging_sheet": {"resolution": 4}, "drop": {"resolution": 6}, "squares": {"count": 3, "cells": 6},
         "pile": {"count": 2}, "layers": {"vertices": 9}, "ribbon": {"length": 0.7},
         "faulty_detection": {"cells": 5, "layers": 2}}  # fmt: skip


def small(name: str) -> cg.Scene:
    return cg.scenes.make(name, **SMALL.get(name, {}))


def test_names_are_sorted_and_unique():
    names = cg.scenes.names()
    assert list(names) == sorted(set(names))
    assert {"hanging_sheet", "drop", "squares", "pile"} <= set(names)


@pytest.mark.parametrize("name", cg.scenes.names())
def test_descriptions_are_complete_and_true(name):
    described = cg.scenes.describe(name)
    assert described.name == name and len(described.text) > 20
    for parameter in described.parameters:
        assert parameter.meaning
        if parameter.choices:
            assert parameter.default in parameter.choices
        else:
            assert parameter.low <= parameter.default <= parameter.high
    import inspect

    taken = set(inspect.signature(cg.scenes._MAKERS[name]).parameters)
    assert {p.name for p in described.parameters} == taken, "a parameter that nobody can find or set"


@pytest.mark.parametrize("name", cg.scenes.names())
def test_scenes_are_reproducible_round_trip_and_run(name):
    scene = small(name)
    assert small(name) == scene
    assert cg.Scene.from_json(scene.to_json()) == scene
    assert scene.name == name and 0 < scene.step <= 0.05 and scene.duration > 0
    sim = cg.Simulation(scene, "draft")
    sim.step(2)
    assert np.isfinite(sim.positions).all()
    json.dumps(sim.metrics())


@pytest.mark.parametrize(
    "name", [n for n in cg.scenes.names() if "seed" in {p.name for p in cg.scenes.describe(n).parameters}]
)
def test_seeds_change_the_scene(name):
    start = [cg.scenes.make(name, **SMALL.get(name, {}), seed=seed).start for seed in (0, 0, 1)]
    assert np.array_equal(start[0], start[1])
    assert not np.array_equal(start[0], start[2])


def test_hanging_sheet_is_as_specified():
    n = 10
    scene = cg.scenes.make("hanging_sheet", resolution=n)
    model = ClothModel(scene)
    assert (scene.duration, scene.self_collision, scene.ground) == (2.0, False, None)
    assert scene.step == pytest.approx(1 / 60)
    assert model.masses == pytest.approx(0.15 / (n + 1) ** 2)
    assert model.damping == 0.5
    for kind, k in ((STRUCTURAL, 1e4), (SHEAR, 5e3)):
        assert set(model.spring_stiffness[model.spring_kinds == kind].tolist()) == {k}
    assert not (model.spring_kinds == FLEXION).any()
    rest, start = scene.cloths[0].rest, scene.start
    assert np.ptp(rest, axis=0) == pytest.approx([1.0, 0.0, 1.0])
    assert (start[:, [0, 2]] == rest[:, [0, 2]]).all()
    assert 0 < np.abs(start[:, 1]).max() <= 1e-3 / n
    pinned = rest[model.inverse_masses == 0]
    assert len(pinned) == 2
    assert set(np.abs(pinned[:, 0])) == {0.5} and len(set(pinned[:, 2])) == 1 and abs(pinned[0, 2]) == 0.5


def test_squares_are_tangled_as_described():
    """25 squares of about 300 triangles: more than 100 contours and 2000 hits "at most seeds" [Volino 2006, Fig. 6]."""
    found = []
    for seed in range(3):
        scene = cg.scenes.make("squares", seed=seed)
        hits = cg.intersections(scene.start, ClothModel(scene).faces)
        found.append((hits.contour_count > 100) and hits.hit_count > 2000)
        assert hits.contour_count > 60 and hits.hit_count > 1200
    assert len(scene.cloths) == 25
    assert all(len(c.mesh.faces) == 288 for c in scene.cloths)
    assert scene.start[:, 1].min() == pytest.approx(0.15)
    assert sum(found) >= 2
    model = ClothModel(scene)
    edges = np.linalg.norm(np.diff(scene.start[model.surface.edges], axis=1)[:, 0], axis=1)
    assert np.abs(edges / model.edge_rest - 1).max() < 0.05, "a square starts strained"


def test_pile_and_drop_start_clean():
    for name, settings in (
        ("pile", {}),
        ("pile", {"seed": 3, "gap": 0.005}),
        ("drop", {}),
        ("drop", {"resolution": 24}),
    ):
        scene = cg.scenes.make(name, **settings)
        assert cg.intersections(scene.start, ClothModel(scene).faces).hit_count == 0
        assert scene.start[:, 1].min() > scene.ground


def test_a_pile_of_three_falls_without_intersections():
    sim = cg.Simulation(
        cg.scenes.make("pile", count=3), dataclasses.replace(cg.Fidelity.preset("draft"), untangling="none")
    )
    for _ in range(35):
        sim.step()
        assert sim.last_intersections.hit_count == 0
    assert sim.positions[:, 1].max() < 0.05


@pytest.mark.parametrize(("name", "parameters", "said"), [
    ("hanging_shet", {}, ["hanging_shet", "hanging_sheet"]),
    ("hanging_sheet", {"resolution": 0}, ["hanging_sheet.resolution = 0", "[1, 512]"]),
    ("hanging_sheet", {"resolution": 2.5}, ["hanging_sheet.resolution = 2.5", "an integer"]),
    ("hanging_sheet", {"size": 1}, ["hanging_sheet.size", "known: resolution"]),
    ("squares", {"count": -1}, ["squares.count = -1", "[1, 400]"]),
    ("squares", {"box": "big"}, ["squares.box = 'big'", "[0.1, 100]"]),
    ("pile", {"gap": float("nan")}, ["pile.gap = nan"]),
    ("squares", {"seed": float("inf")}, ["squares.seed = inf"]),
])  # fmt: skip
def test_bad_parameters_are_named(name, parameters, said):
    with pytest.raises(ValueError) as error:
        cg.scenes.make(name, **parameters)
    for part in said:
        assert part in str(error.value)
