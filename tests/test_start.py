"""Weights to start from, of a tracker with a coarser pyramid."""

import numpy as np
import pytest
import torch

import tapip3d_lite as t3d
from tapip3d_lite.model.frames import frames_from_clip
from tapip3d_lite.training.start import begin_with
from tests.test_fast import small_clip

SIZES = {"image_size": (32, 32), "window": 4, "neighbors": 4, "feature_dim": 16, "token_dim": 16, "iterations": 2}
SIZES |= {"context_head_dim": 16, "offset_dim": 16, "hidden": 32, "heads": 2, "head_dim": 16, "virtual_tracks": 4}
SIZES |= {"time_depth": 1, "space_depth": 1}
COARSE, FINE = {"stride": 4, "levels": 2}, {"stride": 2, "levels": 3}


def tracker(seed, **changes):
    torch.manual_seed(seed)
    made = t3d.Tracker(t3d.TrackerConfig.preset("lite", **(SIZES | changes))).eval()
    torch.nn.init.normal_(made.updater.head.weight, std=0.1)  # so that points move
    return made


@pytest.mark.parametrize("context", ["n2n", "p2n"])
def test_a_finer_tracker_goes_on_where_a_coarser_one_was(tmp_path, context):
    coarse, fine = tracker(0, context=context, **COARSE), tracker(1, context=context, **FINE)
    t3d.save_weights(coarse, tmp_path / "coarse.safetensors")
    begin_with(fine, str(tmp_path / "coarse.safetensors"))
    silent = [model.updater.input.weight @ model.time.T for model in (coarse, fine)]
    torch.testing.assert_close(silent[0], silent[1], atol=1e-4, rtol=0)  # what time adds
    with torch.no_grad():  # the rest is exact; what keeps time where it was changes all columns a little
        old = coarse.updater.input.weight
        fine.updater.input.weight[:] = torch.cat([old[:, :1], torch.zeros(len(old), 16), old[:, 1:]], 1)
    for model in (coarse, fine):
        model.time.zero_()
    clip = small_clip(6)
    frames, queries = frames_from_clip(clip), torch.from_numpy(clip.queries)[None]
    maps = coarse.encoder(frames.rgb).detach()
    both = {"coarse": maps, "fine": maps.repeat_interleave(2, -1).repeat_interleave(2, -2)}  # its average is `maps`
    with torch.no_grad():  # later updates may meet other neighbours after a rounding
        first, other = (
            next(model.steps(frames, queries, features=both[name])).coords
            for name, model in (("coarse", coarse), ("fine", fine))
        )
    assert float((first - queries[:, None, :2, 1:]).abs().max()) > 1e-2
    np.testing.assert_allclose(first, other, atol=2e-4)


def test_what_cannot_be_made_finer_says_so(tmp_path):
    t3d.save_weights(tracker(0, **COARSE), tmp_path / "w.safetensors")
    with pytest.raises(ValueError, match="other sizes"):
        begin_with(tracker(1, **COARSE, hidden=16), str(tmp_path / "w.safetensors"))
    with pytest.raises(ValueError, match="cannot be given levels"):
        begin_with(tracker(1, **FINE, context="p2n", token_dim=32), str(tmp_path / "w.safetensors"))
