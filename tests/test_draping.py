"""From a pattern to a garment that is worn: placement, sewing, the worn test with retries, the drape and its report."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import garmentcode
import numpy as np
import pytest
import trimesh

import clothgym as cg
from clothgym import body as bodies
from clothgym.detection.body_maps import BodyMaps
from clothgym.dressing import draping, placement, sewing
from clothgym.garment import assemble
from clothgym.pattern import Pattern

COARSE = 0.03
LIMBS = {"skirt": ["legs", "legs"], "sleeveless_shirt": ["head", "left_arm", "right_arm", "legs"]}


@pytest.fixture(scope="module")
def woman() -> cg.Body:
    return bodies.load("female")


@pytest.fixture(scope="module", params=["skirt", "sleeveless_shirt"])
def draped(request: pytest.FixtureRequest, woman: cg.Body) -> cg.Draped:
    return cg.drape(request.param, woman, edge_length=COARSE)


def strains(garment, x: np.ndarray) -> np.ndarray:
    """Of every edge of every face against its own panel: no mean over a seam's two sides, unlike the report."""
    corners, flat = x[garment.faces], garment.rest_corners
    length = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
    return length / np.linalg.norm(flat - np.roll(flat, 1, axis=1), axis=2) - 1.0


def test_a_draped_garment_is_worn_clean_and_at_rest(draped: cg.Draped):
    report = draped.report
    assert report["worn"] and report["at_rest"]
    assert [o["expected"] for o in report["openings"]] == LIMBS[draped.garment.name]
    assert report["hits"] == 0 and report["contour_length"] == 0.0
    assert cg.intersections(draped.positions, draped.faces).hit_count == 0
    assert report["seam_strain_p99"] <= 0.10
    assert report["penetration_p999"] <= 1e-3 and report["penetration_max"] <= 3e-3
    assert report["shift"] == 0.0 and report["attempts"] == 1


def test_the_report_is_what_an_outsider_measures(draped: cg.Draped):
    x, report = draped.positions, draped.report
    assert np.percentile(np.abs(strains(draped.garment, x)), 99) <= 0.1
    skin = trimesh.Trimesh(draped.body.mesh.vertices, draped.body.mesh.faces, process=False)
    some = x[::11]
    nearest, distance, face = trimesh.proximity.closest_point_naive(skin, some)
    below = np.einsum("ij,ij->i", some - nearest, skin.face_normals[face]) < 0
    assert distance[below].max(initial=0.0) <= report["penetration_max"] + 1e-9
    assert distance.min() < 4e-3, "it touches"
    speeds = np.linalg.norm(draped.simulation.velocities, axis=1)
    assert speeds.mean() < 0.01


def test_it_stays_on_when_nobody_looks(draped: cg.Draped):
    """One second more: a garment that slides off slowly would show."""
    simulation = cg.Simulation(draped.simulation.scene, draped.simulation.fidelity)
    simulation.set_positions(draped.positions)
    before = draped.positions
    simulation.step(60)
    assert np.linalg.norm(simulation.positions - before, axis=1).mean() < 2e-3
    assert simulation.metrics()["hits"] == 0


def test_the_same_call_gives_the_same_bits(woman: cg.Body):
    hashes = {cg.drape("skirt", woman, edge_length=0.05, seconds=0.2).simulation.state_hash() for _ in range(2)}
    assert len(hashes) == 1


def test_placement_high_above_is_fitted(woman: cg.Body):
    """The pattern's own placement is somewhere else; without --fit the shirt does not even come near."""
    lost = Pattern.load("sleeveless_shirt").moved((0.3, 0.4, -0.2))
    fitted, notes = placement.fit(lost, woman)
    again, _ = placement.fit(Pattern.load("sleeveless_shirt"), woman)
    for a, b in zip(fitted.panels, again.panels):
        assert np.asarray(a.translation) == pytest.approx(np.asarray(b.translation), abs=2e-3)
    assert "moved by (-300, " in notes[0]
    assert not cg.drape(lost, woman, fit=False, edge_length=0.05, seconds=0.1).report["worn"]


def test_panels_inside_the_body_are_pushed_out(woman: cg.Body):
    pattern = Pattern.load("skirt")
    inside = dataclasses.replace(
        pattern, panels=tuple(dataclasses.replace(p, translation=(*p.translation[:2], 0.05)) for p in pattern.panels)
    )
    fitted, notes = placement.fit(inside, woman)
    surface = cg.Simulation(cg.scenes.make("draped", edge_length=0.08)).body_mesh
    points = np.concatenate(assemble(fitted, COARSE).panel_vertices)
    assert surface.signed_distance(points).min() > 0.01
    assert sum("out of the body" in note for note in notes) == 2


def test_retries_print_their_shift(woman: cg.Body, monkeypatch: pytest.MonkeyPatch):
    """A first lift of half a metre puts the shirt over the head: not worn, and the next one is tried."""
    monkeypatch.setattr(draping, "SHIFTS", (0.5, 0.0))
    told: list[str] = []
    result = cg.drape(
        "sleeveless_shirt",
        woman,
        edge_length=0.04,
        seconds=0.3,
        progress=lambda phase, done, total, text: told.append(text),
    )
    assert result.report["worn"] and result.report["attempts"] == 2 and result.report["shift"] == 0.0
    assert any("attempt 1, shift +500 mm: not worn after sewing" in note for note in result.notes)
    assert {"attempt 1, shift +500 mm", "attempt 2, shift +0 mm"} <= set(told)


def test_a_garment_that_falls_off_is_not_worn(woman: cg.Body, monkeypatch: pytest.MonkeyPatch):
    """A skirt 1.6 times as wide slides to the feet: closed, clean, both legs through it, and still not worn."""
    monkeypatch.setattr(draping, "SHIFTS", (0.0,))
    wide = Pattern.load("skirt").scaled(1.6, placement=False)
    at_waist, _ = placement._moved(wide, woman)
    result = cg.drape(at_waist, woman, fit=False, edge_length=0.06, seconds=1.5)
    assert all(opening["right"] for opening in result.report["openings"])
    assert not result.report["worn"]
    assert any("slid by" in note for note in result.notes)


def test_sewing_closes_without_hits_and_without_a_twist(woman: cg.Body):
    for name in LIMBS:
        fitted, _ = placement.fit(Pattern.load(name), woman)
        garment = assemble(fitted, 0.025)
        maps = BodyMaps([woman], 360, 0.015)
        x, _ = sewing.sew(garment, maps, 3e-3)
        assert cg.intersections(x, garment.faces).hit_count == 0
        assert np.percentile(np.abs(strains(garment, x)), 99) < 0.15
        low = garment.seam_vertices[x[garment.seam_vertices, 1] < 1.1]
        left, right = (low[side * x[low, 0] > 0.08] for side in (1, -1))
        assert abs(x[left, 2].mean() - x[right, 2].mean()) < 5e-3, f"{name} is turned around the body"
        assert abs(x[:, 0].mean()) < 5e-3


def test_opening_lengths_are_those_of_the_panels():
    skirt = Pattern.load("skirt")
    garment = assemble(skirt, 0.02)
    free = {(p.name, n) for p in skirt.panels for n in range(len(p.edges))}
    sewn = {(s.panel_a, s.edge_a) for s in skirt.seams} | {(s.panel_b, s.edge_b) for s in skirt.seams}
    border = sum(skirt.panel(panel).length(edge) for panel, edge in free - sewn)
    assert sum(sewing.opening_lengths(garment)) == pytest.approx(border, rel=2e-3)


def test_a_body_without_a_skeleton_can_wear_a_cuff():
    post = trimesh.creation.capsule(height=0.6, radius=0.03)
    post.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [0, 1, 0]))
    body = cg.Body(post, friction=0.5)
    result = cg.drape("cuff", body, fit=False, edge_length=0.02, seconds=0.4)
    assert result.report["worn"]
    assert [o["expected"] for o in result.report["openings"]] == ["body", "body"]
    beside = cg.Body(trimesh.Trimesh(post.vertices - np.array([0, 1, 0]), post.faces), name="beside")
    assert not cg.drape("cuff", beside, fit=False, edge_length=0.02, seconds=0.1).report["worn"]


def test_notes_of_the_body_reach_the_user(tmp_path: Path, woman: cg.Body):
    path = tmp_path / "woman.stl"
    trimesh.Trimesh(100.0 * woman.mesh.vertices, woman.mesh.faces[:, ::-1], process=False).export(path)
    result = cg.drape("skirt", path, edge_length=0.06, seconds=0.1)
    assert any("centimetres" in note for note in result.notes)
    assert any("turned" in note or "flipped" in note for note in result.notes)
    assert result.report["worn"]


def test_the_foreign_shirt_fits(woman: cg.Body):
    result = cg.drape(garmentcode.foreign("shirt_mean"), woman, edge_length=0.025)
    assert result.report["worn"] and result.report["at_rest"] and result.report["hits"] == 0
    assert result.report["penetration_max"] <= 3e-3


def test_bad_input_is_one_line(woman: cg.Body, tmp_path: Path):
    with pytest.raises(ValueError, match=r"seconds = -1"):
        cg.drape("skirt", woman, seconds=-1)
    with pytest.raises(ValueError, match="material"):
        cg.drape("skirt", woman, material="steel")
    with pytest.raises(ValueError, match="fidelity"):
        cg.drape("skirt", woman, fidelity="best")
    with pytest.raises(ValueError, match="edge_length"):
        cg.drape("skirt", woman, edge_length=0.0)
