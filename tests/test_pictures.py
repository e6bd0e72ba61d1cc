"""Pictures of a simulation: cloth and bodies in their colours, all in view, nothing touched."""

from __future__ import annotations

import numpy as np
import pytest

import clothgym as cg
from clothgym.body import Body
from clothgym.recording import frames, pictures
from clothgym.recording.frames import Camera, Drawable, palette, render
from clothgym.recording.pictures import BODY_COLOUR, VIEWS, draw, draw_views, drawables

CORNERS = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
QUADS = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
FRONT = Camera((0.0, 0.0, 5.0), (0.0, 0.0, 0.0), orthographic_height=4.0)


def box(half: tuple[float, float, float], centre: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> tuple:
    faces = np.array([f for a, b, c, d in QUADS for f in ((a, b, c), (a, c, d))], np.int32)
    return CORNERS * half + centre, faces


def sheet(z: float, half: float = 0.4) -> cg.Cloth:
    """A square that faces +z."""
    x = np.array([(-half, -half, z), (half, -half, z), (half, half, z), (-half, half, z)])
    return cg.Cloth((x, np.array([(0, 1, 2), (0, 2, 3)], np.int32)), pins=[2, 3])


def simulation(*cloths: cg.Cloth, bodies: tuple = (), ground: float | None = None) -> cg.Simulation:
    named = [cg.Cloth(c.mesh, c.material, c.pins, name=f"cloth {n}") for n, c in enumerate(cloths)]
    return cg.Simulation(cg.Scene(named, bodies=bodies, ground=ground), fidelity="draft")


def hue(pixel: np.ndarray) -> np.ndarray:
    """A colour without its brightness."""
    return pixel / np.linalg.norm(pixel)


def assert_hue(pixel: np.ndarray, colour: tuple[float, float, float]) -> None:
    np.testing.assert_allclose(hue(pixel.astype(float)), hue(np.asarray(colour)), atol=0.02)


def test_the_body_is_pale_and_hides_and_is_hidden() -> None:
    """A box of 1 m between a cloth in front of it and one behind it."""
    body = Body(box((0.5, 0.5, 0.5)))
    behind = sheet(-1.0, half=0.9)
    drawn = draw(simulation(sheet(1.0, half=0.2), behind, bodies=(body,)), FRONT, 200, 200, contours=False)
    blue, orange = palette(2)
    assert_hue(drawn[100, 100], blue)
    assert_hue(drawn[100, 120], BODY_COLOUR)
    assert_hue(drawn[100, 140], orange)
    assert min(np.abs(hue(np.asarray(BODY_COLOUR)) - hue(np.asarray(c))).max() for c in palette(40)) > 0.03
    assert max(BODY_COLOUR) - min(BODY_COLOUR) < 0.1, "nearly grey"


def test_cloth_is_darker_on_its_back() -> None:
    world = simulation(sheet(0.0))
    light = [
        draw(world, Camera((0.0, 0.0, z), (0.0, 0.0, 0.0), orthographic_height=4.0), 50, 50, contours=False)[25, 25]
        for z in (5.0, -5.0)
    ]
    for pixel in light:
        assert_hue(pixel, palette(1)[0])
    assert light[1].sum() < 0.75 * light[0].sum()
    front = drawables(world)[0]._colours
    np.testing.assert_allclose(front[:, 3:], pictures.BACK_TONE * front[:, :3])


def test_the_default_camera_holds_cloth_and_bodies(monkeypatch: pytest.MonkeyPatch) -> None:
    used = []
    kept = frames.render
    monkeypatch.setattr(
        pictures, "render", lambda shapes, camera, *a, **k: used.append(camera) or kept(shapes, camera, *a, **k)
    )
    world = simulation(sheet(0.0), bodies=(Body(box((0.3, 0.3, 0.3), (2.0, 1.0, 0.0))),))
    image = draw(world, width=120, height=80)
    at = used[0].project(pictures.everything(world), 120, 80)
    assert len(at) == 4 + 8
    assert (at[:, 2] > 0).all()
    assert (at[:, :2] >= 0).all() and (at[:, 0] <= 120).all() and (at[:, 1] <= 80).all()
    assert np.ptp(at[:, 0]) > 80 or np.ptp(at[:, 1]) > 55, "and wastes little"
    assert image.shape == (80, 120, 3)


def test_what_does_not_move_is_prepared_once() -> None:
    body, other = Body(box((0.5, 0.5, 0.5))), Body(box((0.1, 0.1, 0.1), (0.9, 0.0, 0.0)))
    world = simulation(sheet(1.0), bodies=(body, other))
    first, second = drawables(world), drawables(world)
    assert [shape is again for shape, again in zip(first, second)] == [False, True, True]
    assert first[1].normals is second[1].normals
    assert first[1] is not first[2]
    fresh = [Drawable(b.mesh.vertices, b.mesh.faces, colour=BODY_COLOUR) for b in (body, other)]
    assert np.array_equal(render(second, FRONT, 80, 80), render([second[0], *fresh], FRONT, 80, 80))


def test_depth_sees_the_body() -> None:
    body = Body(box((0.5, 0.5, 0.5)))
    depth = draw(simulation(sheet(-1.0, half=0.9), bodies=(body,)), FRONT, 200, 200, depth=True)[:, :, 0]
    assert depth[100, 120] > depth[100, 140] > depth[100, 195] == 0


def test_views_show_front_back_and_side_at_one_scale() -> None:
    """A tall box with a nose towards +z and a cloth before its chest."""
    trunk, faces = box((0.25, 0.8, 0.15), (0.0, 0.8, 0.0))
    nose, more = box((0.04, 0.04, 0.1), (0.0, 1.4, 0.25))
    body = Body((np.concatenate([trunk, nose]), np.concatenate([faces, more + 8])))
    front_sheet = sheet(0.2, half=0.2)
    moved = cg.Cloth((front_sheet.mesh.vertices + np.array([0.0, 0.9, 0.0]), front_sheet.mesh.faces), pins=[2, 3])
    views = draw_views(simulation(moved, bodies=(body,)), width=120, height=180)
    assert list(views) == ["front", "back", "side"] == list(VIEWS)
    assert all(image.shape == (180, 120, 3) for image in views.values())
    blue = {name: bluish(image) for name, image in views.items()}
    assert blue["front"].sum() > 500 and blue["back"].sum() == 0
    assert blue["side"].sum() < 200, "the cloth is seen on its edge"
    tall = {name: np.ptp(np.flatnonzero(pale(image).any(axis=1))) for name, image in views.items()}
    assert min(tall.values()) > 0.7 * 180
    assert max(tall.values()) - min(tall.values()) <= 12, "what is nearer is a little larger"
    head, legs = (np.flatnonzero(pale(part).any(axis=0)) for part in np.split(views["side"], [90]))
    assert head[0] < legs[0] - 8, "from the side (+x) the nose is to the left"
    assert head[-1] <= legs[-1] + 1


def bluish(image: np.ndarray) -> np.ndarray:
    blue = hue(np.asarray(palette(1)[0]))
    pixels = image.astype(float)
    return np.abs(pixels / np.linalg.norm(pixels, axis=2, keepdims=True) - blue).max(axis=2) < 0.03


def pale(image: np.ndarray) -> np.ndarray:
    """Pixels of the body: warmer than the grey floor and the bluish sky."""
    return image[:, :, 0].astype(int) - image[:, :, 2] > 8


def test_a_floor_is_drawn_where_it_is_asked_for_or_the_scene_has_one() -> None:
    camera = Camera((0.0, 1.0, 5.0), (0.0, 0.0, 0.0), orthographic_height=4.0)
    bare, floored = (draw(simulation(sheet(0.0)), camera, 60, 60, ground=g) for g in (None, -1.0))
    own = draw(simulation(sheet(0.0), ground=-1.0), camera, 60, 60, ground=5.0)
    assert not np.array_equal(bare, floored)
    assert np.array_equal(own, floored), "the scene's own ground counts"


def test_drawing_touches_nothing() -> None:
    world = simulation(sheet(1.0), bodies=(Body(box((0.5, 0.5, 0.5))),))
    world.step(2)
    before = world.state_hash()
    draw(world)
    draw_views(world, width=30, height=40)
    assert world.state_hash() == before
