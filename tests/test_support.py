"""Two ways to the queries' own neighbourhoods, frame by frame and all at once as on a GPU, to the bit."""

import pytest
import torch

import tapip3d_lite as t3d
from tapip3d_lite.model.frames import Frames, frames_from_clip
from tapip3d_lite.model.spaces import fitted
from tapip3d_lite.model.windows import query_support
from tapip3d_lite.speed.cuda_graph import support_at_once
from tests.tiny import SIZES

WINDOW = {"neighborhood": "window", "context": "correlation", "neighbors": 9, "space": "uvd"}


def batch():
    """Two clips of 6 frames, with queries (2, 10, 4) in all of these frames, each clip's in another order."""
    clips = [t3d.simulate_clip(seed=seed, frames=6, size=(32, 32), tracks=10) for seed in (3, 4)]
    frames = Frames(*(torch.cat(x) for x in zip(*(vars(frames_from_clip(c)).values() for c in clips), strict=True)))
    times = torch.stack([torch.arange(10) % 6, torch.arange(10).flip(0) % 5])
    xyz = torch.stack([torch.from_numpy(c.tracks.xyz) for c in clips])  # (2, 6, 10, 3)
    places = xyz.gather(1, times[:, None, :, None].expand(-1, -1, -1, 3))[:, 0]
    return frames, torch.cat([times[..., None].float(), places], -1)


@pytest.mark.parametrize("switches", [{}, {"exclude_invalid": False}, WINDOW], ids=["knn", "all cells", "window"])
def test_all_frames_at_once_give_what_one_after_another_gives(switches):
    torch.manual_seed(0)
    tracker = t3d.Tracker(t3d.TrackerConfig.preset("lite", **(SIZES | switches)))
    frames, queries = batch()
    frames.depths[:, :, :8, :8] = 0  # what is invalid may be left out
    space = fitted(tracker.space, frames)
    scene = tracker.scene(frames, tracker.encoder(frames.rgb), space, None)
    rows, times = torch.arange(2)[:, None], queries[..., 0].long()
    cameras = frames.intrinsics[rows, times], frames.extrinsics[rows, times]
    coords = space.from_world(queries[..., None, 1:], *cameras)[:, :, 0]
    expected = query_support(tracker.neighborhood, scene, times, coords)
    assert len(expected) == 2 and len(times.unique()) == 6 and not torch.equal(times[0], times[1])
    others = support_at_once(tracker.neighborhood, scene, times, coords)
    for one, other in zip(expected, others, strict=True):
        assert one.features.shape[:3] == (2, 10, 1 + tracker.config.neighbors)
        for name in ("features", "points", "center", "indices"):
            assert torch.equal(getattr(one, name), getattr(other, name)), name
