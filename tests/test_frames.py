"""Cameras and pictures: what is where, in which colour, and how errors read."""

from __future__ import annotations

from dataclasses import FrozenInstanceError

import numpy as np
import pytest
import trimesh
from PIL import Image as Pillow

from clothgym.kernels import raster
from clothgym.recording import frames
from clothgym.recording.frames import Camera, Drawable, Lines, render, render_depth

RED, GREEN, BLUE = (0.9, 0.1, 0.1), (0.1, 0.9, 0.1), (0.1, 0.1, 0.9)
FRONT = Camera((0, 0, 3), (0, 0, 0), vertical_fov=40)


def square(size=1.0, z=0.0):
    """A square that faces +z."""
    half = 0.5 * size
    vertices = np.array([[-half, -half, z], [half, -half, z], [half, half, z], [-half, half, z]])
    return vertices, np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32)


def strongest(image):
    """(H, W) index of the leading channel, -1 where no channel leads clearly."""
    ordered = np.sort(image.astype(int), axis=-1)
    return np.where(ordered[..., 2] - ordered[..., 1] > 60, image.argmax(-1), -1)


@pytest.mark.parametrize("orthographic_height", [None, 2.0])
def test_project_matrix_and_rays_agree(orthographic_height):
    camera = Camera((1, 2, 3), (0, 0.5, 0.2), up=(0.1, 1, 0), orthographic_height=orthographic_height)
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, (50, 3))
    pixels = camera.project(points, 80, 60)
    rays = camera.rays(80, 60)
    origin = rays[0] + pixels[:, :1] * rays[1] + pixels[:, 1:2] * rays[2]
    direction = rays[3] + pixels[:, :1] * rays[4] + pixels[:, 1:2] * rays[5]
    assert np.allclose(origin + pixels[:, 2:] * direction, points)
    centre = camera.project([camera.target], 80, 60)[0]
    assert centre == pytest.approx([40, 30, np.linalg.norm(np.subtract(camera.eye, camera.target))])
    right, up, forward = camera.basis()
    assert np.allclose(np.stack([right, up, forward]) @ np.stack([right, up, forward]).T, np.eye(3))
    assert np.linalg.det(np.stack([right, up, -forward])) == pytest.approx(1)
    moved = camera.project(np.asarray([camera.target]) + 0.1 * up, 80, 60)[0]
    assert moved[0] == pytest.approx(40)
    assert moved[1] < 30  # up is towards row 0


def test_field_of_view_and_orthographic_height_span_the_picture():
    camera = Camera((0, 0, 2), (0, 0, 0), vertical_fov=60)
    top = camera.project([[0, 2 * np.tan(np.radians(30)), 0]], 100, 50)[0]
    assert top[:2] == pytest.approx([50, 0])
    camera = Camera((0, 0, 2), (0, 0, 0), orthographic_height=3.0)
    assert camera.project([[0, -1.5, 0.7]], 100, 50)[0] == pytest.approx([50, 50, 1.3])


@pytest.mark.parametrize("orthographic", [False, True])
@pytest.mark.parametrize("direction", [(0, 0, 1), (1, 0.5, -2), (0, 1, 0), (0, -1, 0)])
@pytest.mark.parametrize("size", [(60, 60), (120, 60)])
def test_framing_sees_all_and_wastes_nothing(direction, orthographic, size):
    points = np.random.default_rng(1).normal((3, 1, -2), (0.5, 1.5, 0.2), (300, 3))
    width, height = size
    camera = Camera.framing(points, direction, margin=1.1, aspect=width / height, orthographic=orthographic)
    pixels = camera.project(points, width, height)
    offset = 2 * pixels[:, :2] / [width, height] - 1
    assert pixels[:, 2].min() > camera.near
    assert np.abs(offset).max() == pytest.approx(1 / 1.1, abs=1e-9)
    tight = np.abs(offset).max(0).argmax()
    assert offset[:, tight].min() == pytest.approx(-offset[:, tight].max())


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_framing_of_a_single_point_and_of_any_scale_draws(scale):
    assert Camera.framing([[1, 2, 3]]).project([[1, 2, 3]], 10, 10)[0, :2] == pytest.approx([5, 5])
    vertices, faces = square(scale)
    image = render([Drawable(vertices, faces, RED)], Camera.framing(vertices, (0, 0, 1)), 20, 20)
    assert (strongest(image)[2:-2, 2:-2] == 0).all()


def test_empty_picture_is_the_background():
    image = render([], FRONT, 7, 5, background=(0.2, 0.4, 0.6))
    assert image.shape == (5, 7, 3)
    assert image.dtype == np.uint8
    assert (image == [51, 102, 153]).all()
    shaded = render([], FRONT, 4, 3, background=((0, 0, 0), (1, 1, 1)))
    assert shaded[:, 0, 0].tolist() == [0, 128, 255]
    assert (render_depth([], FRONT, 7, 5) == 0).all()
    nothing = Drawable(np.empty((0, 3)), np.empty((0, 3), int))
    assert np.array_equal(render([nothing], FRONT, 4, 3), render([], FRONT, 4, 3))


def test_front_back_and_face_colours():
    vertices, faces = square()
    behind = Camera((0, 0, -3), (0, 0, 0), vertical_fov=40)
    sheet = Drawable(vertices, faces, RED, back_colour=BLUE)
    assert strongest(render([sheet], FRONT, 40, 40))[20, 20] == 0
    assert strongest(render([sheet], behind, 40, 40))[20, 20] == 2
    same = Drawable(vertices, faces, RED)
    assert np.array_equal(render([same], FRONT, 40, 40)[20, 20], render([same], behind, 40, 40)[20, 20])
    two = render([Drawable(vertices, faces, [RED, GREEN])], FRONT, 40, 40)
    assert strongest(two)[24, 24] == 0  # below the diagonal
    assert strongest(two)[15, 15] == 1
    hidden = render([Drawable(*square(0.3, 0.5), GREEN), sheet, Drawable(*square(0.6, -0.5), BLUE)], FRONT, 40, 40)
    assert strongest(hidden)[20, 20] == 1
    assert set(np.unique(strongest(hidden))) == {-1, 0, 1}


def test_shading_equals_a_plain_formula():
    """Every pixel of a lumpy sphere against interpolation and lighting written with whole arrays."""
    sphere = trimesh.creation.icosphere(subdivisions=2)
    vertices, faces = np.asarray(sphere.vertices) * [1, 0.8, 0.6], np.asarray(sphere.faces, dtype=np.int32)
    camera = Camera((1, 1.5, 3), (0, 0, 0), vertical_fov=40)
    colour = np.array([0.7, 0.5, 0.3])
    image = render([Drawable(vertices, faces, colour)], camera, 64, 64, background=(0, 0, 0))
    layers = raster.new_layers(1, 64, 64)
    position = np.empty((len(vertices), 4))
    raster.project(vertices, camera.matrix(64, 64), position)
    raster.rasterise(position, faces, camera.near, layers)
    rows, columns = np.nonzero(layers.triangle[0] >= 0)
    corners = faces[layers.triangle[0][rows, columns]]
    b = layers.barycentrics[0][rows, columns].astype(float)
    weights = np.column_stack([1 - b.sum(1), b])[:, :, None]
    point = (weights * vertices[corners]).sum(1)
    flat = np.cross(*(vertices[faces[:, k]] - vertices[faces[:, 0]] for k in (1, 2)))
    normals = np.zeros_like(vertices)
    for k in range(3):
        np.add.at(normals, faces[:, k], flat)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    n = (weights * normals[corners]).sum(1)
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    viewer = np.subtract(camera.eye, point)
    viewer /= np.linalg.norm(viewer, axis=1, keepdims=True)
    right, up, forward = camera.basis()
    key = -0.65 * forward + 0.65 * up - 0.40 * right
    key /= np.linalg.norm(key)
    light = 0.38 + 0.18 * (0.5 + 0.5 * n[:, 1]) + 0.24 * np.maximum((n * viewer).sum(1), 0)
    light += 0.38 * np.maximum(n @ key, 0)
    expected = 255 * np.minimum(colour * light[:, None], 1)
    assert len(rows) > 800
    assert np.abs(image[rows, columns] - expected).max() <= 0.51
    image[rows, columns] = 0
    assert not image.any()


def test_flat_shading_shows_one_tone_per_triangle():
    sphere = trimesh.creation.icosphere(subdivisions=1)
    camera = Camera((0, 0, 3), (0, 0, 0), orthographic_height=2.2)
    flat, smooth = (
        render([Drawable(sphere.vertices, sphere.faces, smooth=s)], camera, 80, 80, background=(0, 0, 0))
        for s in (False, True)
    )
    tones = len(np.unique(flat.reshape(-1, 3), axis=0))
    assert 10 < tones <= 41  # 40 triangles face the viewer
    assert len(np.unique(smooth.reshape(-1, 3), axis=0)) > 60
    assert np.array_equal(flat.any(-1), smooth.any(-1))


def test_vertex_normals_weigh_by_area():
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 3], [9, 9, 9], [8, 8, 8]])
    faces = np.array([[0, 1, 2], [0, 2, 3], [4, 4, 5]])
    normals = frames.vertex_normals(vertices, faces)
    assert normals[1] == pytest.approx([0, 0, 1])
    assert normals[3] == pytest.approx([1, 0, 0])
    assert normals[0] == pytest.approx(np.array([3, 0, 1]) / np.sqrt(10))
    assert (normals[4:] == 0).all()
    rng = np.random.default_rng(2)
    vertices, faces = rng.normal(0, 1, (40, 3)), rng.integers(0, 40, (100, 3))
    exact = np.zeros((40, 3))
    for face in faces:
        a, b, c = vertices[face]
        exact[face[0]] += np.cross(b - a, c - a)
        exact[face[1]] += np.cross(b - a, c - a)
        exact[face[2]] += np.cross(b - a, c - a)
    exact /= np.linalg.norm(exact, axis=1, keepdims=True)
    assert np.allclose(frames.vertex_normals(vertices, faces), exact)


def test_surface_without_vertex_normals_is_still_lit():
    """Two opposite copies of a face cancel at their vertices: the face's own normal takes over."""
    vertices, faces = square()
    both = np.concatenate([faces, faces[:, ::-1]])
    double, single = (render([Drawable(vertices, f, RED)], FRONT, 30, 30) for f in (both, faces))
    assert np.array_equal(double, single)


@pytest.mark.parametrize("camera", [FRONT, Camera((0, 0, 3), (0, 0, 0), orthographic_height=2.0)])
def test_lines_are_hidden_by_what_is_nearer(camera):
    sheet = Drawable(*square(), RED)

    def line(z, **options):
        image = render([sheet], camera, 60, 60, lines=[Lines([[[-0.3, 0, z], [0.3, 0, z]]], GREEN, 3, **options)])
        return (strongest(image) == 1).sum()

    full = line(0.3)
    assert full > 30
    assert line(0.0) >= 30  # on the surface itself: drawn whole
    assert line(-0.5) == 0
    assert line(-0.5, on_top=True) > 20
    outside = render([sheet], camera, 60, 60, lines=[Lines([[[-5, 0, -0.5], [5, 0, -0.5]]], GREEN, 3)])
    row = (strongest(outside) == 1).any(0)
    assert row[0]
    assert row[-1]
    assert not row[30]


@pytest.mark.parametrize("camera", [FRONT, Camera((0, 0, 3), (0, 0, 0), orthographic_height=2.0)])
def test_line_in_a_slanted_surface_is_drawn_whole(camera):
    """Half of its width lies deeper than the surface; what lies well behind the surface stays hidden."""
    vertices, faces = square()
    vertices = vertices + np.outer(vertices[:, 1], [0, 0, -0.9])
    segment = np.array([[[-0.3, 0.1, -0.09], [0.3, 0.1, -0.09]]])
    tested, on_top, behind = (
        strongest(render([Drawable(vertices, faces, RED)], camera, 100, 100, lines=[line])) == 1
        for line in (
            Lines(segment, GREEN, 5.0),
            Lines(segment, GREEN, 5.0, on_top=True),
            Lines(segment - [0, 0, 0.5], GREEN, 5.0),
        )
    )
    assert on_top.sum() > 100
    assert np.array_equal(tested, on_top)
    assert not behind.any()


@pytest.mark.parametrize("angle", [0, 17, 45, 90, 135])
def test_line_thickness_and_length(angle):
    """The blended area equals the area of a bar with round ends."""
    camera = Camera((0, 0, 1), (0, 0, 0), orthographic_height=100.0, near=1e-3)
    direction = np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle)), 0])
    image = render([], camera, 100, 100, [Lines([[-30 * direction, 30 * direction]], (1, 1, 1), 5.0)], (0, 0, 0))
    area = image[..., 0].sum() / 255
    assert area == pytest.approx(60 * 5 + np.pi * 2.5**2, rel=0.02)
    rows, columns = np.nonzero(image[..., 0])
    assert np.ptp(columns + 0.5) == pytest.approx(abs(60 * direction[0]) + 5, abs=1.5)
    assert np.ptp(rows + 0.5) == pytest.approx(abs(60 * direction[1]) + 5, abs=1.5)


def test_line_through_the_camera_plane_and_odd_segments():
    camera = Camera((0, 0, 0), (0, 0, -1), vertical_fov=90)
    crossing = render([], camera, 40, 40, [Lines([[[0, -0.5, 2], [0, -0.5, -4]]], GREEN, 2)])
    column = (strongest(crossing) == 1)[:, 19:21].all(1)
    assert column[23:].all()  # from 4 m away, y = 0.5 / 4, down to the lower border
    assert not column[:21].any()
    odd = [[[0, 0, 2], [1, 1, 3]], [[0, 0, -2], [0, 0, -2]], [[1e12, 0, -1], [-1e12, 1e3, -1]], [[0, 0, 0], [0, 0, 0]]]
    assert (strongest(render([], camera, 40, 40, [Lines(odd, GREEN, 4)])) == 1).sum() >= 9
    assert np.array_equal(render([], camera, 8, 8, [Lines([], GREEN)]), render([], camera, 8, 8))


def test_line_depth_is_perspective_correct():
    """A line that recedes through a wall disappears where it passes the wall, not at its middle in the picture."""
    camera = Camera((0, 0, 0), (0, 0, -1), vertical_fov=90)
    vertices, faces = square(20.0, -2.0)
    wall = Drawable(vertices, faces, RED)
    line = Lines([[[-0.9, 0, -1], [-0.9, 0, -21]]], GREEN, 1.5)
    image = strongest(render([wall], camera, 200, 200, [line]))
    columns = np.nonzero((image[98:102] == 1).any(0))[0]
    expected = 100 - 100 * 0.9 / 2  # where x / z = 0.9 / 2
    assert columns.min() == pytest.approx(10, abs=2)
    assert columns.max() == pytest.approx(expected, abs=3)


def test_ground_is_behind_above_and_only_from_above():
    camera = Camera((0, 1.5, 3), (0, 0.5, 0), vertical_fov=50)
    plain, floor = (render([], camera, 60, 60, ground=g) for g in (None, 0.0))
    changed = (plain != floor).any(-1)
    horizon = 30 - 30 / np.tan(np.radians(25)) * (1 / 3)
    assert not changed[: int(horizon)].any()
    assert changed[40:].mean() > 0.95
    assert len(np.unique(floor[50])) > 2  # light and dark cells
    below = Camera((0, -1.5, 3), (0, 0, 0), vertical_fov=50)
    assert np.array_equal(render([], below, 60, 60), render([], below, 60, 60, ground=0.0))
    stands, sunk = (Drawable(*square(0.8, 0.0), RED) for _ in range(2))
    sunk = Drawable(np.asarray(sunk.vertices) - [0, 5, 0], sunk.faces, RED)
    assert (strongest(render([stands], camera, 60, 60, ground=-0.4)) == 0).sum() > 100
    assert (strongest(render([sunk], camera, 60, 60, ground=0.0)) == 0).sum() == 0
    half = (strongest(render([stands], camera, 60, 60, ground=0.0)) == 0).sum()
    assert 0.3 < half / (strongest(render([stands], camera, 60, 60)) == 0).sum() < 0.7
    level = Camera((0, 3, 0), (0, 0, 0), up=(0, 0, -1), orthographic_height=4.0)
    assert (render_depth([], level, 9, 9, ground=1.0, depth_range=(0, 4)) == round(255 - 254 * 2 / 4)).all()


def test_antialias_averages_four_samples():
    sphere = trimesh.creation.icosphere(subdivisions=2, radius=0.8)
    drawable = Drawable(sphere.vertices, sphere.faces, RED)
    fine = render([drawable], FRONT, 60, 40, background=(1, 1, 1)).astype(float)
    soft = render([drawable], FRONT, 30, 20, background=(1, 1, 1), antialias=2)
    assert soft.shape == (20, 30, 3)
    assert np.abs(fine.reshape(20, 2, 30, 2, 3).mean((1, 3)) - soft).max() <= 1.01


def test_depth_picture_is_linear_in_distance():
    vertices, faces = square(4.0)
    image = render_depth([Drawable(vertices, faces)], FRONT, 20, 20, depth_range=(2, 5))
    assert image.shape == (20, 20, 1)
    assert image.dtype == np.uint8
    assert (image == round(255 - 254 / 3)).all()
    tilted = vertices + np.outer(vertices[:, 0], [0, 0, 0.5])
    row = render_depth([Drawable(tilted, faces)], FRONT, 21, 21)[10, :, 0]
    assert (np.diff(row.astype(int)) > 0).all()  # the right side is nearer: brighter
    near, far = (render_depth([Drawable(*square(90.0, z))], FRONT, 5, 5, depth_range=(2, 4)) for z in (2.5, -30.0))
    assert (near == 255).all()
    assert (far == 1).all()


def test_same_input_gives_the_same_bytes():
    rng = np.random.default_rng(4)
    vertices, faces = rng.normal(0, 0.5, (60, 3)), np.arange(60).reshape(-1, 3)
    lines = [Lines(rng.normal(0, 0.5, (20, 2, 3)))]
    first, second = (
        render([Drawable(vertices, faces)], FRONT, 64, 48, lines, ground=-0.5, antialias=2).tobytes() for _ in range(2)
    )
    assert first == second


def test_palette_is_distinct_and_stable():
    colours = np.array(frames.palette(16))
    assert colours.shape == (16, 3)
    assert colours.min() >= 0
    assert colours.max() <= 1
    gaps = np.linalg.norm(colours[:, None] - colours[None], axis=-1) + np.eye(16)
    assert gaps.min() > 0.1
    assert frames.palette(3) == frames.palette(16)[:3]
    assert frames.palette(300)[:16] == frames.palette(16)
    assert frames.palette(0) == []


def test_tile_and_png(tmp_path):
    red, grey = np.full((20, 30, 3), [200, 0, 0], np.uint8), np.full((10, 40, 1), 90, np.uint8)
    sheet = frames.tile([red, grey, red], ["one", "two\nlines", "three"], columns=2)
    assert sheet.dtype == np.uint8
    assert sheet.shape[1] == 2 * (40 + 6) + 6
    assert (sheet == [200, 0, 0]).all(-1).sum() == 2 * 20 * 30
    assert (sheet == [90, 90, 90]).all(-1).sum() >= 10 * 40
    bare = frames.tile([red, grey, red], columns=2)
    assert bare.shape == (2 * (20 + 6) + 6, 2 * (40 + 6) + 6, 3)
    assert (sheet < 100).sum() > (bare < 100).sum()  # the text
    assert frames.tile([red]).shape == (32, 42, 3)
    path = frames.save_png(tmp_path / "new" / "picture.png", sheet)
    with Pillow.open(path) as read:
        assert np.array_equal(np.asarray(read), sheet)
    with Pillow.open(frames.save_png(tmp_path / "grey.png", grey)) as read:
        assert np.asarray(read).shape == (10, 40, 3)


def test_camera_is_a_value():
    assert Camera([0, 0, 1], np.zeros(3)) == Camera((0.0, 0.0, 1.0), (0.0, 0.0, 0.0))  # type: ignore[arg-type]
    assert len({Camera((0, 0, 1), (0, 0, 0)), Camera((0, 0, 1), (0, 0, 0))}) == 1
    with pytest.raises(FrozenInstanceError):
        FRONT.eye = (1, 1, 1)  # type: ignore[misc]


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: Camera((0, 0, 0), (0, 0, 0)), "camera eye = .*must differ from the target"),
        (lambda: Camera((0, 1, 0), (0, 0, 0)), "camera up = .*must not lie along the view"),
        (lambda: Camera((0, np.nan, 0), (0, 0, 0)), "camera eye = .*three finite numbers"),
        (lambda: Camera((0, 0, 1), (0, 0, 0), vertical_fov=180), "camera vertical_fov = 180: out of range"),
        (lambda: Camera((0, 0, 1), (0, 0, 0), orthographic_height=0), "camera orthographic_height = 0: out of range"),
        (lambda: Camera((0, 0, 1), (0, 0, 0), near=0.0), "camera near = 0.0: out of range"),
        (lambda: Camera.framing(np.empty((0, 3))), "points: need at least one"),
        (lambda: Camera.framing([[0, 0, 0]], margin=0.5), "margin = 0.5: out of range"),
        (lambda: Camera.framing([[0, 0, 0]], direction=(0, 0, 0)), "direction = .*must not be zero"),
        (lambda: Drawable([[0, 0, np.inf]], [[0, 0, 0]]), r"drawable vertices\[0, 2\] is inf"),
        (lambda: Drawable([[0, 0, 0]], [[0, 0, 1]]), r"drawable faces\[0, 2\] is 1"),
        (lambda: Drawable(*square(), (200, 10, 10)), r"drawable colour: every component must be within \[0, 1\]"),
        (lambda: Drawable(*square(), "red"), "drawable colour = 'red'"),
        (lambda: Drawable(*square(), RED, np.zeros((3, 3))), r"drawable back_colour: expected shape .* \(2, 3\)"),
        (lambda: Lines(np.zeros((4, 3))), r"lines segments: expected shape \(S, 2, 3\), got \(4, 3\)"),
        (lambda: Lines(np.full((1, 2, 3), np.nan)), "lines segments.*finite"),
        (lambda: Lines([], width_pixels=0), "lines width_pixels = 0: out of range"),
        (lambda: render([], FRONT, 0, 5), "width = 0: out of range"),
        (lambda: render([], FRONT, 5, 5.5), "height = 5.5: expected an integer"),
        (lambda: render([], FRONT, 5, 5, antialias=3), "antialias = '3': expected one of 1, 2"),
        (lambda: render([], FRONT, 5, 5, ground=np.nan), "ground = nan: out of range"),
        (lambda: render([], FRONT, 5, 5, background=(2, 0, 0)), "background: every component"),
        (lambda: render_depth([], FRONT, 5, 5, depth_range=(2, 1)), r"depth_range = \(2, 1\): expected \(near, far\)"),
        (lambda: frames.tile([]), "images: need at least one"),
        (lambda: frames.tile([np.zeros((2, 2, 3), np.uint8)], ["a", "b"]), "labels: expected 1, got 2"),
        (lambda: frames.save_png("never.png", np.zeros((2, 2, 3))), r"image: expected .*float64"),
        (lambda: frames.palette(-1), "count = -1: out of range"),
    ],
)
def test_errors_name_field_and_value(call, message):
    with pytest.raises(ValueError, match=message):
        call()
