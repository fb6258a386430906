"""Solid textures and toy meshes: in range, smooth, distinct; closed, outward, small, compiled by MuJoCo."""

from collections import Counter

import mujoco
import numpy as np
import pytest

from tapip3d_lite.simulate.meshes import MESHES
from tapip3d_lite.simulate.textures import KINDS, random_sky, random_texture


def points(count=4096, reach=0.6, seed=0):
    return np.random.default_rng(seed).uniform(-reach, reach, (count, 3)).astype(np.float32)


@pytest.mark.parametrize("kind", KINDS)
def test_textures_are_colours_drawn_from_the_seed(kind):
    for seed in range(4):
        first, again, other = (random_texture(np.random.default_rng(s), kind) for s in (seed, seed, seed + 100))
        color = first(points())
        assert color.dtype == np.float32 and color.shape == (4096, 3)
        assert color.min() >= 0 and color.max() <= 1
        np.testing.assert_array_equal(color, again(points()))
        assert np.abs(color - other(points())).mean() > 0.02
        assert color.std(0).max() > 0.03, "a uniform colour cannot be tracked"


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("flat", [False, True])
def test_no_jumps_nor_edges_finer_than_a_pixel(kind, flat):
    rng = np.random.default_rng(5)
    p = points(8000) * ((1, 1, 0) if flat else (1, 1, 1))
    step = rng.normal(size=p.shape) * ((1, 1, 0) if flat else (1, 1, 1))
    step *= 0.004 / np.linalg.norm(step, axis=-1, keepdims=True)
    for _ in range(4):
        texture = random_texture(rng, kind, flat=flat)
        change = np.abs(texture(p + step) - texture(p)).max(-1)
        assert change.max() < 0.3 and np.quantile(change, 0.99) < 0.2
        tiny = np.abs(texture(p + step / 16) - texture(p)).max(-1)
        assert tiny.max() < 0.06, "a jump: the colour is not continuous"


def power_beyond(values, spacing, length):
    """Share of the variance of lines (n, samples) in waves shorter than `length`."""
    spectrum = np.abs(np.fft.rfft((values - values.mean(-1, keepdims=True)) * np.hanning(values.shape[-1]))) ** 2
    return spectrum[:, np.fft.rfftfreq(values.shape[-1], spacing) > 1 / length].sum() / spectrum.sum()


@pytest.mark.parametrize("kind", KINDS)
def test_patterns_are_not_noise(kind):
    rng, along = np.random.default_rng(3), np.linspace(-1, 1, 512)
    lines = []
    for _ in range(8):
        start, end = rng.normal(size=(2, 3)) * 0.6
        lines.append(random_texture(rng, kind)(start + along[:, None] * end / np.linalg.norm(end)).mean(-1))
    assert power_beyond(np.array(lines), along[1] - along[0], 0.08) < 0.1
    noise = np.random.default_rng(0).uniform(size=(8, 512))
    assert power_beyond(noise, along[1] - along[0], 0.08) > 0.5


def test_kinds_are_distinct():
    p = points(2048)
    colors = np.stack([random_texture(np.random.default_rng(7), kind)(p).ravel() for kind in KINDS])
    assert len(KINDS) >= 8
    difference = np.abs(colors[:, None] - colors[None]).mean(-1)
    assert difference[~np.eye(len(KINDS), dtype=bool)].min() > 0.03


def test_scale_enlarges():
    small, large = (random_texture(np.random.default_rng(2), "dots", scale=s) for s in (1.0, 3.0))
    np.testing.assert_allclose(large(3 * points()), small(points()), atol=1e-3)


def test_repeated_cells_differ():
    """The tint tells the cells of a regular pattern apart: no shift by whole periods maps a checker onto itself."""
    p = points(2000, reach=0.3)
    for seed in range(5):
        texture = random_texture(np.random.default_rng(seed), "checker", flat=True)
        shifts = [
            (a, b, 0) for a in np.linspace(-1, 1, 21) for b in np.linspace(-1, 1, 21) if max(abs(a), abs(b)) > 0.3
        ]
        base = texture(p)
        assert min(np.abs(texture(p + np.array(s)) - base).mean() for s in shifts[::3]) > 0.015


def test_sky_is_soft_and_lighter_than_the_ground():
    rng = np.random.default_rng(0)
    d = rng.normal(size=(5000, 3))
    d /= np.linalg.norm(d, axis=-1, keepdims=True)
    for _ in range(6):
        drawn = random_sky(rng)
        color = drawn(d)
        assert color.dtype == np.float32 and color.min() >= 0 and color.max() <= 1
        assert color[d[:, 2] > 0.05].mean() > color[d[:, 2] < -0.1].mean()
        assert np.abs(drawn(d + 1e-3) - color).max() < 0.06
    first, again = (random_sky(np.random.default_rng(1))(d) for _ in range(2))
    np.testing.assert_array_equal(first, again)


def corners(mesh):
    vertices, faces = mesh
    return vertices[faces[:, 0]], vertices[faces[:, 1]], vertices[faces[:, 2]]


def volume(mesh):
    a, b, c = corners(mesh)
    return float(np.einsum("fi,fi->", a, np.cross(b, c)) / 6)


def is_closed(faces):
    edges = Counter((int(f[i]), int(f[(i + 1) % 3])) for f in faces for i in range(3))
    return all(n == 1 and edges[(b, a)] == 1 for (a, b), n in list(edges.items()))


@pytest.mark.parametrize("name", MESHES)
def test_meshes_are_closed_outward_and_small(name):
    for seed in range(5):
        vertices, faces = mesh = MESHES[name](np.random.default_rng(seed))
        assert vertices.dtype == np.float64 and faces.dtype == np.int32 and len(faces) <= 600
        assert set(faces.ravel()) == set(range(len(vertices)))
        assert is_closed(faces) and not is_closed(faces[1:])
        assert 0.05 < volume(mesh) < 4 * np.pi / 3
        assert volume((vertices, faces[:, ::-1])) < 0
        assert 0.7 < np.linalg.norm(vertices, axis=-1).max() < 1.45
        a, b, c = corners(mesh)
        assert np.linalg.norm(np.cross(b - a, c - a), axis=-1).min() > 1e-5, "a face without area"
        weights = np.einsum("fi,fi->f", a, np.cross(b, c)) / 6
        np.testing.assert_allclose((weights[:, None] * (a + b + c) / 4).sum(0), 0, atol=1e-9)


@pytest.mark.parametrize("name", MESHES)
def test_mujoco_compiles_meshes_and_agrees_on_the_volume(name):
    mesh = MESHES[name](np.random.default_rng(1))
    spec = mujoco.MjSpec()
    asset = spec.add_mesh(name="toy")
    asset.uservert, asset.userface = mesh[0].ravel(), mesh[1].ravel()
    asset.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_EXACT
    spec.worldbody.add_body().add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="toy", density=1.0)
    np.testing.assert_allclose(spec.compile().body_mass[1], volume(mesh), rtol=1e-3)
