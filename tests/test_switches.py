"""Every value of the four switches: against naive loops, differentiable, and refused where it cannot work."""

from itertools import product

import numpy as np
import pytest
import torch

import tapip3d_lite as t3d
from tapip3d_lite.model.cloud import Level
from tapip3d_lite.model.neighbors import Neighbors
from tapip3d_lite.variants.correlation import Correlation
from tapip3d_lite.variants.image_spaces import UV, UVD, UVLogD
from tapip3d_lite.variants.p2n import P2N
from tapip3d_lite.variants.planes import EXTENT, PlaneCorrelation, PlaneNeighborhood, splat
from tapip3d_lite.variants.window2d import WindowNeighborhood
from tests.tiny import SYSTEMS

TINY = {"image_size": (48, 48), "window": 4, "levels": 2, "iterations": 1, "feature_dim": 16, "token_dim": 16}


def config(**changes):
    sizes = TINY | {"neighbors": 9, "context_head_dim": 16, "offset_dim": 8} | changes
    return t3d.TrackerConfig.preset("lite", **sizes)


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def random_level(g, shape=(1, 2, 5, 7), channels=3):
    return Level(
        torch.randn(*shape, channels, generator=g),
        torch.randn(*shape, 3, generator=g),
        torch.rand(shape, generator=g) > 0.2,
    )


def naive_window(cell, count, height, width):
    """The smallest square of cells with `count` of them, without those farthest from its centre; row by row."""
    side = int(np.ceil(np.sqrt(count)))
    steps = [(dv - (side - 1) / 2, du - (side - 1) / 2) for dv, du in product(range(side), repeat=2)]
    kept = sorted(sorted(range(len(steps)), key=lambda i: steps[i][0] ** 2 + steps[i][1] ** 2)[:count])
    for dv, du in (steps[i] for i in kept):
        u, v = (
            min(max(int(np.floor(x + d + 0.5)), 0), n - 1)
            for x, d, n in zip(cell, (du, dv), (width, height), strict=True)
        )
        yield dv**2 + du**2, v * width + u


@pytest.mark.parametrize("exclude", [False, True])
@pytest.mark.parametrize("count", [9, 12, 16, 32])
def test_window_is_the_loop_and_clamps_at_borders(count, exclude):
    level = random_level(generator())
    if exclude:
        level.valid[0, 1] = False  # a frame without depth keeps its cells
    cells = torch.tensor([[2.2, 1.7], [3.0, 2.0], [-3.0, 9.0], [6.4, 0.4]]).expand(1, 2, 4, 2)
    coords = torch.randn(1, 2, 4, 3, generator=generator(1))
    part = config(neighborhood="window", neighbors=count, exclude_invalid=exclude)
    near = WindowNeighborhood(part)(level, coords, cells)
    features, points, valid = level.features.flatten(2, 3), level.points.flatten(2, 3), level.valid.flatten(2, 3)
    for t, n in product(range(2), range(4)):
        pairs = list(naive_window(cells[0, t, n].tolist(), count, 5, 7))
        fine = [i for _, i in sorted(pairs, key=lambda pair: pair[0]) if valid[0, t, i]]
        expected = [i if not exclude or valid[0, t, i] or not fine else fine[0] for _, i in pairs]
        assert near.indices[0, t, n].tolist() == expected
        torch.testing.assert_close(near.features[0, t, n], features[0, t, expected])
        torch.testing.assert_close(near.offsets[0, t, n], points[0, t, expected] - coords[0, t, n])
    inner = near.indices[0, 0, 1].tolist()
    assert exclude or count > 16 or len(set(inner)) == count  # no cell twice, also where the projection is a cell


def test_window_interpolates_for_correlation():
    height, width = 5, 7
    ramp = torch.stack(torch.meshgrid(torch.arange(5.0), torch.arange(7.0), indexing="ij"), -1)[None, None]
    level = Level(ramp, torch.zeros(1, 1, height, width, 3), torch.ones(1, 1, height, width, dtype=torch.bool))
    cells = torch.tensor([[[[3.25, 2.5]]]])
    near = WindowNeighborhood(config(neighborhood="window", context="correlation"))(
        level, torch.zeros(1, 1, 1, 3), cells
    )
    expected = [[2.5 + dv, 3.25 + du] for dv in (-1, 0, 1) for du in (-1, 0, 1)]
    torch.testing.assert_close(near.features[0, 0, 0], torch.tensor(expected))


def test_splat_is_the_loop():
    g = generator(3)
    features, points = torch.randn(2, 30, 4, generator=g), 2 * torch.randn(2, 30, 3, generator=g)
    valid = torch.rand(2, 30, generator=g) > 0.3
    plane = splat(features, points, valid, (1, 2), 6)
    for f in range(2):
        total, count = torch.zeros(6, 6, 4), torch.zeros(6, 6, 1)
        for p in range(30):
            column, row = (round(float((points[f, p, a] / (2 * EXTENT) + 0.5) * 5)) for a in (1, 2))
            if valid[f, p] and 0 <= column < 6 and 0 <= row < 6:
                total[row, column] += features[f, p]
                count[row, column] += 1
        torch.testing.assert_close(plane[f], total / count.clamp(min=1))


def near_and_kept(g, count=9, channels=16, dtype=torch.float32):
    def draw(*shape):
        return torch.randn(*shape, generator=g).to(dtype)

    near = Neighbors(draw(1, 2, 3, count, channels), draw(1, 2, 3, count, 3), draw(1, 2, 3, 3))
    support = Neighbors(draw(1, 3, 1 + count, channels), draw(1, 3, 1 + count, 3), draw(1, 3, 3))
    return near, support


@torch.no_grad()
@pytest.mark.parametrize("ratio", [False, True])
def test_correlation_is_the_loop(ratio):
    torch.manual_seed(0)
    context = Correlation(config(neighborhood="window", context="correlation", space="uvlogd", depth_ratio=ratio))
    near, support = near_and_kept(generator(4))
    out = context(1, context.describe(1, support), near)
    for t, n in product(range(2), range(3)):
        dots = [
            float(support.features[0, n, 1 + k] @ near.features[0, t, n, j]) / 16**0.5
            for k in range(9)
            for j in range(9)
        ]
        depth = [float(near.points[0, t, n, j, 2] - near.center[0, t, n, 2]) for j in range(9)] if ratio else []
        torch.testing.assert_close(out[0, t, n], context.mlps[1](torch.tensor([*dots, *depth])), atol=1e-5, rtol=1e-4)


@torch.no_grad()
def test_p2n_looks_with_the_query_alone():
    torch.manual_seed(0)
    context = P2N(config(context="p2n"))
    near, support = near_and_kept(generator(5))
    near = Neighbors(context.embed.features(near.features), near.points, near.center)
    support = Neighbors(
        support.features, torch.cat([support.center[:, :, None], support.points[:, :, 1:]], 2), support.center
    )
    out = context(0, context.describe(0, support), near)
    for t, n in product(range(2), range(3)):
        query = context.embed.features(support.features[0, n, 0]) + context.embed.offset(0, torch.zeros(3))
        bag = torch.stack(
            [near.features[0, t, n, k] + context.embed.offset(0, near.offsets[0, t, n, k]) for k in range(9)]
        )
        torch.testing.assert_close(
            out[0, t, n], context.looks[0](query[None, None], bag[None])[0, 0], atol=1e-5, rtol=1e-4
        )
    others = Neighbors(support.features.clone(), support.points, support.center)
    others.features[:, :, 1:] = 0
    torch.testing.assert_close(out, context(0, context.describe(0, others), near))  # the neighbourhood does not matter


@torch.no_grad()
def test_plane_correlation_sums_three_planes():
    torch.manual_seed(0)
    part = config(neighborhood="planes", context="planes", space="uvlogd")
    context, planes = PlaneCorrelation(part), PlaneNeighborhood(part)
    level = context.prepare(0, random_level(generator(6), channels=16))
    coords, cells = torch.randn(1, 2, 3, 3, generator=generator(7)), torch.rand(1, 2, 3, 2) * 4
    near = planes(level, coords, cells)
    assert near.features.shape == (1, 2, 3, 27, 16)
    kept = torch.randn(1, 3, 16, generator=generator(8))
    out = context(0, kept, near)
    for t, n, k in product(range(2), range(3), range(9)):
        expected = sum(float(kept[0, n] @ near.features[0, t, n, p * 9 + k]) for p in range(3)) / 4
        assert float(out[0, t, n, k]) == pytest.approx(expected, abs=1e-5)
    # The middle of the (x, z) window reads the splatted plane at the point's own x and z.
    side = level.extra[0].shape[1]
    inner = PlaneNeighborhood(part)(level, torch.zeros(1, 2, 1, 3), cells[:, :, :1])
    middle = (side - 1) / 2
    low, high = int(np.floor(middle)), int(np.ceil(middle))
    expected = level.extra[0][0, [low, low, high, high], [low, high, low, high]].mean(0)
    torch.testing.assert_close(inner.features[0, 0, 0, 9 + 4], expected, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("kind", ["p2n", "correlation", "planes"])
def test_contexts_have_right_gradients(kind):
    torch.manual_seed(0)
    planes = kind == "planes"
    part = config(
        feature_dim=4,
        token_dim=4,
        context_head_dim=4,
        context=kind,
        space="uvlogd",
        neighborhood="knn" if kind == "p2n" else "planes" if planes else "window",
        depth_ratio=kind == "correlation",
    )
    context = {"p2n": P2N, "correlation": Correlation, "planes": PlaneCorrelation}[kind](part).double()
    near, support = near_and_kept(generator(9), count=27 if planes else 9, channels=4, dtype=torch.float64)

    def run(features, support_features, points):
        kept = context.describe(0, Neighbors(support_features, support.points, support.center))
        return context(0, kept, Neighbors(features, points, near.center))

    inputs = [x.clone().requires_grad_() for x in (near.features, support.features, near.points * 0.1)]
    # Loose and with small steps, since the highest Fourier degree turns a step of 1e-6 into a phase of 0.01.
    assert torch.autograd.gradcheck(run, inputs, eps=1e-7, atol=1e-3, rtol=1e-3)


def cameras_of(clip):
    return [torch.from_numpy(x) for x in (clip.intrinsics, clip.extrinsics, clip.depths)]


@pytest.mark.parametrize("space", ["uvlogd", "uvd", "uvd as it is"])
def test_image_spaces_invert(space):
    clip = t3d.simulate_clip(seed=1, frames=3, size=(48, 48), tracks=20)
    k, e, d = cameras_of(clip)
    space = {"uvlogd": UVLogD(), "uvd": UVD().fit(d[:1], e[:1]), "uvd as it is": UVD()}[space]
    xyz = torch.from_numpy(clip.queries[:, 1:]).expand(3, -1, -1)
    coords = space.from_world(xyz[None], k[None], e[None])[0]
    torch.testing.assert_close(space.to_world(coords[None], k[None], e[None], d[None])[0], xyz, atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(space.to_pixels(coords, k, e), t3d.geometry.project(xyz, k, e)[0])
    cloud = space.lift(d[None], k[None], e[None])[0]
    world = space.to_world(cloud[None].flatten(2, 3), k[None], e[None], d[None])[0].unflatten(1, (48, 48))
    torch.testing.assert_close(world, torch.from_numpy(clip.points()), atol=1e-3, rtol=1e-4)


def test_uvd_stretches_each_clips_depth_to_the_width_whatever_the_unit():
    depths = torch.rand(2, 20, 30, generator=generator(2)) * 3 + 1
    depths[1] *= 1000
    depths[:, :3] = 0  # holes
    depths[:, 4, :2] = 1e6  # a little sky does not count
    space = UVD().fit(depths, torch.eye(4)[None])
    third = space.lift(depths[:, None], torch.eye(3).expand(2, 1, 3, 3), torch.eye(4))[..., 2]
    inside = (depths > 0) & (depths < 1e5)
    for b in range(2):
        values = third[b, 0][inside[b]]
        assert float(values.min()) == pytest.approx(0, abs=1e-2)
        assert float(values.max()) == pytest.approx(30, abs=1)
    empty = UVD().fit(torch.zeros(1, 4, 4), torch.eye(4)[None])
    assert torch.isfinite(empty.lift(torch.zeros(1, 1, 4, 4), torch.eye(3), torch.eye(4))).all()


def test_uv_is_lifted_by_the_depth_where_it_ends_and_holes_by_the_nearest_depth():
    clip = t3d.simulate_clip(seed=1, frames=3, size=(48, 48), tracks=20)
    k, e, d = cameras_of(clip)
    coords = torch.tensor([[[10.2, 11.8, 0], [30, 40, 0], [60, -9, 0]]]).expand(3, -1, -1)
    d[:, 38:43, 28:33] = 0
    d[:, 40, 32] = 7.5
    world = UV().to_world(coords, k, e, d)
    z = torch.stack([d[:, 12, 10], torch.full((3,), 7.5), d[:, 0, 47]], -1)
    torch.testing.assert_close(world, t3d.geometry.unproject(coords[..., :2], z, k, e), atol=1e-5, rtol=1e-5)
    assert torch.isfinite(UV().to_world(coords * torch.nan, k, e, d * 0)).sum() == 0  # NaN in, NaN out, no crash


@pytest.mark.parametrize("name", SYSTEMS)
def test_every_system_of_the_paper_tracks_and_learns(name, tmp_path):
    torch.manual_seed(0)
    clip = t3d.simulate_clip(seed=2, frames=6, size=(48, 48), tracks=10)
    tracker = t3d.Tracker(config(**SYSTEMS[name]))
    tracks = tracker.eval().track(clip, support_grid=2)
    assert np.isfinite(tracks.xyz).all()
    # An untrained head hardly moves points, so a point starts where it was asked (uv: where its pixel's depth is).
    own = tracks.xyz[clip.queries[:, 0].astype(int), np.arange(10)]
    assert np.median(np.linalg.norm(own - clip.queries[:, 1:], axis=-1)) < 0.3
    from tapip3d_lite.model.frames import frames_from_clip

    frames = frames_from_clip(clip)
    features = tracker.encoder(frames.rgb)
    loss = sum(
        s.coords.square().sum() for s in tracker.steps(frames, torch.from_numpy(clip.queries)[None], features=features)
    )
    loss.backward()
    missing = [n for n, p in tracker.named_parameters() if p.grad is None and "vis_head" not in n]
    assert missing == [], missing
    t3d.save_weights(tracker, tmp_path / "w.safetensors")
    again = t3d.load_weights(tmp_path / "w.safetensors").track(clip, support_grid=2)
    np.testing.assert_array_equal(again.xyz, tracks.xyz)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"context": "correlation"}, "neighborhood='window'"),
        ({"neighborhood": "planes"}, "planes"),
        ({"context": "planes", "neighborhood": "window"}, "planes"),
        ({"use_features": True, "context": "p2n"}, "use_features"),
        ({"space": "uv", "neighborhood": "planes", "context": "planes"}, "three axes"),
        ({"depth_ratio": True}, "depth_ratio"),
        (
            {"depth_ratio": True, "neighborhood": "window", "context": "correlation", "space": "world"},
            "third axis is depth",
        ),
        ({"space": "moon"}, "space: expected one of"),
    ],
)
def test_impossible_combinations_say_why(changes, message):
    with pytest.raises(ValueError, match=message):
        config(**changes)


def test_temporal_updater_keeps_tracks_apart():
    torch.manual_seed(0)
    tracker = t3d.Tracker(config(updater="temporal")).eval()
    clip = t3d.simulate_clip(seed=2, frames=6, size=(48, 48), tracks=10)
    together = tracker.track(clip, support_grid=0)
    alone = tracker.track(clip, clip.queries[:1], support_grid=0)
    np.testing.assert_allclose(together.xyz[:, :1], alone.xyz, atol=1e-4)


def invalid_share(holes, exclude):
    """Share of invalid cells among the 12 nearest of visible true points at the coarsest of three levels."""
    from dataclasses import replace

    from tapip3d_lite.model.cloud import feature_cloud
    from tapip3d_lite.model.frames import frames_from_clip
    from tapip3d_lite.model.neighbors import knn
    from tapip3d_lite.model.spaces import World

    clip = t3d.simulate_clip(seed=4, frames=4)
    lost = np.random.default_rng(0).random(clip.depths.shape) < holes
    frames = frames_from_clip(replace(clip, depths=np.where(lost, 0, clip.depths), queries=None, tracks=None))
    points = World().lift(frames.depths, frames.intrinsics, frames.extrinsics)
    level = feature_cloud(torch.zeros(1, 4, 1, 32, 32), points, frames.depths > 0, 3)[-1]
    valid = level.valid[0].flatten(1)
    near = knn(torch.from_numpy(clip.tracks.xyz), level.points[0].flatten(1, 2), 12, valid if exclude else None)
    bad = ~valid.gather(1, near.flatten(1)).view(near.shape)
    return float(bad[torch.from_numpy(clip.tracks.visible)].float().mean())


def test_invalid_cells_get_in_only_where_depth_is_sparse():
    assert invalid_share(0.6, exclude=False) < 0.01  # they lie at the camera's centre, far from everything
    assert invalid_share(0.9, exclude=False) > 0.3  # too few true cells are left to fill a neighbourhood
    assert invalid_share(0.9, exclude=True) == 0


@torch.no_grad()
@pytest.mark.parametrize("name", SYSTEMS)
def test_a_rigid_motion_of_scene_and_cameras_moves_the_tracks_with_it(name):
    torch.manual_seed(0)
    tracker = t3d.Tracker(config(**SYSTEMS[name])).eval()
    torch.nn.init.normal_(tracker.updater.head.weight, std=0.002)
    clip = t3d.simulate_clip(seed=2, frames=6, size=(48, 48), tracks=10)
    pose = np.eye(4)
    # In the world only a translation: attention sees offsets by their axes.
    if tracker.config.space != "world":
        rotation, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))
        pose[:3, :3] = rotation * np.linalg.det(rotation)
    pose[:3, 3] = 0.5, -0.25, 1
    pose = pose.astype(np.float32)
    queries = np.concatenate([clip.queries[:, :1], t3d.geometry.transform(clip.queries[:, 1:], pose)], 1)
    moved = t3d.Clip(clip.video, clip.depths, clip.intrinsics, clip.extrinsics @ t3d.geometry.invert(pose))
    options = {"support_grid": 0, "bidirectional": False}
    before, after = tracker.track(clip, clip.queries, **options), tracker.track(moved, queries, **options)
    motion = np.linalg.norm(before.xyz - clip.queries[:, 1:], axis=-1)
    error = np.linalg.norm(after.xyz - t3d.geometry.transform(before.xyz, pose[None]), axis=-1)
    # Random weights amplify a rounded coordinate some hundred times, and in uv one of two equally near pixels is read;
    # in a window a cell on the edge is in or out. The motion of the scene itself is a metre.
    assert np.median(motion) > 0.05
    assert np.median(error) < 5e-3 * np.median(motion)
    assert np.quantile(error, 0.9) < 0.1 * np.median(motion)


class Slow(torch.nn.Module):
    """An updater of one layer that looks at each token alone."""

    def __init__(self, config, inputs):
        super().__init__()
        self.layer = torch.nn.Linear(inputs, 4)

    def forward(self, tokens, active=None):
        return self.layer(tokens) * 1e-3


def test_a_custom_updater_and_a_function_for_one():
    clip = t3d.simulate_clip(seed=2, frames=6, size=(48, 48), tracks=10)
    tracker = t3d.Tracker(config(updater=Slow))
    assert np.isfinite(tracker.track(clip, support_grid=0).xyz).all()
    still = t3d.Tracker(config(updater=lambda tokens, active=None: tokens[..., :4] * 0)).track(clip, support_grid=0)
    np.testing.assert_allclose(still.xyz, np.broadcast_to(clip.queries[:, 1:], still.xyz.shape), atol=1e-5)
    assert tracker.config.to_dict()["updater"] == "tests.test_switches:Slow"
