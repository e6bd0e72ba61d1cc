"""Pictures without a display: cameras, surfaces and lines drawn by the software rasteriser into uint8 images.

    camera = Camera.framing(vertices)
    image = render([Drawable(vertices, faces)], camera, 256, 256, ground=0.0)
    save_png("cloth.png", image)

Colours are (red, green, blue) in [0, 1]; images are (H, W, 3) uint8 with row 0 at the top.
"""

from __future__ import annotations

import colorsys
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clothgym.arrays import FloatArray, IntArray, as_faces, as_points, check_choice, check_number
from clothgym.kernels import raster

Image = NDArray[np.uint8]
Colour = tuple[float, float, float]

BACKGROUND = ((0.90, 0.92, 0.95), (0.97, 0.97, 0.97))
"""Colours of the top and the bottom row."""

_FIRST_COLOURS = (
    (0.36, 0.60, 0.84), (0.93, 0.58, 0.36), (0.48, 0.72, 0.47), (0.84, 0.47, 0.55),
    (0.62, 0.53, 0.80), (0.90, 0.78, 0.40), (0.40, 0.73, 0.74), (0.68, 0.55, 0.46),
)  # fmt: skip


def _vector(values: Any, name: str) -> tuple[float, float, float]:
    try:
        vector = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        vector = np.empty(0)
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise ValueError(f"{name} = {values!r}: expected three finite numbers")
    return float(vector[0]), float(vector[1]), float(vector[2])


def _colours(values: Any, name: str, face_count: int) -> NDArray[np.float32]:
    """(3,) or (F, 3) float32 in [0, 1]."""
    try:
        colours = np.asarray(values, dtype=np.float32)
    except (TypeError, ValueError):
        raise ValueError(f"{name} = {values!r}: expected (red, green, blue)") from None
    if colours.shape not in ((3,), (face_count, 3)):
        raise ValueError(f"{name}: expected shape (3,) or ({face_count}, 3), got {colours.shape}")
    if colours.size and not (colours.min() >= 0.0 and colours.max() <= 1.0):
        raise ValueError(f"{name}: every component must be within [0, 1]")
    return colours


def _unit(vector: FloatArray, message: str) -> FloatArray:
    length = float(np.linalg.norm(vector))
    if not length > 1e-12:
        raise ValueError(message)
    return vector / length


@dataclass(frozen=True)
class Camera:
    """A pinhole camera, or an orthographic one when `orthographic_height` is given.

    Raises:
        ValueError: eye on target, `up` along the view, or a field out of range.
    """

    eye: tuple[float, float, float]
    """[m] place of the camera."""
    target: tuple[float, float, float]
    """[m] point in the middle of the picture."""
    up: tuple[float, float, float] = (0.0, 1.0, 0.0)
    vertical_fov: float = 35.0
    """[degree] opening angle from the bottom to the top of the picture."""
    orthographic_height: float | None = None
    """[m] height of what an orthographic camera sees; None for perspective."""
    near: float = 0.01
    """[m] what is closer to the camera plane is cut off."""

    def __post_init__(self) -> None:
        for name in ("eye", "target", "up"):
            object.__setattr__(self, name, _vector(getattr(self, name), f"camera {name}"))
        check_number(self.vertical_fov, "camera vertical_fov", 1.0, 170.0)
        check_number(self.near, "camera near", 1e-9, 1e9)
        if self.orthographic_height is not None:
            check_number(self.orthographic_height, "camera orthographic_height", 1e-9, 1e9)
        self.basis()

    def basis(self) -> FloatArray:
        """(3, 3) unit rows: right, up, forward."""
        forward = _unit(np.subtract(self.target, self.eye), f"camera eye = {self.eye}: must differ from the target")
        sideways = np.cross(forward, self.up)
        right = _unit(sideways, f"camera up = {self.up}: must not lie along the view")
        return np.stack([right, np.cross(right, forward), forward])

    def _pixels_per_unit(self, height: int) -> float:
        """Pixels per metre (orthographic) or per metre at distance 1 m (perspective)."""
        if self.orthographic_height is not None:
            return height / self.orthographic_height
        return 0.5 * height / math.tan(0.5 * math.radians(self.vertical_fov))

    def matrix(self, width: int, height: int) -> FloatArray:
        """(4, 4) world to image space (X, Y, Z, W) as `clothgym.kernels.raster` has it."""
        basis = self.basis()
        right, up, forward = np.column_stack([basis, -basis @ np.asarray(self.eye)])
        scale = self._pixels_per_unit(height)
        one = np.array([0.0, 0.0, 0.0, 1.0])
        w = forward if self.orthographic_height is None else one
        return np.stack([scale * right + 0.5 * width * w, -scale * up + 0.5 * height * w, forward, w])

    def rays(self, width: int, height: int) -> FloatArray:
        """(6, 3) rays through the pixels, as `raster.draw_ground` takes them."""
        right, up, forward = self.basis()
        eye = np.asarray(self.eye)
        across, down = right / self._pixels_per_unit(height), -up / self._pixels_per_unit(height)
        corner = -0.5 * width * across - 0.5 * height * down
        none = np.zeros(3)
        if self.orthographic_height is None:
            return np.stack([eye, none, none, forward + corner, across, down])
        return np.stack([eye + corner, across, down, forward, none, none])

    def project(self, points: ArrayLike, width: int, height: int) -> FloatArray:
        """(N, 3) pixel position x, y (top left corner of the picture is 0, 0) and distance [m] of (N, 3) points.

        Points behind a perspective camera have a negative distance and no meaningful position.
        """
        image = _image_space(as_points(points, "points"), self, width, height)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.column_stack([image[:, :2] / image[:, 3:], image[:, 2]])

    @classmethod
    def framing(
        cls,
        points: ArrayLike,
        direction: ArrayLike = (0.45, 0.25, 1.0),
        margin: float = 1.1,
        vertical_fov: float = 35.0,
        aspect: float = 1.0,
        orthographic: bool = False,
    ) -> Camera:
        """The closest camera that sees all points.

        Args:
            points: (N, 3) [m], at least one.
            direction: from the points towards the camera.
            margin: 1 = the outermost points touch the border, 1.1 = a tenth more room.
            vertical_fov: [degree].
            aspect: width / height of the narrowest picture that must hold everything.
            orthographic: parallel projection instead of perspective.
        """
        points = as_points(points, "points")
        if len(points) == 0:
            raise ValueError("points: need at least one point to frame")
        check_number(margin, "margin", 1.0, 100.0)
        check_number(vertical_fov, "vertical_fov", 1.0, 170.0)
        check_number(aspect, "aspect", 0.01, 100.0)
        towards = _unit(np.asarray(_vector(direction, "direction")), f"direction = {direction!r}: must not be zero")
        up = np.array([0.0, 1.0, 0.0]) if abs(towards[1]) < 0.999 else np.array([0.0, 0.0, -1.0])
        right = _unit(np.cross(up, towards), "up lies along the direction")
        upright = np.cross(towards, right)
        x, y, f = (points @ axis for axis in (right, upright, towards))
        smallest = max(1e-3, 1e-6 * float(np.abs(points).max()))
        radius = max(0.5 * float(np.linalg.norm(np.ptp(points, axis=0))), smallest)
        if orthographic:
            height = max(float(np.ptp(y)), float(np.ptp(x)) / aspect, smallest) * margin
            centre = 0.5 * (x.min() + x.max()) * right + 0.5 * (y.min() + y.max()) * upright
            centre = centre + 0.5 * (f.min() + f.max()) * towards
            eye = centre + (2.0 * radius) * towards
            return cls(eye, centre, tuple(up), vertical_fov, height, near=1e-3 * radius)  # type: ignore[arg-type]
        # A point fits when |x - cx| <= slope (d - f) with the eye at (cx, cy, d): the two outermost planes on each
        # axis give its centre and distance at once.
        slope_y = math.tan(0.5 * math.radians(vertical_fov)) / margin
        slope_x = slope_y * aspect
        low_x, high_x = (-x + slope_x * f).max(), (x + slope_x * f).max()
        low_y, high_y = (-y + slope_y * f).max(), (y + slope_y * f).max()
        distance = max((low_x + high_x) / (2.0 * slope_x), (low_y + high_y) / (2.0 * slope_y))
        distance = max(distance, f.max() + 0.05 * radius)
        middle = 0.5 * (f.min() + f.max())
        centre = 0.5 * (high_x - low_x) * right + 0.5 * (high_y - low_y) * upright
        return cls(
            centre + distance * towards, centre + middle * towards, tuple(up), vertical_fov,  # type: ignore[arg-type]
            near=min(0.01, 0.01 * (distance - middle)),
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class Drawable:
    """A triangle surface with its colours. The front is where its triangles run counter-clockwise.

    Raises:
        ValueError: names the field: wrong shape, vertices that are not finite, ids or colours out of range.
    """

    vertices: ArrayLike
    """(V, 3) [m]."""
    faces: ArrayLike
    """(F, 3) vertex ids."""
    colour: Any = _FIRST_COLOURS[0]
    """(3,) or (F, 3) in [0, 1]."""
    back_colour: Any = None
    """The same for the back side; None: like the front."""
    smooth: bool = True
    """False shows every triangle flat."""
    _arrays: tuple[FloatArray, IntArray] = field(init=False, repr=False)
    _colours: NDArray[np.float32] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        vertices = as_points(self.vertices, "drawable vertices")
        faces = as_faces(self.faces, len(vertices), "drawable faces")
        colours = np.empty((len(faces), 6), np.float32)
        colours[:, :3] = _colours(self.colour, "drawable colour", len(faces))
        back = self.colour if self.back_colour is None else self.back_colour
        colours[:, 3:] = _colours(back, "drawable back_colour", len(faces))
        if not self.smooth:
            vertices = vertices[faces].reshape(-1, 3)
            faces = np.arange(len(vertices), dtype=np.int32).reshape(-1, 3)
        object.__setattr__(self, "_arrays", (vertices, faces))
        object.__setattr__(self, "_colours", colours)

    @cached_property
    def normals(self) -> FloatArray:
        """(V, 3) unit vertex normals, found once; (3 F, 3) of a flat one, whose faces share no vertices."""
        vertices, faces = self._arrays
        normals = np.empty_like(vertices)
        raster.vertex_normals(vertices, faces, normals)
        return normals


@dataclass(frozen=True, eq=False)
class Lines:
    """Thick line segments, for example intersection contours.

    Raises:
        ValueError: names the field.
    """

    segments: ArrayLike
    """(S, 2, 3) [m]."""
    colour: Any = (0.80, 0.05, 0.10)
    width_pixels: float = 2.0
    on_top: bool = False
    """True: never hidden. False: hidden by what is nearer by more than about the line's own width."""

    def __post_init__(self) -> None:
        segments = np.asarray(self.segments, dtype=np.float64)
        if segments.size == 0:
            segments = segments.reshape(0, 2, 3)
        if segments.ndim != 3 or segments.shape[1:] != (2, 3):
            raise ValueError(f"lines segments: expected shape (S, 2, 3), got {segments.shape}")
        points = as_points(segments.reshape(-1, 3), "lines segments")
        object.__setattr__(self, "segments", points.reshape(-1, 2, 3))
        if _colours(self.colour, "lines colour", -1).shape != (3,):
            raise ValueError("lines colour: expected one colour")
        check_number(self.width_pixels, "lines width_pixels", 0.1, 1000.0)


def _image_space(vertices: FloatArray, camera: Camera, width: int, height: int) -> FloatArray:
    image = np.empty((len(vertices), 4))
    raster.project(vertices, camera.matrix(width, height), image)
    return image


def vertex_normals(vertices: ArrayLike, faces: ArrayLike) -> FloatArray:
    """(V, 3) unit normals, the faces around a vertex weighted by area; zero where there is none."""
    vertices = as_points(vertices)
    faces = as_faces(faces, len(vertices))
    normals = np.empty_like(vertices)
    raster.vertex_normals(vertices, faces, normals)
    return normals


def _gather(drawables: Sequence[Drawable]) -> tuple[FloatArray, IntArray]:
    """All surfaces as one."""
    if len(drawables) == 1:
        return drawables[0]._arrays
    starts = np.cumsum([0, *(len(d._arrays[0]) for d in drawables)])
    if not drawables:
        return np.empty((0, 3)), np.empty((0, 3), np.int32)
    return (
        np.concatenate([d._arrays[0] for d in drawables]),
        np.concatenate([d._arrays[1] + np.int32(start) for d, start in zip(drawables, starts)]),
    )


def _background(background: Any, height: int, width: int) -> NDArray[np.float32]:
    """(H, W, 3) float32 picture, and checks."""
    colours = _colours(background, "background", 2)
    picture = np.empty((height, width, 3), np.float32)
    if colours.ndim == 1:
        picture[:] = colours
    else:
        share = np.linspace(0.0, 1.0, height, dtype=np.float32)[:, None]
        picture[:] = (colours[0] + share * (colours[1] - colours[0]))[:, None, :]
    return picture


def _draw_ground(
    ground: float, camera: Camera, background: Any, depth: NDArray[np.float32], picture: NDArray[np.float32]
) -> None:
    height, width = depth.shape
    eye, target = np.asarray(camera.eye), np.asarray(camera.target)
    size = camera.orthographic_height or 2.0 * float(np.linalg.norm(eye - target)) * math.tan(
        0.5 * math.radians(camera.vertical_fov)
    )
    power = 10.0 ** math.floor(math.log10(size / 8.0))
    cell = power * max(step for step in (1.0, 2.0, 5.0) if step * power <= size / 8.0 * (1.0 + 1e-9))
    height_y = float(check_number(ground, "ground", -1e9, 1e9))
    plane = np.array([height_y, cell, camera.near, target[0], target[2], 1.4 * size])
    base = np.asarray(background, dtype=np.float32).reshape(-1, 3)[-1]
    # Cells darker than a light background, lighter than a dark one.
    light = base.mean() > 0.5
    tones = np.stack([t * base if light else base + (1 - t) * (1 - base) for t in (0.80, 0.89)]).astype(np.float32)
    raster.draw_ground(camera.rays(width, height), plane, tones, depth, picture)


def render(
    drawables: Sequence[Drawable],
    camera: Camera,
    width: int,
    height: int,
    lines: Sequence[Lines] = (),
    background: Any = BACKGROUND,
    ground: float | None = None,
    antialias: int = 1,
) -> Image:
    """A picture, the same bit by bit for the same input.

    Args:
        drawables: surfaces.
        camera: the view.
        width, height: [pixel].
        lines: drawn last, in this order.
        background: one colour, or two for the top and the bottom row.
        ground: [m] height y of a softly checkered floor; None for none. It is not seen from below.
        antialias: 2 takes four samples per pixel.

    Returns:
        (H, W, 3) uint8.
    """
    width, height = (int(check_number(v, n, 1, 16384, True)) for v, n in ((width, "width"), (height, "height")))
    check_choice(str(antialias), "antialias", ("1", "2"))
    wide, high = antialias * width, antialias * height
    vertices, faces = _gather(drawables)
    layers = raster.new_layers(1, high, wide)
    picture = _background(background, high, wide)
    if len(faces):
        raster.rasterise(_image_space(vertices, camera, wide, high), faces, camera.near, layers)
        normals = drawables[0].normals if len(drawables) == 1 else np.concatenate([d.normals for d in drawables])
        right, up, forward = camera.basis()
        perspective = camera.orthographic_height is None
        key = -0.65 * forward + 0.65 * up - 0.40 * right
        viewer = np.asarray(camera.eye) if perspective else -forward
        lights = np.stack([viewer, key / np.linalg.norm(key), np.array([float(perspective), 0.0, 0.0])])
        colours = drawables[0]._colours if len(drawables) == 1 else np.concatenate([d._colours for d in drawables])
        raster.shade(vertices, normals, faces, colours, lights, layers, picture)
    if ground is not None:
        _draw_ground(ground, camera, background, layers.depth[0], picture)
    for line in lines:
        _draw_lines(line, camera, antialias, layers.depth[0], picture)
    image = np.empty((height, width, 3), np.uint8)
    raster.resolve(picture, antialias, image)
    return image


def _draw_lines(
    line: Lines, camera: Camera, antialias: int, depth: NDArray[np.float32], picture: NDArray[np.float32]
) -> None:
    height, width = depth.shape
    segments = np.asarray(line.segments)
    ends = _image_space(segments.reshape(-1, 3), camera, width, height).reshape(-1, 2, 4)
    # The surface under a line of some width comes nearer than its middle: let the line win by its own width.
    bias = line.width_pixels * antialias / camera._pixels_per_unit(height)
    fixed, share = (bias, 0.0) if camera.orthographic_height is not None else (0.0, bias)
    stroke = np.array([0.5 * line.width_pixels * antialias, fixed, share, camera.near, float(line.on_top)])
    raster.draw_lines(ends, np.asarray(line.colour, dtype=np.float32), stroke, depth, picture)


def render_depth(
    drawables: Sequence[Drawable],
    camera: Camera,
    width: int,
    height: int,
    ground: float | None = None,
    depth_range: tuple[float, float] | None = None,
) -> Image:
    """Distance from the camera plane as brightness.

    Args:
        drawables, camera, width, height, ground: as for `render`.
        depth_range: [m] distances drawn as 255 and as 1, linear between, clamped outside; None: half and one and a
            half times the distance from the camera to its target.

    Returns:
        (H, W, 1) uint8; 0 where there is nothing.
    """
    width, height = (int(check_number(v, n, 1, 16384, True)) for v, n in ((width, "width"), (height, "height")))
    if depth_range is None:
        reach = float(np.linalg.norm(np.subtract(camera.eye, camera.target)))
        depth_range = (0.5 * reach, 1.5 * reach)
    nearest, farthest = (float(check_number(v, "depth_range", -1e9, 1e9)) for v in depth_range)
    if not nearest < farthest:
        raise ValueError(f"depth_range = {depth_range!r}: expected (near, far) with near < far")
    vertices, faces = _gather(drawables)
    layers = raster.new_layers(1, height, width)
    raster.rasterise(_image_space(vertices, camera, width, height), faces, camera.near, layers)
    depth = layers.depth[0]
    if ground is not None:
        _draw_ground(ground, camera, (1.0, 1.0, 1.0), depth, np.zeros((height, width, 3), np.float32))
    hit = np.isfinite(depth)
    brightness = 255.0 - 254.0 * (np.where(hit, depth, farthest) - nearest) / (farthest - nearest)
    return np.where(hit, np.clip(np.rint(brightness), 1, 255), 0).astype(np.uint8)[:, :, None]


def palette(count: int) -> list[Colour]:
    """Distinct, quiet colours for cloth layers; the first ones never change with the count.

    After eight chosen ones each next colour is the one of 180 that is farthest from all before; then they repeat.
    """
    count = int(check_number(count, "count", 0, 100000, True))
    colours = list(_FIRST_COLOURS[:count])
    free = [
        colorsys.hls_to_rgb(hue / 30.0, lightness, saturation)
        for hue in range(30) for lightness in (0.45, 0.58, 0.70) for saturation in (0.30, 0.50)
    ]  # fmt: skip
    cycle = len(colours) + len(free)
    gaps = np.min(np.linalg.norm(np.subtract(np.array(free)[:, None], _FIRST_COLOURS), axis=-1), axis=1)
    while len(colours) < min(count, cycle):
        farthest = int(gaps.argmax())
        colours.append(free[farthest])
        gaps = np.minimum(gaps, np.linalg.norm(np.subtract(free, free[farthest]), axis=-1))
        gaps[farthest] = -1.0
    return [colours[k % cycle] for k in range(count)]


def _as_image(image: Any, name: str) -> Image:
    """(H, W, 3) uint8 from colour or one-channel images."""
    pixels = np.asarray(image)
    if pixels.ndim == 2:
        pixels = pixels[:, :, None]
    if pixels.dtype != np.uint8 or pixels.ndim != 3 or pixels.shape[2] not in (1, 3) or pixels.size == 0:
        raise ValueError(f"{name}: expected (H, W, 3) or (H, W, 1) uint8, got {pixels.shape} {pixels.dtype}")
    return np.repeat(pixels, 3, axis=2) if pixels.shape[2] == 1 else pixels


def save_png(path: str | Path, image: ArrayLike) -> Path:
    """Writes (H, W, 3) or (H, W, 1) uint8 as PNG, makes missing folders, and returns the path."""
    from PIL import Image as Pillow

    path = Path(path)
    pixels = _as_image(image, "image")
    path.parent.mkdir(parents=True, exist_ok=True)
    Pillow.fromarray(pixels).save(path, format="PNG")
    return path


def tile(images: Sequence[ArrayLike], labels: Sequence[str] | None = None, columns: int | None = None) -> Image:
    """A contact sheet: images row by row in equal cells, each with its label (lines split by a newline) above it.

    Args:
        images: (H, W, 3) or (H, W, 1) uint8, of any sizes.
        labels: one per image, or None.
        columns: None for about a square.
    """
    from PIL import Image as Pillow
    from PIL import ImageDraw, ImageFont

    if not len(images):
        raise ValueError("images: need at least one")
    if labels is not None and len(labels) != len(images):
        raise ValueError(f"labels: expected {len(images)}, got {len(labels)}")
    pictures = [_as_image(image, f"images[{k}]") for k, image in enumerate(images)]
    columns = int(check_number(columns, "columns", 1, 10000, True)) if columns else math.ceil(math.sqrt(len(images)))
    columns = min(columns, len(images))
    rows = -(-len(images) // columns)
    font, gap, line_height = ImageFont.load_default(size=13), 6, 17
    text_height = 0 if labels is None else 4 + line_height * max(label.count("\n") + 1 for label in labels)
    cell_width = max(p.shape[1] for p in pictures) + gap
    cell_height = max(p.shape[0] for p in pictures) + gap + text_height
    sheet = Pillow.new("RGB", (columns * cell_width + gap, rows * cell_height + gap), (255, 255, 255))
    pen = ImageDraw.Draw(sheet)
    for k, picture in enumerate(pictures):
        x, y = gap + (k % columns) * cell_width, gap + (k // columns) * cell_height
        if labels is not None:
            pen.multiline_text((x + 1, y), labels[k], fill=(40, 40, 40), font=font, spacing=3)
        sheet.paste(Pillow.fromarray(picture), (x, y + text_height))
    return np.asarray(sheet)
