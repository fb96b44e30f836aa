"""The rasteriser and the shading against rays cast one by one."""

import numpy as np
import pytest

from engram_lab import _town
from engram_lab.town.mesh import Kind, Mesh, MeshBuilder, SurfaceFlag
from engram_lab.town.textures import NoiseFields, sheet

_CAMERA = _town.RenderCamera(60.0, 60.0, 31.5, 23.5, 64, 48, 0.3)
# Looking north: columns right (east), down, forward (north).
_NORTH = np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]])


def _scene() -> tuple[_town.Scene, int]:
    scene = _town.Scene(NoiseFields.of_seed(0).tile())
    return scene, scene.add_texture(sheet(0.5))


def _add(scene: _town.Scene, mesh: Mesh) -> int:
    return scene.add_mesh(
        mesh.vertices, mesh.uv, mesh.textures, mesh.flags, mesh.tint, mesh.glow, mesh.kinds
    )


def _random_quads(rng: np.random.Generator, count: int, texture: int) -> Mesh:
    builder = MeshBuilder()
    for _ in range(count):
        right, up, _ = np.linalg.qr(rng.standard_normal((3, 3)))[0]
        middle = rng.uniform([-6, -2, -4], [6, 14, 4])  # some behind, some across the near plane
        a, b = rng.uniform(0.3, 4, 2)
        corners = [
            middle + s * a * right + t * b * up for s, t in ((-1, -1), (1, -1), (1, 1), (-1, 1))
        ]
        flags = SurfaceFlag.TWO_SIDED if rng.random() < 0.5 else SurfaceFlag.PLAIN
        builder.quad(
            corners, [(0, 1), (1, 1), (1, 0), (0, 0)], texture, Kind(1 + rng.integers(7)), flags
        )
    return builder.build()


def _cast(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Depth and kind along the ray of every pixel centre, by testing every quad."""
    columns, rows = np.meshgrid(np.arange(64), np.arange(48))
    cam = np.stack([(columns - 31.5) / 60, (rows - 23.5) / 60, np.ones((48, 64))], -1)
    rays = cam @ _NORTH.T
    depth, kinds = np.full((48, 64), np.inf), np.full((48, 64), -1)
    for corners, flags, kind in zip(
        mesh.vertices.astype(float), mesh.flags, mesh.kinds, strict=True
    ):
        normal = np.cross(corners[1] - corners[0], corners[3] - corners[0])
        if corners[0] @ normal > 0 and not flags & SurfaceFlag.TWO_SIDED:
            continue
        with np.errstate(divide="ignore"):
            t = (corners[0] @ normal) / (rays @ normal)
        points = rays * t[..., None]
        inside = t > 0
        for k in range(4):
            edge = corners[(k + 1) % 4] - corners[k]
            inside &= (np.cross(edge, points - corners[k]) @ normal) >= 0
        nearer = inside & (t < depth)
        depth[nearer], kinds[nearer] = t[nearer], kind
    return depth, kinds


@pytest.mark.parametrize("seed", range(6))
def test_depth_is_that_of_the_nearest_quad_along_each_ray(seed: int) -> None:
    rng = np.random.default_rng(seed)
    scene, texture = _scene()
    mesh = _random_quads(rng, 40, texture)
    _add(scene, mesh)
    depth, kinds = scene.depth(_CAMERA, _NORTH, np.zeros(3))
    expected, expected_kinds = _cast(mesh)
    # Pixels whose centre lies on an edge to within rounding may go either way.
    differ = (kinds != expected_kinds) | ~np.isclose(depth, expected, rtol=1e-4)
    assert differ.mean() < 0.002


def _light(**changes: object) -> _town.Light:
    values = {
        "sun": np.array([0, 0, 1], np.float32), "vehicle": np.zeros((3, 3), np.float32),
        "sun_power": 0.0, "sky_power": 1.0, "cloud": 0.0, "cloud_x": 0.0, "cloud_y": 0.0,
        "fog_per_m": 0.0, "haze": 1.0, "wet": 0.0, "snow": 0.0, "headlights": 0.0, "windows": 0.0,
        "aureole": 0.5,
    }  # fmt: skip
    return _town.Light.of(**{**values, **changes})


def _floor_and_roof(texture: int, roof: bool, flags: SurfaceFlag = SurfaceFlag.TWO_SIDED) -> Mesh:
    builder = MeshBuilder()
    square = [(0, 1), (1, 1), (1, 0), (0, 0)]
    builder.quad(
        [(-30, -30, 0), (30, -30, 0), (30, 30, 0), (-30, 30, 0)], square, texture, Kind.GROUND
    )
    if roof:
        corners = [(2, 6, 3), (6, 6, 3), (6, 10, 3), (2, 10, 3)]
        builder.quad(corners, square, texture, Kind.BUILDING, flags)
    return builder.build()


def _ground_dimmed(roof_flags: SurfaceFlag, at: tuple[float, float], **light: object) -> float:
    """The ground's luminance at (east, north) with a roof at (4, 8) over that without."""
    eye = np.array([0.0, -4.0, 1.7])
    found = []
    for roof in (False, True):
        scene, texture = _scene()
        _add(scene, _floor_and_roof(texture, roof, roof_flags))
        found.append(scene.render(_CAMERA, _NORTH, eye, _light(**light))[0][0])
    forward, down = at[1] - eye[1], eye[2]
    column = round(31.5 + 60 * (at[0] - eye[0]) / forward)
    row = round(23.5 + 60 * down / forward)
    return float(found[1][row, column] / found[0][row, column])


def test_a_roof_throws_its_shadow_where_the_sun_sends_it() -> None:
    sun = np.array([0.6, 0.0, 0.8], np.float32)  # from the east: shadows lie 0.75 h to the west
    roof = SurfaceFlag.TWO_SIDED
    # Under the sun's ray through the roof's middle; half of the light is haze's.
    assert _ground_dimmed(roof, (4 - 2.25, 8.0), sun=sun, sun_power=3.0) < 0.65
    assert _ground_dimmed(roof, (-2.5, 8.0), sun=sun, sun_power=3.0) > 0.95
    assert _ground_dimmed(roof, (-1.5, 4.0), sun=sun, sun_power=3.0) > 0.95


def test_a_roof_hides_the_sky_from_the_ground_below_and_a_slender_thing_does_not() -> None:
    sun = np.array([0.6, 0.0, 0.8], np.float32)
    slender = SurfaceFlag.TWO_SIDED | SurfaceFlag.SLENDER
    assert _ground_dimmed(SurfaceFlag.TWO_SIDED, (4.0, 8.0)) < 0.8
    assert _ground_dimmed(slender, (4.0, 8.0)) == pytest.approx(1.0, abs=1e-6)
    assert _ground_dimmed(slender, (4 - 2.25, 8.0), sun=sun, sun_power=3.0) < 0.8  # a shadow, still


def test_the_right_eye_sees_things_further_left() -> None:
    scene, texture = _scene()
    builder = MeshBuilder()
    corners = [(-0.5, 6, -0.5), (0.5, 6, -0.5), (0.5, 6, 0.5), (-0.5, 6, 0.5)]
    builder.quad(corners, [(0, 1), (1, 1), (1, 0), (0, 0)], texture, Kind.BUILDING)
    _add(scene, builder.build())
    _, inverse_depths = scene.render(_CAMERA, _NORTH, np.zeros(3), _light())
    middles = [np.mean(np.nonzero(inverse_depth > 0.1)[1]) for inverse_depth in inverse_depths]
    assert middles[0] - middles[1] == pytest.approx(60 * 0.3 / 6, abs=0.6)  # whole pixels


def test_the_right_eye_turns_as_calibration_left_it() -> None:
    scene, texture = _scene()
    builder = MeshBuilder()
    corners = [(-1, 6, -1), (1, 6, -1), (1, 6, 1), (-1, 6, 1)]
    builder.quad(corners, [(0, 1), (1, 1), (1, 0), (0, 0)], texture, Kind.BUILDING)
    _add(scene, builder.build())
    middles = []
    for turn in ((0.0, 0.0, 0.0), (0.0, 4 / 60, 0.0), (4 / 60, 0.0, 0.0)):
        camera = _town.RenderCamera(60.0, 60.0, 31.5, 23.5, 64, 48, 0.3, turn)
        seen = scene.render(camera, _NORTH, np.zeros(3), _light())[1]
        middles.append([np.mean(np.nonzero(eye > 0.1), axis=1) for eye in seen])
    for changed in middles[1:]:
        np.testing.assert_array_equal(changed[0], middles[0][0])
    moved = [changed[1] - middles[0][1] for changed in middles[1:]]
    assert moved[0] == pytest.approx([0, -4], abs=0.6)  # further left: a larger disparity
    assert moved[1] == pytest.approx([4, 0], abs=0.6)


def test_wet_ground_mirrors_what_stands_there() -> None:
    """A bright wall is seen in the water before it, and nothing of it beside it."""
    eye, found = np.array([0.0, 0.0, 1.5]), {}
    for wall in (False, True):
        scene, texture = _scene()
        bright = scene.add_texture(sheet(0.9, 1.0))
        _add(scene, _floor_and_roof(texture, roof=False))
        if wall:
            builder = MeshBuilder()
            corners = [(-2, 12, 0), (2, 12, 0), (2, 12, 4), (-2, 12, 4)]
            square = [(0, 1), (1, 1), (1, 0), (0, 0)]
            builder.quad(corners, square, bright, Kind.BUILDING, glow=30.0)
            _add(scene, builder.build())
        light = _light(wet=1.0, mirrors=1.0, windows=1.0)
        found[wall] = scene.render(_CAMERA, _NORTH, eye, light)[0][0]
    gain = found[True] - found[False]
    row = round(23.5 + 60 * 1.5 / 9)  # the ground 9 m ahead: its mirrored ray meets the wall
    assert gain[row, 28:36].min() > 0.5
    assert np.abs(gain[row, :12]).max() < 0.05
    without = scene.render(_CAMERA, _NORTH, eye, _light(wet=1.0, windows=1.0))[0][0]
    np.testing.assert_array_equal(found[True][:16], without[:16])  # nothing above the ground


def test_bad_meshes_are_refused() -> None:
    scene, texture = _scene()
    good = _random_quads(np.random.default_rng(1), 3, texture)
    for name, value, words in (
        ("textures", good.textures + 99, "texture number"),
        ("uv", good.uv[:2], "uv must"),
        ("tint", good.tint[:1], "length N"),
        ("vertices", good.vertices * np.float32(np.nan), "not finite"),
    ):
        fields = {key: getattr(good, key) for key in Mesh.__slots__}
        with pytest.raises(ValueError, match=words):
            _add(scene, Mesh(**{**fields, name: value}))
    with pytest.raises(ValueError, match="no such mesh"):
        scene.remove_mesh(0)


def test_what_is_in_use_or_gone_cannot_be_removed() -> None:
    scene, texture = _scene()
    mesh = _add(scene, _random_quads(np.random.default_rng(1), 3, texture))
    with pytest.raises(ValueError, match="on a mesh"):
        scene.remove_texture(texture)
    scene.remove_mesh(mesh)
    with pytest.raises(ValueError, match="no such mesh"):
        scene.remove_mesh(mesh)
    scene.remove_texture(texture)
    for gone in (texture, -1, 99):
        with pytest.raises(ValueError, match="no such texture"):
            scene.remove_texture(gone)
    scene.render(_CAMERA, _NORTH, np.zeros(3), _light())
    texture = scene.add_texture(sheet(0.5))
    again = _random_quads(np.random.default_rng(2), 3, texture)
    assert _add(scene, again) != _add(scene, again)


def test_moving_things_take_their_textures_with_them() -> None:
    scene, texture = _scene()
    moving = _random_quads(np.random.default_rng(1), 3, texture)
    fields = (moving.vertices, moving.uv, moving.textures, moving.flags, moving.tint, moving.glow)
    scene.set_moving(*fields, moving.kinds)
    with pytest.raises(ValueError, match="on a mesh"):
        scene.remove_texture(texture)
    scene.set_moving(*(field[:0] for field in fields), moving.kinds[:0])
    scene.remove_texture(texture)


@pytest.mark.parametrize("threads", [0, -1, 257, 2**30])
def test_threads_are_not_without_number(threads: int) -> None:
    scene, _ = _scene()
    with pytest.raises(ValueError, match="1 to 256"):
        scene.render(_CAMERA, _NORTH, np.zeros(3), _light(), threads)


def test_what_is_not_finite_is_refused() -> None:
    scene, texture = _scene()
    good = _random_quads(np.random.default_rng(1), 3, texture)
    for name in ("uv", "tint", "glow"):
        fields = {key: getattr(good, key) for key in Mesh.__slots__}
        fields[name] = np.full_like(fields[name], np.inf)
        with pytest.raises(ValueError, match="finite"):
            _add(scene, Mesh(**fields))
    for change in ({"sun": np.full(3, np.nan, np.float32)}, {"fog_per_m": np.nan}):
        with pytest.raises(ValueError, match="light: must be finite"):
            _light(**change)
    with pytest.raises(ValueError, match="lamps must be finite"):
        scene.set_lamps(np.full((1, 5), np.nan, np.float32))
    camera = _town.RenderCamera(60.0, 60.0, np.nan, 23.5, 64, 48, 0.3)
    with pytest.raises(ValueError, match="camera: must be finite"):
        scene.render(camera, _NORTH, np.zeros(3), _light())
