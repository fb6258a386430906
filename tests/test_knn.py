"""Neighbours found in organised maps equal brute force, index by index, on every kind of map and query."""

from pathlib import Path

import numpy as np
import pytest
import torch

import tapip3d_lite as t3d
from tapip3d_lite.model.cloud import Level, feature_cloud
from tapip3d_lite.model.frames import frames_from_clip
from tapip3d_lite.model.neighbors import KNearest, knn
from tapip3d_lite.model.registry import make_space
from tapip3d_lite.model.spaces import fitted
from tapip3d_lite.speed import box_knn as organized
from tapip3d_lite.speed.box_knn import BlockTree, BoxKNearest, run_knn

SAMPLES = sorted((Path(__file__).resolve().parents[1] / "data_samples").glob("*.npz"))


def rays(g, height, width, frames=2):
    """(F, h, w, 3), directions of a pinhole's pixels, turned at random."""
    v, u = torch.meshgrid(torch.linspace(-0.7, 0.7, height), torch.linspace(-0.9, 0.9, width), indexing="ij")
    turn = torch.linalg.qr(torch.randn(frames, 3, 3, generator=g)).Q
    return torch.stack([u, v, torch.ones_like(u)], -1) @ turn[:, None]


def wall(g, height, width):
    return 2 * rays(g, height, width)


def slanted(g, height, width):
    directions = rays(g, height, width)
    normal = directions[:, height // 2, width // 2] + 0.97 * torch.randn(2, 3, generator=g)
    cosine = (directions * normal[:, None, None]).sum(-1, keepdim=True)
    return directions / (cosine.abs() + 0.02)  # grazing: some cells fly far away


def rough(g, height, width):
    return rays(g, height, width) * torch.rand(2, height, width, 1, generator=g).add(0.1)


def thin(g, height, width):
    depth = torch.where(torch.arange(width) % 9 == 4, 0.6, 3.0)[:, None]
    return rays(g, height, width) * depth


def holes(g, height, width):
    points = wall(g, height, width)
    return points * (torch.rand(2, height, width, 1, generator=g) < 0.6)  # cells without depth lie at the centre


def lattice(g, height, width):
    return (4 * wall(g, height, width)).round()  # many exact ties


def one_point(g, height, width):
    return torch.ones(2, height, width, 3)


def tiny(g, height, width):
    return 1e-22 * rough(g, height, width)  # squares underflow


def far_away(g, height, width):
    return rough(g, height, width) + 1e4  # rounding eats the differences


def huge(g, height, width):
    return 1e19 * rough(g, height, width)  # squares overflow


CLOUDS = [wall, slanted, rough, thin, holes, lattice, one_point, tiny, far_away, huge]


def adversarial_queries(g, points, count=40):
    """On cells, near them, at the camera, behind it, off-screen and out in space: (F, N, 3)."""
    flat = points.flatten(1, 2)
    size = flat.abs().amax().clamp(min=1e-30)
    at = flat[:, torch.randint(flat.shape[1], (count,), generator=g)]
    noise = torch.randn(at.shape, generator=g)
    edge = points[:, 0, :1].repeat(1, 4, 1) * torch.tensor([1.0, 1.1, 2.0, 30.0])[:, None]
    groups = [at, at + 0.03 * size * noise, at + 0.3 * size * noise, -at, 0.7 * at, 100 * size * noise]
    return torch.cat([*groups, edge, torch.zeros(2, 1, 3), at.round()], 1)


@pytest.mark.parametrize("masked", [False, True], ids=["all cells", "some cells"])
@pytest.mark.parametrize("cloud", CLOUDS, ids=lambda f: f.__name__)
@pytest.mark.parametrize("size", [(40, 56), (33, 47), (7, 5)], ids=str)
def test_equal_to_brute_force_on_adversarial_clouds(cloud, size, masked):
    g = torch.Generator().manual_seed(sum(size) + masked)
    points = cloud(g, *size)
    valid = torch.rand(2, *size, generator=g) < 0.5 if masked else None
    queries = adversarial_queries(g, points)
    for count in (1, 9, 32):
        expected = knn(queries, points.flatten(1, 2), count, None if valid is None else valid.flatten(1))
        assert torch.equal(BlockTree.build(points, valid).knn(queries, count), expected)


@pytest.mark.parametrize("seed", range(20))
def test_equal_to_brute_force_on_random_sizes(seed):
    g = torch.Generator().manual_seed(seed)
    height, width, frames, number = (int(torch.randint(1, top, (), generator=g)) for top in (60, 80, 4, 300))
    smooth = torch.randn(frames, height, width, 3, generator=g).cumsum(1).cumsum(2) / 30
    valid = torch.rand(frames, height, width, generator=g) < torch.rand((), generator=g) if seed % 2 else None
    queries = 3 * torch.randn(frames, number, 3, generator=g)
    count = int(torch.randint(1, min(height * width, 150) + 1, (), generator=g))
    expected = knn(queries, smooth.flatten(1, 2), count, None if valid is None else valid.flatten(1))
    assert torch.equal(BlockTree.build(smooth, valid).knn(queries, count), expected)


def test_fewer_cells_than_asked_for():
    points, valid = wall(torch.Generator().manual_seed(0), 40, 40), torch.zeros(2, 40, 40, dtype=torch.bool)
    valid[0, 17, 23] = valid[0, 39, 39] = True
    queries = points[:, 20, 20:23]
    expected = knn(queries, points.flatten(1, 2), 5, valid.flatten(1))
    assert torch.equal(BlockTree.build(points, valid).knn(queries, 5), expected)
    assert (expected[1] == 0).all() and set(expected[0].unique().tolist()) == {17 * 40 + 23, 39 * 40 + 39}
    with pytest.raises(ValueError, match="1601 neighbours among 1600"):
        BlockTree.build(points).knn(queries, 1601)


@pytest.mark.parametrize("name", ["uvd", "uvlogd", "camera", "world", "first"])
@pytest.mark.parametrize("path", SAMPLES, ids=lambda p: p.stem)
def test_equal_to_brute_force_on_every_sample(path, name):
    clip = t3d.load_clip(path)
    clip = clip.cut(len(clip) // 2, len(clip) // 2 + 3)
    frames = frames_from_clip(clip)
    space = fitted(make_space(name), frames)
    points = space.lift(frames.depths, frames.intrinsics, frames.extrinsics)
    known = frames.depths > 0
    truth = torch.from_numpy(clip.tracks.xyz)[None]
    g = torch.Generator().manual_seed(0)
    queries = space.from_world(
        truth + 0.02 * torch.randn(truth.shape, generator=g), frames.intrinsics, frames.extrinsics
    )
    maps = torch.zeros(1, 3, 1, clip.size[0] // 2, clip.size[1] // 2)
    for level in feature_cloud(maps, points, known, 4):
        cells, valid = level.points[0], level.valid[0]
        count = min(32, cells.shape[1] * cells.shape[2])
        for mask in (None, valid) if bool((~known).any()) else (None,):
            expected = knn(queries[0], cells.flatten(1, 2), count, None if mask is None else mask.flatten(1))
            assert torch.equal(BlockTree.build(cells, mask).knn(queries[0], count), expected)


def test_the_proof_is_needed_and_widening_works(monkeypatch):
    """With the proof switched off answers are wrong, so the tests above do see what it does."""
    g = torch.Generator().manual_seed(1)
    points = rough(g, 64, 64)
    queries = adversarial_queries(g, points)
    expected, tree = knn(queries, points.flatten(1, 2), 32), BlockTree.build(points)
    assert torch.equal(tree.knn(queries, 32), expected)
    nearest, rounds = BlockTree._nearest, []
    monkeypatch.setattr(BlockTree, "_nearest", lambda self, *a: rounds.append(a[-1]) or nearest(self, *a))
    tree.knn(queries, 32)
    assert len({tuple(opened) for opened in rounds}) >= 3
    monkeypatch.setattr(BlockTree, "_nearest", lambda self, *a: (nearest(self, *a)[0], torch.ones(len(a[0])) > 0))
    assert not torch.equal(tree.knn(queries, 32), expected)


def test_chunks_do_not_matter(monkeypatch):
    g = torch.Generator().manual_seed(2)
    points = slanted(g, 48, 48)
    queries = adversarial_queries(g, points)
    whole = BlockTree.build(points).knn(queries, 16)
    monkeypatch.setattr(organized, "_BUDGET", 1000)
    assert torch.equal(BlockTree.build(points).knn(queries, 16), whole)


@pytest.mark.parametrize("exclude", [False, True])
def test_the_tracker_searches_trees_where_that_pays(exclude, monkeypatch):
    g = torch.Generator().manual_seed(3)
    points = holes(g, 32, 32)[None]
    level = Level(torch.randn(1, 2, 32, 32, 4, generator=g), points, points.abs().sum(-1) > 0)
    config = t3d.TrackerConfig.preset("lite", exclude_invalid=exclude, neighbors=9)
    coords = adversarial_queries(g, points[0])[None]
    brute, part = KNearest(config)(level, coords, None), BoxKNearest(config)
    monkeypatch.setattr(organized, "_FEW", 10**9)
    few = part(level, coords, None)
    assert torch.equal(few.indices, brute.indices) and not level.memory
    monkeypatch.setattr(organized, "_FEW", 0)
    fast = part(level, coords, None)
    assert isinstance(level.memory["boxes"], BlockTree) and not level.cut(0, 1).memory
    for name in ("features", "points", "indices"):
        assert torch.equal(getattr(fast, name), getattr(brute, name))


def test_what_the_tree_leaves_to_brute_force():
    g = torch.Generator().manual_seed(4)
    points = wall(g, 40, 40)
    assert BlockTree.build(points.double()) is None
    points[0, 3, 3] = np.nan
    assert BlockTree.build(points) is None


@pytest.mark.parametrize("masked", [False, True], ids=["all cells", "some cells"])
@pytest.mark.parametrize("cloud", CLOUDS, ids=lambda f: f.__name__)
@pytest.mark.parametrize("size", [(32, 32), (33, 40), (7, 5)], ids=str)
def test_runs_of_cells_as_on_a_gpu_equal_brute_force(size, cloud, masked):
    g = torch.Generator().manual_seed(5)
    points = cloud(g, *size)
    queries, flat = adversarial_queries(g, points), points.flatten(1, 2)
    valid = torch.rand(flat.shape[:2], generator=g) < 0.3 if masked else None
    assert torch.equal(run_knn(queries, flat, 9, valid), knn(queries, flat, 9, valid))
