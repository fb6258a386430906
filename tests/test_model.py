"""Every operation of the model against a naive loop, on random sizes."""

import math

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from tapip3d_lite.model.blocks import DEGREES, Attention, Block, Pool, _constant, constant, fourier, time_embedding
from tapip3d_lite.model.cloud import Level, Normalizer, feature_cloud, nearest_exact, quantile_roi
from tapip3d_lite.model.config import TrackerConfig
from tapip3d_lite.model.n2n import N2N, PairAttention
from tapip3d_lite.model.neighbors import KNearest, Neighbors, bilinear, knn
from tapip3d_lite.model.updater import Transformer, token_width, trajectory_tokens
from tests.tiny import SMALL


@pytest.fixture(params=range(3))
def rng(request):
    return torch.Generator().manual_seed(request.param)


def rand(rng, *shape):
    return torch.randn(*shape, generator=rng)


def integer(rng, low, high):
    return int(torch.randint(low, high, (), generator=rng))


# --- neighbours ---------------------------------------------------------------------------------------------------


def naive_knn(query, points, count, valid):
    """Sort (distance, index) pairs; the nearest fills up."""
    pairs = sorted(
        (float(((query - point) ** 2).sum()), i) for i, point in enumerate(points) if valid is None or valid[i]
    )
    best = [i for _, i in pairs[:count]]
    return best + [best[0] if best else 0] * (count - len(best))


@pytest.mark.parametrize("lattice", [False, True])
@pytest.mark.parametrize("masked", [False, True])
def test_knn_is_exact_and_ties_go_to_the_lowest_index(rng, lattice, masked):
    frames, total, count, queries = 2, integer(rng, 8, 40), integer(rng, 1, 8), 5
    points, x = rand(rng, frames, total, 3), rand(rng, frames, queries, 3)
    if lattice:  # integers: many exact ties
        points, x = points.round(), x.round()
    valid = torch.rand(frames, total, generator=rng) < 0.6 if masked else None
    indices = knn(x, points, count, valid)
    for f in range(frames):
        for n in range(queries):
            expected = naive_knn(x[f, n], points[f], count, None if valid is None else valid[f])
            assert indices[f, n].tolist() == expected


def test_knn_with_fewer_valid_points_than_k_repeats_the_nearest():
    points = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0]]])
    valid = torch.tensor([[False, True, False, True]])
    assert knn(torch.tensor([[[2.9, 0, 0]]]), points, 4, valid).tolist() == [[[3, 1, 3, 3]]]
    assert knn(torch.tensor([[[2.9, 0, 0]]]), points, 2, ~valid & False).tolist() == [[[0, 0]]]
    with pytest.raises(ValueError, match="5 neighbours among 4"):
        knn(points, points, 5)


def test_knn_does_not_depend_on_its_chunks(rng, monkeypatch):
    x, points = rand(rng, 2, 9, 3), rand(rng, 2, 30, 3)
    whole = knn(x, points, 4)
    monkeypatch.setattr("tapip3d_lite.model.neighbors._BUDGET", 100)
    assert torch.equal(knn(x, points, 4), whole)


def test_nearest_cells_are_gathered_per_frame_and_may_leave_out_invalid_ones(rng):
    level = Level(rand(rng, 2, 3, 4, 5, 8), rand(rng, 2, 3, 4, 5, 3), torch.rand(2, 3, 4, 5, generator=rng) < 0.5)
    coords = rand(rng, 2, 3, 6, 3)
    for exclude in (False, True):
        near = KNearest(TrackerConfig(**SMALL, exclude_invalid=exclude))(level, coords, coords[..., :2])
        features, points, valid = level.features.flatten(2, 3), level.points.flatten(2, 3), level.valid.flatten(2, 3)
        for b, s, n in np.ndindex(2, 3, 6):
            index = near.indices[b, s, n]
            assert torch.equal(near.features[b, s, n], features[b, s, index])
            assert torch.equal(near.offsets[b, s, n], points[b, s, index] - coords[b, s, n])
            assert not exclude or bool(valid[b, s, index].all())


# --- cloud --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("source", "target"), [(60, 7), (96, 24), (384, 48), (33, 8), (5, 5), (92, 11)])
def test_points_come_from_the_nearest_exact_pixel(source, target):
    line = torch.arange(source, dtype=torch.float32)[None, None]
    expected = F.interpolate(line, target, mode="nearest-exact")[0, 0].long()
    assert nearest_exact(source, target, line.device).tolist() == expected.tolist()


def test_points_of_60_rows_at_7():
    assert nearest_exact(60, 7, torch.device("cpu")).tolist() == [4, 12, 21, 30, 38, 47, 55]


def test_features_are_averaged_and_points_are_not(rng):
    features, points = rand(rng, 1, 2, 4, 5, 7), rand(rng, 1, 2, 20, 28, 3)
    valid = torch.rand(1, 2, 20, 28, generator=rng) < 0.7
    cloud = feature_cloud(features, points, valid, 2)
    assert [tuple(level.points.shape[2:4]) for level in cloud] == [(5, 7), (2, 3)]
    for y, x in np.ndindex(2, 3):
        mean = features[0, 1, :, 2 * y : 2 * y + 2, 2 * x : 2 * x + 2].mean((-1, -2))
        assert torch.allclose(cloud[1].features[0, 1, y, x], mean, atol=1e-6)
    rows, columns = nearest_exact(20, 2, valid.device), nearest_exact(28, 3, valid.device)
    assert torch.equal(cloud[1].points[0, 1, 1, 2], points[0, 1, rows[1], columns[2]])
    assert bool(cloud[1].valid[0, 1, 1, 2]) == bool(valid[0, 1, rows[1], columns[2]])


@pytest.mark.parametrize("mode", ["isotropic", "anisotropy", "none"])
def test_normaliser_uses_valid_points_only(rng, mode):
    points = rand(rng, 2, 3, 4, 5, 3) * torch.tensor([1.0, 2, 3]) + 5
    valid = torch.rand(2, 3, 4, 5, generator=rng) < 0.5
    norm = Normalizer.fit(points, valid, mode, 1.5)
    for b in range(2):
        chosen = np.array([points[b][i].tolist() for i in np.ndindex(3, 4, 5) if valid[b][i]])
        mean = chosen.mean(0)
        std = {
            "isotropic": np.sqrt(((chosen - mean) ** 2).mean()),
            "anisotropy": np.sqrt(((chosen - mean) ** 2).mean(0)),
        }
        expected = chosen if mode == "none" else (chosen - mean) / std[mode] * 1.5
        np.testing.assert_allclose(norm.normalize(points)[b][valid[b]], expected, atol=1e-5)
    assert torch.allclose(norm.restore(norm.normalize(points)), points, atol=1e-5)
    with pytest.raises(ValueError, match="depth_roi"):
        Normalizer.fit(points, valid & False)


def test_region_of_interest_is_counted_from_sorted_depths(rng):
    depths = torch.cat([torch.rand(97, generator=rng), torch.zeros(30)])
    ordered = sorted(float(d) for d in depths if d > 0)
    low, high = ordered[int(0.25 * 97) - 1], ordered[int(0.75 * 97) - 1]
    assert quantile_roi(depths) == (1e-7, pytest.approx(high + 1.5 * (high - low)))


def test_query_feature_is_bilinear_with_a_clamped_border(rng):
    grid, cells = rand(rng, 2, 4, 6, 8), torch.rand(2, 30, 2, generator=rng) * 10 - 2
    ends = cells / torch.tensor([5.0, 3.0]) * 2 - 1
    sampled = F.grid_sample(grid.movedim(-1, 1), ends[:, None], padding_mode="border", align_corners=True)
    assert torch.allclose(bilinear(grid, cells), sampled[:, :, 0].movedim(1, -1), atol=1e-5)
    assert torch.equal(bilinear(grid, torch.tensor([[[5.0, 3.0]]] * 2))[:, 0], grid[:, 3, 5])


# --- embeddings ---------------------------------------------------------------------------------------------------


def test_fourier_is_degree_major(rng):
    dims = integer(rng, 1, 5)
    x = rand(rng, 2, dims).double()
    out = fourier(x)
    assert out.shape == (2, 33 * dims)
    for row in range(2):
        values = [float(v) for v in x[row]]
        sines = [math.sin(2.0**j * v) for j in DEGREES for v in values]
        cosines = [math.cos(2.0**j * v) for j in DEGREES for v in values]
        np.testing.assert_allclose(out[row], values + sines + cosines, atol=1e-9)


def test_time_embedding_ends_an_odd_width_with_zero():
    table = time_embedding(5, 7)
    for t in range(5):
        w = [10000 ** (-i / 3) for i in range(3)]
        expected = [math.sin(t * x) for x in w] + [math.cos(t * x) for x in w] + [0]
        np.testing.assert_allclose(table[t], expected, atol=1e-6)


def test_trajectory_token_layout(rng):
    coords, logits, evidence = rand(rng, 1, 3, 2, 3), rand(rng, 1, 3, 2), rand(rng, 1, 3, 2, 4)
    uv = torch.tensor([1e5, 10.0]).expand(1, 3, 2, 2)
    time = rand(rng, 3, token_width(4, 1, True))
    token = trajectory_tokens(coords, logits, evidence, uv, (32, 48), time)[0] - time[:, None]
    zero = torch.zeros(3)
    for t, n in np.ndindex(3, 2):
        following = coords[0, t, n] - coords[0, t + 1, n] if t < 2 else zero
        previous = coords[0, t, n] - coords[0, t - 1, n] if t > 0 else zero
        pixel = torch.tensor([2 * 48 / 47, 10 / 31])  # clamped to twice the width
        parts = [logits[0, t, n][None], evidence[0, t, n], fourier(torch.cat([following, previous])), fourier(pixel)]
        assert torch.allclose(token[t, n], torch.cat(parts), atol=2e-3)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_constants_first_used_without_training_serve_training(dtype):
    _constant.cache_clear()
    x = torch.ones(2, dtype=dtype, requires_grad=True)
    with torch.inference_mode():
        first = constant((3.0, 4.0), torch.ones(1, dtype=dtype))
    assert constant((3.0, 4.0), x) is first and first.dtype == dtype  # so the same one serves both
    (x * first).sum().backward()
    assert x.grad.tolist() == first.tolist() == [3.0, 4.0]


# --- attention ----------------------------------------------------------------------------------------------------


def naive_attention(module, x, context, mask=None):
    """One query, one head at a time; x (Q, D), context (M, D)."""
    inner = module.to_q.out_features
    size = inner // module.heads
    rows = []
    for token in x:
        q, heads = module.to_q(token), []
        for h in range(module.heads):
            part = slice(h * size, (h + 1) * size)
            kv = [module.to_kv(c) for c in context]
            scores = torch.stack([q[part] @ y[:inner][part] / math.sqrt(size) for y in kv])
            if mask is not None:
                scores[~mask] = -math.inf
            share = scores.softmax(0)
            heads.append(sum(w * y[inner:][part] for w, y in zip(share, kv, strict=True)))
        rows.append(module.to_out(torch.cat(heads)))
    return torch.stack(rows)


def test_attention_is_softmax_by_hand(rng):
    module = Attention(6, 2, 4)
    x, context, mask = rand(rng, 2, 3, 6), rand(rng, 2, 5, 6), torch.tensor([True, False, True, True, False])
    with torch.no_grad():
        for b in range(2):
            assert torch.allclose(module(x, context)[b], naive_attention(module, x[b], context[b]), atol=1e-5)
            masked = module(x, context, mask.expand(2, 5))[b]
            assert torch.allclose(masked, naive_attention(module, x[b], context[b], mask), atol=1e-5)
        weights = module.weights(x, context)
    assert weights.shape == (2, 2, 3, 5)
    assert torch.allclose(weights.sum(-1), torch.ones(2, 2, 3))


def test_attention_broadcasts_leading_dimensions(rng):
    module = Attention(6, 2, 4)
    x, context = rand(rng, 2, 1, 3, 6), rand(rng, 2, 4, 5, 6)
    with torch.no_grad():
        assert torch.allclose(module(x, context), module(x.expand(2, 4, 3, 6), context), atol=1e-6)
        assert module(context, x).shape == (2, 4, 5, 6)


def test_pair_attention_by_hand(rng):
    config = TrackerConfig(**SMALL)
    module = PairAttention(config)
    support, context = rand(rng, 4, 6), rand(rng, 3, 6)

    def block(layer: Block, x, c):
        x = x + naive_attention(layer.attention, layer.norm(x), layer.norm_context(c))
        hidden = F.gelu(layer.mlp[0](layer.norm(x)), approximate="tanh")
        return x + layer.mlp[2](hidden)

    def pool(layer: Pool, bag):
        return naive_attention(layer.attention, layer.token, bag)[0]

    with torch.no_grad():
        first, second = (
            block(module.support_from_context, support, context),
            block(module.context_from_support, context, support),
        )
        expected = pool(module.pool_support, first) + pool(module.pool_context, second)
        assert torch.allclose(module(support[None], context[None])[0], expected, atol=1e-5)


def bags(rng, config, dtype=torch.float32):
    kept = Neighbors(rand(rng, 1, 2, 4, 8), rand(rng, 1, 2, 4, 3) * 0.1, torch.zeros(1, 2, 3))
    near = Neighbors(rand(rng, 1, 3, 2, 3, 6), rand(rng, 1, 3, 2, 3, 3) * 0.1, torch.zeros(1, 3, 2, 3))
    return [Neighbors(*(x.to(dtype) for x in (bag.features, bag.points, bag.center))) for bag in (kept, near)]


def test_n2n_does_not_care_about_the_order_of_neighbours(rng):
    context = N2N(TrackerConfig(**SMALL))
    support, near = bags(rng, None)
    order = torch.randperm(3, generator=rng)
    shuffled = Neighbors(near.features[..., order, :], near.points[..., order, :], near.center)
    with torch.no_grad():
        kept = context.describe(1, support)
        assert torch.allclose(context(1, kept, near), context(1, kept, shuffled), atol=1e-5)
        assert not torch.allclose(context(1, kept, near), context(0, context.describe(0, support), near), atol=1e-3)


def test_n2n_appends_the_query_feature_on_request(rng):
    context = N2N(TrackerConfig(**SMALL, use_features=True))
    support, near = bags(rng, None)
    with torch.no_grad():
        out = context(0, context.describe(0, support), near)
        assert out.shape == (1, 3, 2, context.width) == (1, 3, 2, 12)
        assert torch.allclose(out[0, 2, 1, 6:], context.embed.features(support.features[0, 1, 0]), atol=1e-6)


def test_gradients_of_n2n_in_float64():
    torch.manual_seed(0)
    context = N2N(TrackerConfig(**SMALL)).double()
    support, near = bags(torch.Generator().manual_seed(0), None, torch.float64)

    def function(support_features, features, points):
        kept = context.describe(0, Neighbors(support_features, support.points, support.center))
        return context(0, kept, Neighbors(features, points, near.center))

    inputs = [x.clone().requires_grad_() for x in (support.features, near.features, near.points)]
    # The highest Fourier degree turns a step of 1e-6 into a phase of 0.01, hence the small step and loose tolerance.
    assert torch.autograd.gradcheck(function, inputs, eps=1e-7, atol=1e-3, rtol=1e-3)


# --- updater ------------------------------------------------------------------------------------------------------


def test_inactive_tracks_are_seen_by_nobody(rng):
    updater = Transformer(TrackerConfig(**SMALL, outputs=5), 11)
    torch.nn.init.normal_(updater.head.weight, generator=rng)
    tokens, active = rand(rng, 1, 4, 5, 11), torch.tensor([[True, False, True, True, False]])
    with torch.no_grad():
        masked, alone = updater(tokens, active)[:, :, active[0]], updater(tokens[:, :, active[0]])
        assert torch.allclose(masked, alone, atol=1e-5)
        assert not torch.allclose(updater(tokens)[:, :, active[0]], alone, atol=1e-4)
        assert updater(tokens, active & False).isfinite().all()


# --- config -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"space": "polar"}, "space: expected one of uv, uvd"),
        ({"window": 7}, "even"),
        ({"neighbors": 99}, "coarsest of 2 levels has 4x6 cells"),
        ({"feature_dim": 10}, "multiple of 4"),
        ({"space_depth": 3}, "divide time_depth"),
        ({"outputs": 4}, "outputs"),
        ({"heads": 0}, "heads: expected a positive number"),
        ({"neighborhood": "planes"}, "set both or none"),
        ({"space": "uv", "neighborhood": "planes", "context": "planes"}, "three axes"),
        ({"norm_mode": print}, "norm_mode"),
        ({"context": 3}, "context"),
    ],
)
def test_impossible_configs_say_why(change, message):
    with pytest.raises(ValueError, match=message):
        TrackerConfig(**(SMALL | change))


def test_config_round_trip_and_presets():
    config = TrackerConfig.preset("lite", neighbors=9)
    assert TrackerConfig.from_dict(config.to_dict()) == config
    assert config.neighbors == 9
    with pytest.raises(ValueError, match="unknown fields colour"):
        TrackerConfig.from_dict({"colour": 1})
    with pytest.raises(ValueError, match="expected one of paper, lite"):
        TrackerConfig.preset("huge")
    with pytest.raises(ValueError, match="custom part"):
        config.replace(updater=lambda tokens, active=None: tokens).to_dict()
    assert config.replace(context=N2N).to_dict()["context"] == "tapip3d_lite.model.n2n:N2N"
