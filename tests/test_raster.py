"""The rasteriser against exact coverage, ray casting and analytic depth."""

from __future__ import annotations

import naive_raster
import numpy as np
import pytest
import trimesh
from scipy.spatial import Delaunay

from clothgym.kernels import raster
from clothgym.recording.frames import Camera


def flat_image(pixels, depth=1.0):
    """(V, 4) image-space vertices at pixel positions, all at one depth, orthographic."""
    pixels = np.asarray(pixels, dtype=np.float64)
    return np.column_stack([pixels, np.full(len(pixels), depth), np.ones(len(pixels))])


def image_space(vertices, camera, width, height):
    image = np.empty((len(vertices), 4))
    raster.project(np.ascontiguousarray(vertices, dtype=np.float64), camera.matrix(width, height), image)
    return image


def drawn(image, faces, width, height, near=1e-3, count=1):
    layers = raster.new_layers(count, height, width)
    raster.rasterise(image, np.ascontiguousarray(faces, dtype=np.int32), near, layers)
    return layers


def times_covered(image, faces, width, height, near=1e-3):
    """(H, W) how many of the faces, each drawn alone, cover a pixel."""
    counts = np.zeros((height, width), int)
    for k in range(len(faces)):
        counts += drawn(image, faces[k : k + 1], width, height, near).triangle[0] >= 0
    return counts


def weights(layers, layer=0):
    b = layers.barycentrics[layer].astype(np.float64)
    return np.stack([1 - b.sum(-1), b[..., 0], b[..., 1]], axis=-1)


def points_of(layers, vertices, faces, layer=0):
    """Pixel rows and columns, and the (N, 3) world points that id and barycentrics stand for."""
    rows, columns = np.nonzero(layers.triangle[layer] >= 0)
    corners = vertices[faces[layers.triangle[layer][rows, columns]]]
    return rows, columns, (weights(layers, layer)[rows, columns][:, :, None] * corners).sum(1)


@pytest.mark.parametrize("step", [2, 16, 4096])
def test_coverage_of_one_triangle_is_exact(step):
    """Positions on a grid of 1/step pixel: with 1/2, most centres near the border lie exactly on an edge."""
    rng = np.random.default_rng(step)
    for _ in range(60):
        corners = rng.integers(-3 * step, 15 * step, (3, 2)) / step
        layers = drawn(flat_image(corners), [[0, 1, 2]], 12, 12)
        assert np.array_equal(layers.triangle[0] >= 0, naive_raster.covered_pixels(corners, 12, 12)), corners


@pytest.mark.parametrize(("step", "seed"), [(2, 0), (2, 1), (16, 2), (None, 3), (None, 4)])
def test_triangulated_square_covers_every_pixel_once(step, seed):
    rng = np.random.default_rng(seed)
    low, high = 4.5, 36.5  # borders through pixel centres: the left and top ones are in, the others out
    inner = rng.uniform(low, high, (70, 2))
    border = rng.uniform(low, high, (4, 6))
    if step:
        inner, border = np.round(inner * step) / step, np.round(border * step) / step
    sides = [(x, low) for x in border[0]] + [(x, high) for x in border[1]]
    sides += [(low, y) for y in border[2]] + [(high, y) for y in border[3]]
    square = [(low, low), (high, low), (low, high), (high, high)]
    points = np.unique(np.concatenate([inner, sides, square]), axis=0)
    faces = Delaunay(points).simplices.astype(np.int32)
    a, b, c = (points[faces[:, k]] for k in range(3))
    areas = 0.5 * np.abs((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
    assert areas.sum() == pytest.approx((high - low) ** 2)
    turned = rng.random(len(faces)) < 0.5
    faces[turned] = faces[turned][:, ::-1]
    expected = np.zeros((40, 40), int)
    expected[4:36, 4:36] = 1
    assert np.array_equal(times_covered(flat_image(points), faces, 40, 40), expected)


@pytest.mark.parametrize("orthographic", [False, True])
@pytest.mark.parametrize("seed", range(4))
def test_random_triangles_agree_with_ray_casting(seed, orthographic):
    """Triangles everywhere around the camera, many of them cut by the near plane."""
    rng = np.random.default_rng(seed)
    centres = rng.uniform(-3, 3, (60, 1, 3))
    corners = centres + rng.normal(0, 1.5 if seed % 2 else 0.7, (60, 3, 3))
    vertices, faces = corners.reshape(-1, 3), np.arange(180, dtype=np.int32).reshape(-1, 3)
    camera = Camera((0.3, 0.2, 1.0), (0, 0, -1), vertical_fov=70, orthographic_height=4.0 if orthographic else None)
    width, height, near = 45, 32, 0.05
    layers = drawn(image_space(vertices, camera, width, height), faces, width, height, near)
    depth, barycentrics, clearance, _ = naive_raster.cast_rays(
        vertices, faces, camera.rays(width, height), width, height, near
    )
    face = np.where(np.isfinite(depth.min(0)), depth.argmin(0), -1)
    same = layers.triangle[0] == face
    assert (layers.triangle[0] >= 0).sum() > 300
    # Snapping to 1/4096 pixel may move a border: a pixel may differ only when its ray passes a border, or the near
    # plane, or a crossing of two triangles closely.
    ordered = np.sort(depth, axis=0)
    with np.errstate(invalid="ignore"):
        crossing = ordered[1] - ordered[0] < 1e-3
    border = (np.abs(clearance) < 1e-3).any(0)
    assert (same | crossing | border | (np.abs(ordered[0] - near) < 1e-3)).all()
    assert same.mean() > 0.995
    hit = same & (face >= 0)
    rows, columns = np.nonzero(hit)
    exact = barycentrics[face[hit], rows, columns]
    assert np.median(np.abs(weights(layers)[hit] - exact).max(1)) < 1e-4
    assert np.median(np.abs(layers.depth[0][hit] - depth.min(0)[hit])) < 1e-4
    # What id and barycentrics stand for lies under the pixel centre, at the stored depth.
    rows, columns, points = points_of(layers, vertices, faces)
    seen = camera.project(points, width, height)
    assert np.abs(seen[:, 0] - columns - 0.5).max() < 2e-3
    assert np.abs(seen[:, 1] - rows - 0.5).max() < 2e-3
    assert np.abs(seen[:, 2] - layers.depth[0][rows, columns]).max() < 1e-4
    assert layers.depth[0].min() >= np.float32(near)


def test_barycentrics_are_perspective_correct():
    """A floor that recedes from 1 m to 50 m: analytic depth, far from what linear interpolation gives."""
    camera = Camera((0, 1, 0), (0, 1, -1), vertical_fov=90)
    vertices = np.array([[-60.0, 0, -1], [60, 0, -1], [60, 0, -50], [-60, 0, -50]])
    faces = np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32)
    layers = drawn(image_space(vertices, camera, 64, 64), faces, 64, 64)
    rows = np.nonzero((layers.triangle[0] >= 0).all(1))[0]
    assert len(rows) >= 30
    exact = 32.0 / (rows + 0.5 - 32.0)
    assert np.allclose(layers.depth[0][rows], exact[:, None], rtol=2e-3)  # 1/8192 pixel at 64 pixels per half height
    i, j, points = points_of(layers, vertices, faces)
    depth = 32.0 / (i + 0.5 - 32.0)
    assert np.allclose(-points[:, 2], depth, rtol=2e-3)
    assert np.allclose(points[:, 0], depth * (j + 0.5 - 32.0) / 32.0, rtol=2e-3, atol=2e-3)
    linear = 1 + 49 * (63.5 - rows) / (63.5 - rows.min())
    assert np.abs(linear - exact).max() > 10


def test_near_plane_cuts_a_floor_that_reaches_behind_the_camera():
    camera = Camera((0, 1, 0), (0, 1, -1), vertical_fov=120)
    vertices = np.array([[-40.0, 0, 30], [40, 0, 30], [40, 0, -40], [-40, 0, -40]])
    faces = np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32)
    image = image_space(vertices, camera, 50, 50)
    scale = 25 / np.tan(np.radians(60))
    for near in (0.01, 0.7, 2.0):
        layers = drawn(image, faces, 50, 50, near)
        exact = scale / (np.arange(50) + 0.5 - 25)
        expected = (exact > near) & (exact < 40)
        columns = slice(24, 26)
        assert np.array_equal(layers.triangle[0][:, columns] >= 0, np.repeat(expected[:, None], 2, 1))
        assert np.allclose(layers.depth[0][expected, columns], exact[expected][:, None], rtol=1e-3)
        _, _, points = points_of(layers, vertices, faces)
        assert np.abs(points[:, 1]).max() < 1e-4


def test_clipped_neighbours_leave_no_crack_and_no_overlap():
    """An uneven grid of triangles, cut by the near plane at odd places, covers every pixel below its horizon once."""
    rng = np.random.default_rng(5)
    camera = Camera((0.1, 0.5, 0.2), (0.3, 0.2, -1), up=(0.2, 1, 0), vertical_fov=80)
    x, z = np.meshgrid(np.linspace(-6, 6, 9), np.linspace(-6, 6, 9))
    points = np.column_stack([x.ravel(), z.ravel()]) + rng.uniform(-0.3, 0.3, (81, 2))
    faces = Delaunay(points).simplices.astype(np.int32)
    vertices = np.column_stack([points[:, 0], np.zeros(81), points[:, 1]])
    image = image_space(vertices, camera, 60, 60)
    near = 0.62
    depth, *_ = naive_raster.cast_rays(vertices, faces, camera.rays(60, 60), 60, 60, 0.0)
    plane = depth.min(0)
    counts = times_covered(image, faces, 60, 60, near)
    certain = np.isfinite(plane) & (plane > near + 1e-3)
    cut = np.isfinite(plane) & (plane < near - 1e-3)
    assert certain.sum() > 1000
    assert cut.sum() > 100
    assert (counts[certain] == 1).all()
    assert (counts[cut] == 0).all()


def test_clipped_neighbours_share_the_cut_bit_by_bit():
    rng = np.random.default_rng(6)
    for _ in range(50):
        corners = rng.normal(0, 1, (4, 6))
        corners[:, 3] = 1.0
        corners[:2, 2] = 0.2, -0.4  # the edge 0-1 crosses the near plane
        cuts = []
        for triangle in ([0, 1, 2], [1, 0, 3], [2, 0, 1], [0, 3, 1]):
            polygon = np.zeros((2, 9, 6))
            polygon[0, :3] = corners[triangle]
            count = raster._clip(polygon, 3, 0.1)
            share = (0.2 - 0.1) / 0.6
            expected = corners[0] + share * (corners[1] - corners[0])
            nearest = np.abs(polygon[0, :count] - expected).max(1).argmin()
            assert np.allclose(polygon[0, nearest], expected)
            cuts.append(polygon[0, nearest].tobytes())
        assert len(set(cuts)) == 1


def test_huge_triangles_are_cut_at_the_guard_band():
    """Corners up to 1e9 pixels away; the plane z = 2 + 0.01 x + 0.02 y of pixel positions shows on every pixel."""
    corners = np.array([[-1e9, -1e9], [1e9, -1e9], [20.3, 1e9]])
    image = np.column_stack([corners, 2e7 + 0.01 * corners[:, 0] + 0.02 * corners[:, 1], np.ones(3)])
    image[:, 2] -= 2e7 - 2  # partly behind
    layers = drawn(image, [[0, 1, 2]], 32, 24, near=-1e12)
    i, j = np.meshgrid(np.arange(32) + 0.5, np.arange(24) + 0.5)
    assert (layers.triangle[0] == 0).all()
    assert np.allclose(layers.depth[0], 2 + 0.01 * i + 0.02 * j, atol=1e-3)


@pytest.mark.parametrize("orthographic", [False, True])
def test_sphere_shows_front_and_back_in_one_pass(orthographic):
    sphere = trimesh.creation.icosphere(subdivisions=4, radius=0.5)
    vertices, faces = np.asarray(sphere.vertices), np.asarray(sphere.faces, dtype=np.int32)
    camera = Camera((0, 0, 3), (0, 0, 0), vertical_fov=30, orthographic_height=1.2 if orthographic else None)
    layers = drawn(image_space(vertices, camera, 90, 90), faces, 90, 90, count=2)
    rays = camera.rays(90, 90)
    i, j = np.meshgrid(np.arange(90) + 0.5, np.arange(90) + 0.5)
    origin = rays[0] + i[..., None] * rays[1] + j[..., None] * rays[2]
    direction = rays[3] + i[..., None] * rays[4] + j[..., None] * rays[5]
    a, b = (direction**2).sum(-1), (origin * direction).sum(-1)
    root = b * b - a * ((origin**2).sum(-1) - 0.25)
    inside = root > 0.01
    assert inside.sum() > 2000
    for layer, sign in ((0, -1), (1, 1)):
        exact = (-b + sign * np.sqrt(np.maximum(root, 0))) / a
        assert (layers.triangle[layer][inside] >= 0).all()
        assert np.abs(layers.depth[layer][inside] - exact[inside]).max() < 4e-3  # facets lie up to 1 mm inside
    # A closed surface has the same outline from both sides, and one buffer shows just its front.
    assert np.array_equal(layers.triangle[0] >= 0, layers.triangle[1] >= 0)
    single = drawn(image_space(vertices, camera, 90, 90), faces, 90, 90)
    assert np.array_equal(single.triangle[0], layers.triangle[0])
    assert np.array_equal(single.depth[0], layers.depth[0])


def test_snapping_shifts_nothing_on_average():
    """Thousands of small triangles: single shifts up to 1/8192 pixel, the mean far below (rounding down: 1.2e-4)."""
    sphere = trimesh.creation.icosphere(subdivisions=4, radius=0.5)
    vertices, faces = np.asarray(sphere.vertices), np.asarray(sphere.faces, dtype=np.int32)
    camera = Camera((0.3, 0.4, 3), (0, 0, 0), orthographic_height=1.1)
    layers = drawn(image_space(vertices, camera, 150, 150), faces, 150, 150)
    rows, columns, points = points_of(layers, vertices, faces)
    offset = camera.project(points, 150, 150)[:, :2] - np.column_stack([columns, rows]) - 0.5
    assert np.abs(offset).max() < 2e-4
    assert np.abs(offset.mean(0)).max() < 1e-5


def test_two_layers_keep_the_nearest_front_and_the_farthest_back():
    sphere = trimesh.creation.icosphere(subdivisions=2, radius=0.5)
    count = len(sphere.faces)
    vertices = np.concatenate([sphere.vertices + np.array([0, 0, z]) for z in (0.0, -2.0, -4.0)])
    faces = np.concatenate([sphere.faces + k * len(sphere.vertices) for k in range(3)])
    camera = Camera((0, 0, 3), (0, 0, 0), orthographic_height=1.2)
    layers = drawn(image_space(vertices, camera, 40, 40), faces, 40, 40, count=2)
    assert layers.triangle[0][20, 20] < count
    assert layers.triangle[1][20, 20] >= 2 * count
    assert layers.depth[:, 20, 20] == pytest.approx([2.5, 7.5], abs=0.02)


def test_degenerate_input_leaves_no_trace():
    nan, inf = np.nan, np.inf
    image = np.array([
        [5, 5, 1, 1], [15, 5, 1, 1], [5, 15, 1, 1],  # a sound triangle
        [nan, 5, 1, 1], [5, inf, 1, 1], [5, 5, nan, 1], [5, 5, 1, inf],  # not finite
        [25, 5, 1, 1],  # in line with 0 and 1
        [500, 500, 1, 1], [600, 500, 1, 1], [500, 600, 1, 1],  # outside
        [5, 5, -1, -1], [15, 5, -1, -1], [5, 15, -2, -2],  # behind a perspective camera
        [5.51, 5.51, 1, 1], [5.55, 5.51, 1, 1], [5.51, 5.55, 1, 1],  # between pixel centres
        [7, 7, 1, 0], [0, 0, 0, 0],  # no place at all
    ], dtype=np.float64)  # fmt: skip
    bad = [[0, 1, 3], [0, 4, 2], [5, 1, 2], [0, 1, 6], [0, 1, 7], [0, 0, 1], [0, 0, 0], [8, 9, 10], [11, 12, 13],
           [14, 15, 16], [18, 18, 18]]  # fmt: skip
    layers = drawn(image, bad, 20, 20, count=2)
    assert (layers.triangle == raster.NO_TRIANGLE).all()
    assert (layers.depth[0] == np.inf).all()
    assert (layers.depth[1] == -np.inf).all()
    mixed = drawn(image, [*bad, [0, 1, 2]], 20, 20)
    assert set(np.unique(mixed.triangle)) == {-1, len(bad)}
    assert (mixed.triangle >= 0).sum() == 45  # the diagonal of the 10 x 10 half square is no left edge
    drawn(image, [[0, 1, 17], [17, 18, 2], [0, 12, 18]], 20, 20)  # only must not hang or crash
    empty = drawn(np.empty((0, 4)), np.empty((0, 3)), 20, 20)
    assert (empty.triangle == -1).all()


def test_result_is_deterministic_and_the_first_wins_a_tie():
    rng = np.random.default_rng(8)
    vertices = rng.uniform(-1, 1, (90, 3))
    faces = np.arange(90, dtype=np.int32).reshape(-1, 3)
    camera = Camera((0, 0, 2), (0, 0, 0), vertical_fov=60)
    image = image_space(vertices, camera, 50, 50)
    first, second = drawn(image, faces, 50, 50), drawn(image, faces, 50, 50)
    hit = first.triangle >= 0
    assert first.depth.tobytes() == second.depth.tobytes()
    assert first.triangle.tobytes() == second.triangle.tobytes()
    assert first.barycentrics[hit].tobytes() == second.barycentrics[hit].tobytes()
    order = rng.permutation(len(faces))
    shuffled = drawn(image, faces[order], 50, 50)
    assert shuffled.depth.tobytes() == first.depth.tobytes()
    assert np.array_equal(order[shuffled.triangle[hit]], first.triangle[hit])
    twice = drawn(image, np.concatenate([faces, faces]), 50, 50)
    assert np.array_equal(twice.triangle, first.triangle)


def test_layers_have_the_promised_types_and_can_be_filled_in_turns():
    layers = raster.new_layers(1, 10, 12)
    assert layers.depth.dtype == np.float32
    assert layers.triangle.dtype == np.int32
    assert layers.barycentrics.dtype == np.float32
    assert layers.barycentrics.shape == (1, 10, 12, 2)
    far, near = flat_image([[0, 0], [12, 0], [0, 10]], 5.0), flat_image([[12, 10], [12, 0], [0, 10]], 3.0)
    faces = np.array([[0, 1, 2]], dtype=np.int32)
    raster.rasterise(near, faces, 0.1, layers)
    before = layers.depth.copy()
    raster.rasterise(far, faces, 0.1, layers)
    assert (layers.depth[before == 3.0] == 3.0).all()
    assert set(np.unique(layers.depth)) == {3.0, 5.0}
    raster.clear_layers(layers)
    assert (layers.depth == np.inf).all()
    assert (layers.triangle == -1).all()


def test_front_is_counter_clockwise_for_the_viewer():
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    front, back = Camera((0.3, 0.3, 2), (0.3, 0.3, 0)), Camera((0.3, 0.3, -2), (0.3, 0.3, 0))
    for camera, layer in ((front, 0), (back, 1)):
        layers = drawn(image_space(vertices, camera, 20, 20), [[0, 1, 2]], 20, 20, count=2)
        assert (layers.triangle[layer] >= 0).any()
        assert (layers.triangle[1 - layer] < 0).all()
