"""The fast form of N2N equals the clear one, in values and gradients."""

import gc
from dataclasses import replace

import numpy as np
import pytest
import torch

from tapip3d_lite.clip import Clip
from tapip3d_lite.model import encoder as module
from tapip3d_lite.model import track as inference
from tapip3d_lite.model.config import TrackerConfig
from tapip3d_lite.model.n2n import N2N
from tapip3d_lite.model.neighbors import KNearest, Neighbors
from tapip3d_lite.model.tracker import Tracker
from tapip3d_lite.speed.box_knn import BoxKNearest
from tapip3d_lite.speed.folded_n2n import FoldedN2N, FoldedPair

CONFIGS = {
    "one head": {},
    "one head of another width": {"context_head_dim": 12, "context_mlp_ratio": 2.0},
    "several heads": {"context_heads": 4, "context_head_dim": 6},
    "shared weights": {"share_levels": True},
    "width of the features": {"token_dim": 24},
    "query feature appended": {"use_features": True},
    "one neighbour": {"neighbors": 1},
}


def n2n(seed, dtype, **changes):
    """A context with all parameters random, so that no bias or gain can hide."""
    torch.manual_seed(seed)
    sizes = {"feature_dim": 24, "token_dim": 16, "context_head_dim": 16, "neighbors": 5, "levels": 2}
    context = N2N(TrackerConfig(**(sizes | changes))).to(dtype)
    for parameter in context.parameters():
        torch.nn.init.normal_(parameter, std=0.5)
    return context


def bags(seed, context, count, dtype, batch=2, frames=3, tracks=4):
    generator = torch.Generator().manual_seed(seed)

    def rand(*shape):
        return torch.randn(*shape, generator=generator, dtype=dtype)

    channels = context.embed.norm.normalized_shape[0]
    support = Neighbors(
        rand(batch, tracks, count + 1, channels), rand(batch, tracks, count + 1, 3), rand(batch, tracks, 3)
    )
    near = Neighbors(
        rand(batch, frames, tracks, count, channels),
        rand(batch, frames, tracks, count, 3),
        rand(batch, frames, tracks, 3),
    )
    return support, near


def both(context, support, near):
    """Clear and fast result of each level."""
    levels = range(2)
    kept = [context.describe(i, support) for i in levels]
    cells = replace(near, features=context.embed.features(near.features))
    folded = [FoldedPair.fold(context, i, kept[i]) for i in levels]
    return [(context(i, kept[i], cells), folded[i].compare(cells)) for i in levels]


@pytest.mark.parametrize("gradient", [False, True])
@pytest.mark.parametrize("changes", CONFIGS.values(), ids=CONFIGS)
def test_the_fast_form_equals_the_clear_one(changes, gradient):
    context = n2n(1, torch.float64, **changes)
    support, near = bags(2, context, changes.get("neighbors", 5), torch.float64)
    with torch.set_grad_enabled(gradient):
        results = both(context, support, near)
    for clear, fast in results:
        assert clear.abs().max() > 0.1
        assert fast.shape == clear.shape
        torch.testing.assert_close(fast, clear, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("changes", CONFIGS.values(), ids=CONFIGS)
def test_gradients_are_equal(changes):
    context = n2n(3, torch.float64, **changes)
    support, near = bags(4, context, changes.get("neighbors", 5), torch.float64)
    inputs = [support.features, near.features, near.center, *context.parameters()]
    for x in inputs:
        x.requires_grad_()
    totals = [0, 0]
    for pair in both(context, support, near):
        totals = [total + result.sin().sum() for total, result in zip(totals, pair, strict=True)]
    gradients = [torch.autograd.grad(total, inputs, retain_graph=True, allow_unused=True) for total in totals]
    for clear, fast in zip(*gradients, strict=True):
        if clear is not None:  # biases of keys have no effect
            fast = torch.zeros_like(clear) if fast is None else fast
            torch.testing.assert_close(fast, clear, rtol=1e-8, atol=1e-8)


def test_nearly_constant_tokens_are_normalised_with_the_right_eps():
    """The two directions normalise with eps 1e-5 and 1e-6; where tokens hardly vary, that matters."""
    context = n2n(5, torch.float64, offset_layers=1)
    for parameter in (*context.embed.project.parameters(), *context.embed.offsets.parameters()):
        torch.nn.init.normal_(parameter, std=1e-3)
    support, near = bags(6, context, 5, torch.float64)
    with torch.no_grad():
        for clear, fast in both(context, support, near):
            torch.testing.assert_close(fast, clear, rtol=1e-8, atol=1e-8)


def test_float32_and_a_cut_of_the_tracks():
    context = n2n(7, torch.float32)
    support, near = bags(8, context, 5, torch.float32)
    with torch.no_grad():
        kept = [context.describe(i, support) for i in range(2)]
        cells = replace(near, features=context.embed.features(near.features))
        folded = FoldedPair.fold(context, 1, kept[1])[:, 1:3]
        part = replace(cells, **{name: getattr(cells, name)[:, :, 1:3] for name in ("features", "points", "center")})
        torch.testing.assert_close(folded.compare(part), context(1, kept[1], cells)[:, :, 1:3], rtol=1e-4, atol=1e-4)


SMALL = {"image_size": (32, 32), "window": 4, "levels": 2, "neighbors": 4, "feature_dim": 64, "iterations": 1}


def small_tracker():
    torch.manual_seed(9)
    return Tracker(TrackerConfig.preset("lite", **SMALL)).eval()


def small_clip(frames):
    rng = np.random.default_rng(10)
    intrinsics = np.tile(np.float32([[30, 0, 15.5], [0, 30, 15.5], [0, 0, 1]]), (frames, 1, 1))
    extrinsics = np.tile(np.eye(4, dtype=np.float32), (frames, 1, 1))
    extrinsics[:, 0, 3] = 0.01 * np.arange(frames)
    video = rng.integers(0, 256, (frames, 32, 32, 3), dtype=np.uint8)
    depths = rng.uniform(1, 2, (frames, 32, 32)).astype(np.float32)
    queries = np.float32([[0, 0, 0, 1.5], [frames // 2, 0.1, 0.2, 1.2], [frames - 1, -0.2, 0.1, 1.4]])
    return Clip(video, depths, intrinsics, extrinsics, queries=queries)


@pytest.mark.parametrize("frames", [3, 9])
def test_a_long_clip_is_streamed_with_the_same_result(frames, monkeypatch):
    tracker, clip = small_tracker(), small_clip(frames)
    whole = tracker.track(clip, support_grid=2)
    monkeypatch.setattr(inference, "_KEPT", 0)
    streamed = tracker.track(clip, support_grid=2)
    np.testing.assert_allclose(streamed.xyz, whole.xyz, atol=1e-4)
    np.testing.assert_allclose(streamed.visible_logits, whole.visible_logits, atol=1e-4)


def most_bytes(tracker, clip):
    """Largest memory of tensors alive at an update, and how often the encoder saw a frame."""
    most, encoded = [0], []

    def weigh(*_):
        alive = [x for x in gc.get_objects() if type(x) in (torch.Tensor, torch.nn.Parameter)]  # no compiler's fakes
        storages = {x.untyped_storage().data_ptr(): x.untyped_storage().nbytes() for x in alive}
        most[0] = max(most[0], sum(storages.values()))

    hooks = [
        tracker.updater.register_forward_hook(weigh),
        tracker.encoder.register_forward_hook(lambda _, inputs, __: encoded.append(inputs[0].shape[1])),
    ]
    tracker.track(clip, support_grid=0)
    for hook in hooks:
        hook.remove()
    return most[0], sum(encoded)


def test_memory_hardly_grows_with_the_length_of_a_long_clip(monkeypatch):
    tracker, frame = small_tracker(), 64 * 8 * 8 * 4  # bytes of the features of one frame
    (short, once), (long, _) = (most_bytes(tracker, small_clip(frames)) for frames in (8, 24))
    assert once == 8  # both directions share the features
    assert long - short > 16 * frame
    monkeypatch.setattr(inference, "_KEPT", 0)
    (short, twice), (long, _) = (most_bytes(tracker, small_clip(frames)) for frames in (8, 24))
    assert twice == 16
    assert long - short < 16 * frame / 8


def test_the_encoder_takes_as_many_frames_at_once_as_fit_a_budget(monkeypatch):
    encoder, images = small_tracker().encoder, torch.rand(2, 5, 3, 32, 32)
    sizes = []
    encoder.stem.register_forward_pre_hook(lambda _, inputs: sizes.append(len(inputs[0])))
    with torch.no_grad():
        whole = encoder(images)
        monkeypatch.setattr(module, "_PIXELS", 3 * 32 * 32)
        chunked = encoder(images)
        monkeypatch.setattr(module, "_PIXELS", 1)  # a frame at least
        single = encoder(images)
    learning = encoder(images)
    assert sizes == [10, 3, 3, 3, 1, *[1] * 10, 10]
    for other in (chunked, single, learning):
        torch.testing.assert_close(other, whole, rtol=1e-4, atol=1e-4)


def test_the_registry_alone_chooses_the_form():
    fast, clear = (Tracker(TrackerConfig.preset("lite", **SMALL), fast=fast) for fast in (True, False))
    assert isinstance(fast.context, FoldedN2N) and isinstance(fast.neighborhood, BoxKNearest)
    assert type(clear.context) is N2N and type(clear.neighborhood) is KNearest
    clear.load_state_dict(fast.state_dict())  # the same parameters
    clip = small_clip(6)
    one, other = (tracker.eval().track(clip, support_grid=2) for tracker in (fast, clear))
    np.testing.assert_allclose(one.xyz, other.xyz, atol=1e-4)
