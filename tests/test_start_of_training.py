"""An aligned start: attention that compares looks and hands on displacements, smooth places, blocks that pass on."""

import pytest
import torch
import torch.nn.functional as F
from torch import nn

import tapip3d_lite as t3d
from tapip3d_lite.model.blocks import OffsetEmbedding
from tapip3d_lite.training.start import align
from tapip3d_lite.training.trainer import Trainer
from tests.lab_conditions import Mean
from tests.tiny import SIZES, recipe


def made(**changes):
    torch.manual_seed(0)
    tracker = t3d.Tracker(t3d.TrackerConfig.preset("lite", **{**SIZES, **changes})).eval()
    align(tracker)
    return tracker


@pytest.mark.parametrize("width", [16, 24])
@torch.no_grad()
def test_attention_finds_the_cell_that_looks_alike(width):
    """With channels of their own, also where the offsets say otherwise; with shared ones still more often than not."""
    tracker = made(feature_dim=16, token_dim=width, context_head_dim=width)
    looks = 3 * torch.randn(6, 16)
    embed, pair = tracker.context.embed, tracker.context.pairs[0]
    cells = embed.features(looks)
    here, there = embed.offset(0, 0.2 * torch.randn(6, 3)), embed.offset(0, 0.2 * torch.randn(6, 3))
    block = pair.context_from_support
    one, other = block.norm(cells + here), block.norm_context(cells.roll(1, 0) + there)
    weights = block.attention.weights(one[None], other[None])[0].mean(0)  # (6, 6)
    right = weights.gather(1, (torch.arange(6)[:, None] + 1) % 6)
    assert (right > (0.95 if width > 16 else 0.5)).float().mean() >= (1 if width > 16 else 0.6)
    if width > 16:
        handed = block.attention(one[None], other[None])[0]  # minus the other's offset, in the channels of places
        torch.testing.assert_close(handed[:, 16:], -other.roll(-1, 0)[:, 16:], atol=0.15, rtol=0)
        torch.testing.assert_close(handed[:, :16], torch.zeros(6, 16))


@torch.no_grad()
def test_near_places_look_near():
    """Of a random start a step of a hundredth changes an offset's embedding nearly as much as one of a half."""
    near, far = ({} for _ in range(2))
    for name, change in (("random", lambda tracker: None), ("aligned", align)):
        torch.manual_seed(0)
        tracker = t3d.Tracker(t3d.TrackerConfig.preset("lite", **SIZES))
        change(tracker)
        embedding = next(part for part in tracker.modules() if isinstance(part, OffsetEmbedding))
        x, step = 0.3 * torch.randn(500, 3), F.normalize(torch.randn(500, 3), dim=-1)
        near[name], far[name] = ((embedding(x + d * step) - embedding(x)).norm(dim=-1).mean() for d in (0.01, 0.5))
    assert near["aligned"] < 0.15 * far["aligned"] and near["random"] > 0.5 * far["random"]


@torch.no_grad()
def test_the_updater_passes_on_and_learns_all_the_same(tmp_path, clips):
    trainer = Trainer(tmp_path, recipe(start="aligned", matching_steps=0), clips)
    updater, tokens = trainer.tracker.updater, torch.randn(1, 4, 3, trainer.tracker.time.shape[1])
    assert torch.equal(updater(tokens)[..., :3], updater.head(updater.input(tokens)))
    before = {name: x.clone() for name, x in trainer.tracker.state_dict().items()}
    with torch.enable_grad():
        assert trainer.run(progress=False)
    still = [name for name, x in trainer.tracker.named_parameters() if x.requires_grad and torch.equal(x, before[name])]
    assert not still


def test_random_starts_stay_and_other_parts_are_left_alone(tmp_path, clips):
    plain = Trainer(tmp_path / "a", recipe(), clips).tracker.state_dict()
    same = Trainer(tmp_path / "b", recipe(start="random"), clips).tracker.state_dict()
    other = Trainer(tmp_path / "c", recipe(start="aligned"), clips).tracker.state_dict()
    changed = {name for name, x in plain.items() if not torch.equal(x, other[name])}
    assert all(torch.equal(x, same[name]) for name, x in plain.items())
    assert {name.split(".")[0] for name in changed} == {"context", "updater"} and "updater.head.weight" not in changed
    with pytest.raises(ValueError, match=r"TrainConfig\.start"):
        recipe(start="good")
    for switches in ({"context": Mean}, {"context": "p2n"}, {"updater": "temporal"}):
        made(**switches)
    made(context="correlation", neighborhood="window")
    made(context="planes", neighborhood="planes", space="uvd")

    class Own(nn.Module):
        def __init__(self, config, inputs):
            super().__init__()
            self.input, self.head = nn.Linear(inputs, 8), nn.Linear(8, 4)

    assert torch.isfinite(made(updater=Own).updater.input.weight).all()
