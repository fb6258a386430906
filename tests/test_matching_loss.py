"""The loss of the encoder's pretraining is least at the right cell, and at the right place within it."""

import torch
from torch import nn

from tapip3d_lite.training.pretrain import FramePair, MatchingConfig, matching_loss

CELLS, STRIDE, SHIFT = 24, 2, torch.tensor([2.5, -1.0])  # cells by which everything moves


class Code(nn.Module):
    """Features that depend on the place on a surface which moves by SHIFT: sinusoids, smooth like a trained encoder's."""

    def __init__(self):
        super().__init__()
        self.waves = torch.randn(2, 32, generator=torch.Generator().manual_seed(0))

    def forward(self, rgb):
        columns, rows = torch.meshgrid(*[torch.arange(CELLS, dtype=torch.float32)] * 2, indexing="xy")
        places = torch.stack([columns, rows], -1)
        phases = torch.stack([places, places - SHIFT]) @ self.waves
        return torch.cat([phases.cos(), phases.sin()], -1).movedim(-1, 1)[None]


def loss_and_right(shift, **changes):
    torch.manual_seed(0)
    start = (torch.rand(200, 2) * (CELLS - 12) + 6) * STRIDE
    rgb = torch.zeros(2, 3, CELLS * STRIDE, CELLS * STRIDE)
    pair = FramePair(rgb, torch.stack([start, start + torch.tensor(shift) * STRIDE]))
    loss, right = matching_loss(Code(), [pair], MatchingConfig(**({"levels": 1} | changes)))
    return float(loss), float(right)


def test_the_right_place_costs_least():
    true = SHIFT.tolist()
    wrong = [[2.5, -0.5], [2.0, -1.0], [1.5, 0.0], [-3.0, 4.0]]
    for changes in ({}, {"place": 0.0}, {"levels": 3}):
        best = loss_and_right(true, **changes)[0]
        assert all(best < loss_and_right(shift, **changes)[0] for shift in wrong)
    assert loss_and_right(true)[1] == 1.0 and loss_and_right([-3.0, 4.0])[1] < 0.1


def test_the_mean_of_the_cells_around_tells_half_a_cell_apart():
    def distance(shift):  # what the second term adds
        return loss_and_right(shift)[0] - loss_and_right(shift, place=0.0)[0]

    true = SHIFT.tolist()
    assert distance(true) < 0.15
    assert 0.35 < distance([true[0] + 0.5, true[1]]) < 0.65


def test_a_small_image_has_fewer_levels():
    assert loss_and_right(SHIFT.tolist(), levels=5) == loss_and_right(SHIFT.tolist(), levels=9)


def test_several_pairs_cost_the_mean_of_what_each_costs():
    torch.manual_seed(0)
    encoder = nn.Sequential(nn.Flatten(0, 1), nn.Conv2d(3, 12, STRIDE, STRIDE, bias=False), nn.Unflatten(0, (-1, 2)))
    rgb, uv = torch.randn(3, 3, CELLS * STRIDE, CELLS * STRIDE), torch.randint(CELLS, (3, 40, 2)) * float(STRIDE)
    pairs = [
        FramePair(rgb[:1].repeat(2, 1, 1, 1), uv[:1, :5].repeat(2, 1, 1)),
        FramePair(rgb[1:], uv[1:]),
    ]  # easy, impossible
    config = MatchingConfig(levels=2)
    easy, impossible = (torch.stack(matching_loss(encoder, [pair], config)) for pair in pairs)
    assert easy[0] < impossible[0] - 1 and easy[1] > 0.5 > impossible[1]
    torch.testing.assert_close(torch.stack(matching_loss(encoder, pairs, config)), (easy + impossible) / 2)
