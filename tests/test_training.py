"""The loss against a loop, and the memory-saving backward against the plain one."""

import numpy as np
import pytest
import torch

import tapip3d_lite as t3d
from lessons.backward_ways import plain_backward, saving_backward
from lessons.saved_bytes import SavedBytes
from tapip3d_lite.model.frames import frames_from_clip
from tapip3d_lite.training.loss import LossConfig, Truth, step_loss
from tests.tiny import SIZES


def setting(frames=10, dtype=torch.float32, **changes):
    torch.manual_seed(0)
    clip = t3d.simulate_clip(seed=6, frames=frames, size=(32, 32), tracks=12)
    tracker = t3d.Tracker(t3d.TrackerConfig.preset("lite", **(SIZES | changes))).to(dtype)
    video = frames_from_clip(clip)._map(lambda x: x.to(dtype))
    truth = Truth(
        torch.from_numpy(clip.tracks.xyz)[None].to(dtype),
        torch.from_numpy(clip.tracks.visible)[None],
        torch.from_numpy(clip.queries[:, 0]).long()[None],
    )
    return clip, tracker, video, torch.from_numpy(clip.queries)[None].to(dtype), truth


@pytest.mark.parametrize(
    "options", [{"form": "paper"}, {"form": "pixels"}, {"soften": 2.0}, {"form": "paper", "soften": 1.0, "within": 3.0}]
)
def test_step_loss_is_the_loop(options):
    clip, tracker, frames, queries, truth = setting(frames=9)  # one padded frame
    config, far, early = LossConfig(**options), 0, 0
    for step in tracker.steps(frames, queries, iterations=3):
        position, visibility = step_loss(step, truth, 3, config)
        a, b, count = 0.0, 0.0, 0
        for i in range(4):
            t = step.start + i
            for k, n in enumerate(step.columns.tolist()):
                early += t < clip.queries[n, 0]
                if t >= 9 or t < clip.queries[n, 0]:
                    continue
                p = clip.tracks.xyz[t, n]
                z = t3d.geometry.transform(p[None], clip.extrinsics[t])[0, 2]
                error = np.linalg.norm(step.xyz[0, i, k].detach().numpy() - p) / max(z, 0.1)
                focal = np.sqrt(clip.intrinsics[t, 0, 0] * clip.intrinsics[t, 1, 1])
                trusted = not config.within or error * focal < config.within
                if config.soften:
                    error = config.soften * np.log(1 + error * focal / config.soften) / focal
                if config.form == "pixels":
                    error *= focal
                probability = 1 / (1 + np.exp(-float(step.logits[0, i, k].detach())))
                v = clip.tracks.visible[t, n] and trusted
                far += clip.tracks.visible[t, n] and not trusted
                a, count = a + error, count + 1
                b -= np.log(probability if v else 1 - probability)
        weight = 0.005 * 0.8 ** (2 - step.iteration) / count
        assert float(position.detach()) == pytest.approx(weight * a, rel=1e-4)
        assert float(visibility.detach()) == pytest.approx(weight * 3 * b, rel=1e-4)
    assert early > 0 and (far > 0) == (config.within > 0)  # so what is left out, and the option, could be seen


def gradients(run, *arguments, **options):
    tracker = arguments[0]
    tracker.zero_grad()
    totals = run(*arguments, LossConfig(), **options)
    return totals, {name: p.grad.clone() for name, p in tracker.named_parameters() if p.grad is not None}


@pytest.mark.parametrize(
    ("fast", "switches"),
    [
        (True, {}),
        (False, {}),
        (True, {"context_heads": 2, "share_levels": True, "use_features": True}),
        (True, {"context": "p2n"}),
        (True, {"neighborhood": "window", "context": "correlation", "space": "uvd"}),
        (True, {"neighborhood": "planes", "context": "planes", "space": "uvd"}),
    ],
    ids=lambda x: ("fast" if x else "clear") if isinstance(x, bool) else x.get("context", f"n2n {len(x)}"),
)
def test_saving_backward_has_the_plain_gradients(fast, switches):
    _, tracker, frames, queries, truth = setting(dtype=torch.float64, **switches)
    tracker.fast = fast
    totals, plain = gradients(plain_backward, tracker, frames, queries, truth)
    saved_totals, saved = gradients(saving_backward, tracker, frames, queries, truth)
    assert saved_totals == pytest.approx(totals, rel=1e-12)
    assert plain.keys() == saved.keys() and any(name.startswith("encoder") for name in saved)
    for name, gradient in plain.items():
        atol = 1e-9 if name.startswith("encoder") and switches else 1e-10  # features are float32, gradients of 1e-3
        torch.testing.assert_close(saved[name], gradient, rtol=1e-8, atol=atol, msg=name)


def test_tracks_that_fill_up_a_batch_do_not_count():
    _, tracker, frames, queries, truth = setting(dtype=torch.float64)
    few = Truth(truth.xyz[:, :, :8], truth.visible[:, :, :8], truth.times[:, :8])
    expected, one = gradients(saving_backward, tracker, frames, queries[:, :8], few)
    active = torch.arange(12)[None] < 8
    totals, other = gradients(saving_backward, tracker, frames, queries, truth, active=active)
    assert totals == pytest.approx(expected, rel=1e-9)
    for name in one:
        torch.testing.assert_close(one[name], other[name], rtol=1e-7, atol=1e-10, msg=name)


def peak(run, frames, iterations):
    _, tracker, video, queries, truth = setting(frames=frames)
    tracker.encoder.requires_grad_(False)  # the encoder's own graph grows with the frames either way
    with SavedBytes() as memory:
        run(tracker, video, queries, truth, LossConfig(), iterations=iterations)
    return memory.most


def test_memory_grows_neither_with_updates_nor_with_windows():
    few, many = peak(saving_backward, 8, 2), peak(saving_backward, 8, 6)
    assert many < 1.1 * few
    short, long = peak(saving_backward, 8, 2), peak(saving_backward, 20, 2)
    assert long < 1.3 * short
    assert peak(plain_backward, 8, 6) > 2 * peak(plain_backward, 8, 2)  # so the measure can tell
    assert peak(plain_backward, 20, 2) > 2 * short


@pytest.mark.parametrize("bad", [{"form": "metres"}, {"visibility": -1.0}, {"within": -1.0}, {"discount": 0.0}])
def test_bad_weights(bad):
    with pytest.raises(ValueError, match="LossConfig"):
        LossConfig(**bad)
