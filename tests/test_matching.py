"""Votes of two bags: against loops, and on cases whose answer is known."""

import numpy as np
import pytest
import torch

import tapip3d_lite as t3d
from lessons import n04_votes
from lessons.n04_votes import paired_bags, similarity_attention, votes
from lessons.n04_world import cloud_of

K = 6


@pytest.fixture(scope="module")
def clip():
    return t3d.simulate_clip(seed=3, frames=9, size=(48, 48), tracks=60, camera="linear")


@pytest.fixture(scope="module")
def level(clip):
    return cloud_of(clip, stride=4)


def by_loop(attention, support, context, width):
    count = len(context)
    nearest = [min(float((a - b).norm()) for b in context if b is not a) for a in context]
    h = width * sorted(nearest)[(count - 1) // 2]
    total = torch.zeros(count)
    for j in range(count):
        for i in range(len(support)):
            for m in range(count):
                miss = float((context[m] - support[i] - context[j]).norm())
                total[j] += (attention[i, m] - 1 / count) * np.exp(-(miss**2) / (2 * h**2))
    return total


@pytest.mark.parametrize("chunk", [1, 2**22])
def test_votes_equal_the_loop(chunk, monkeypatch):
    monkeypatch.setattr(n04_votes, "_CHUNK", chunk)
    generator = torch.Generator().manual_seed(0)
    attention = torch.rand(3, K + 1, K, generator=generator).softmax(-1)
    support, context = torch.randn(3, K + 1, 3, generator=generator), torch.randn(3, K, 3, generator=generator)
    expected = [by_loop(a, list(s), list(c), 0.7) for a, s, c in zip(attention, support, context, strict=True)]
    torch.testing.assert_close(votes(attention, support, context, 0.7), torch.stack(expected), rtol=1e-4, atol=1e-4)


def test_a_moved_pattern_is_found_by_the_bag_and_not_by_the_point():
    """Nine cells in a row, two colours: the point's own colour is everywhere, the constellation only once."""
    place = torch.stack([torch.arange(9.0), torch.zeros(9), torch.zeros(9)], -1)
    color = torch.tensor([0.0, 1, 0, 0, 1, 1, 0, 1, 0])[:, None]
    order = [3, 2, 4, 1, 5]  # the support around cell 3
    attention = similarity_attention(color[order][None], color[None])
    offsets = (place[order] - place[3])[None]
    assert votes(attention, offsets, place[None]).argmax() == 3
    alone = attention[0, 0]
    assert (alone == alone.max()).sum() == 5
    wrong = votes(attention, -offsets, place[None])  # the wrong way round
    assert wrong[0, 3] < votes(attention, offsets, place[None])[0, 3]


def test_uniform_attention_votes_for_nothing():
    generator = torch.Generator().manual_seed(1)
    attention = torch.full((2, K + 1, K), 1 / K)
    scores = votes(attention, *(torch.randn(2, n, 3, generator=generator) for n in (K + 1, K)))
    torch.testing.assert_close(scores, torch.zeros(2, K), atol=1e-6, rtol=0)


def test_similarity_attention_sums_to_one_and_prefers_the_like():
    generator = torch.Generator().manual_seed(2)
    context = torch.randn(4, K, 5, generator=generator)
    attention = similarity_attention(context, context)
    torch.testing.assert_close(attention.sum(-1), torch.ones(4, K))
    assert (attention.argmax(-1) == torch.arange(K)).all()


def test_the_truth_is_the_cell_nearest_to_the_track(clip, level):
    bags = paired_bags(clip, level, K, np.random.default_rng(0), step=1)
    count = len(bags.truth)
    assert count > 20 and bags.support.shape == (count, K + 1, 3) and bags.context.shape == (count, K, 3)
    assert bags.support_offsets[:, 0].abs().max() == 0
    chosen = clip.tracks.visible[0] & clip.tracks.visible[1]
    after = torch.from_numpy(clip.tracks.xyz[1, chosen])
    cells = level.points[0, 1].flatten(0, 1)
    right = torch.cdist(after, cells).argmin(-1)
    features = level.features[0, 1].flatten(0, 1)[right]
    found = bags.context[torch.arange(count), bags.truth]
    first = found[: len(after)]  # the first pair of frames
    assert all(((features - row).abs().sum(-1) < 1e-6).any() for row in first[:10])


def test_the_right_cell_may_stand_anywhere(clip, level):
    bags = paired_bags(clip, level, K, np.random.default_rng(0))
    assert set(bags.truth.tolist()) == set(range(K))
    middle = bags.context_offsets.norm(dim=-1).argmin(-1)
    assert (middle == bags.truth).float().mean() < 2.5 / K


def test_moving_and_resting_points_share_out_the_tracks(clip, level):
    both = [len(paired_bags(clip, level, 4, np.random.default_rng(0), moving=m).truth) for m in (True, False)]
    assert min(both) > 0
