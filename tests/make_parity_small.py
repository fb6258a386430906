"""Make `data/parity_small.npz`: a recorded run of a tiny model, under the keys of the recorded released runs.

The numbers are this library's, made when all stages agreed with the released model's (`python -m tests.parity`), so a
checkout without those large files notices any later change. `python -m tests.make_parity_small` rewrites it.
"""

from __future__ import annotations

import json

import numpy as np
import torch

from tapip3d_lite.model.tracker import Tracker
from tapip3d_lite.official import official_config, parameter_names
from tests import parity

MODEL = {
    "name": "point_tracker_3d", "image_size": [48, 64], "seq_len": 8, "corr_levels": 2, "norm_mode": "isotropic",
    "norm_scale": 1.5, "use_uv_input": True,
    "encoder": {"name": "cotracker_cnn", "output_dim": 8, "stride": 4},
    "corr_feature": {
        "name": "knn_corr_4d", "k_neighbors": 5, "posenc_mlp_dim": 20, "posenc_mlp_layers": 2, "transformer_dim": 12,
        "transformer_num_heads": 2, "transformer_head_dim": 6, "transformer_mlp_ratio": 2.0,
    },
    "point_updater": {
        "name": "efficient_updateformer", "space_depth": 1, "time_depth": 2, "hidden_size": 24, "num_heads": 1,
        "output_dim": 5, "mlp_ratio": 1.5, "num_virtual_tracks": 3, "linear_layer_for_vis_conf": True,
    },
}  # fmt: skip


def scene(frames=10, size=(48, 64), seed=0):
    """A wavy wall with a box before it, seen from a moving camera; some depth is missing; colours are noise."""
    rng = np.random.default_rng(seed)
    height, width = size
    v, u = np.mgrid[:height, :width].astype(np.float32)
    t = np.arange(frames, dtype=np.float32)[:, None, None]
    depth = 4 + 0.5 * np.sin(u / 9 + t / 5) + 0.3 * np.cos(v / 7) + 0.01 * rng.random((frames, height, width))
    depth = np.where((abs(u - 30 - t) < 10) & (abs(v - 25) < 8), 2 + 0.01 * u, depth)
    depth[rng.random(depth.shape) < 0.05] = 0
    coarse = rng.integers(0, 256, (frames, 3, height // 4, width // 4))
    rgb = np.repeat(np.repeat(coarse, 4, 2), 4, 3) / 255
    intrinsics = np.repeat(np.array([[60, 0, 31.5], [0, 58, 23.5], [0, 0, 1]])[None], frames, 0)
    angle = 0.03 * np.arange(frames)
    extrinsics = np.repeat(np.eye(4)[None], frames, 0)
    extrinsics[:, 0, 0] = extrinsics[:, 2, 2] = np.cos(angle)
    extrinsics[:, 0, 2], extrinsics[:, 2, 0] = np.sin(angle), -np.sin(angle)
    extrinsics[:, :3, 3] = np.stack([0.02 * np.arange(frames), 0 * angle, 0.05 * angle], -1)
    near = np.concatenate([rng.integers(0, 6, (9, 1)), rng.normal(0, 0.5, (9, 2)), rng.uniform(2, 4, (9, 1))], 1)
    arrays = {"rgb": rgb, "depth": depth, "intrinsics": intrinsics, "extrinsics": extrinsics, "query_point": near}
    return {f"in.{key}": value.astype(np.float32) for key, value in arrays.items()}


def weights(seed=0):
    """Random parameters under the authors' names; high Fourier degrees are damped, since noise grows through them."""
    torch.manual_seed(seed)  # a script, not the library: layers draw from the global generator
    tracker = Tracker(official_config({"model": MODEL}))
    damping = 2.0 ** -torch.arange(-2, 14).clamp(min=0).float()
    state = tracker.state_dict()
    for value in state.values():
        if value.ndim == 1:
            value.add_(0.1 * torch.randn(value.shape))
    for i, columns in enumerate((3, 6, 2)):
        scale = torch.cat([torch.ones(columns), *[damping.repeat_interleave(columns)] * 2])
        if i == 0:
            for level in range(MODEL["corr_levels"]):
                state[f"context.embed.offsets.{level}.1.weight"].mul_(scale)
        else:
            start = 25 if i == 1 else 25 + 198
            state["updater.input.weight"][:, start : start + len(scale)].mul_(scale)
    state["updater.head.weight"].normal_(0, 0.05)
    state["updater.vis_head.weight"].normal_(0, 0.3)
    named = {theirs: state[ours].clone() for theirs, ours in parameter_names(tracker).items()}
    named["point_updater.virual_tracks"] = named["point_updater.virual_tracks"].transpose(1, 2).contiguous()
    return named | {"time_emb": tracker.time[None].clone()}


@torch.no_grad()
def record(path, iterations=2):
    """Run once and write what `parity.measure` reads."""
    state, config = weights(), {"model": MODEL, "num_iters": iterations, "eval_mode": "raw"}
    arrays = scene() | {f"param.{key}": value.numpy() for key, value in state.items()}
    arrays["config_json"] = np.array(json.dumps(config))
    np.savez(path, **arrays)
    golden = parity.Golden(path)
    tracker, frames, queries = golden.tracker, golden.frames, golden.queries
    out, seen = {}, parity.Recording(tracker)
    features = tracker.encoder(frames.rgb)
    whole = tracker.scene(frames, features, golden.space, None)
    support = tracker.support(whole, queries, golden.state.queries)
    out["image_feats"] = whole.levels[0].features[0].movedim(-1, 1)
    for i, level in enumerate(whole.levels):
        out[f"pyr{i}.feats"], out[f"pyr{i}.world_coords"] = (
            x[0].movedim(-1, 1) for x in (level.features, level.points)
        )
        out[f"support_knn_idx{i}"] = support[i].indices[0, :, 1:]
    coords, logits = golden.state.queries[0], None
    for step in tracker.steps(frames, queries, iterations=iterations, features=features, state=golden.state):
        name, width = f"w{step.start // 4}", tracker.context.width * tracker.config.levels
        key = f"{name}.i{step.iteration}"
        if step.iteration == 0:
            _window(out, tracker, whole, support, step, name)
            coords, logits = (x[0] for x in golden.state.initial(step.start, step.start + 8, step.columns))
            out |= {f"{key}.context_knn_idx{i}": near.indices[0] for i, near in seen.near.items()}
            out[f"{key}.n2n"], out[f"{key}.updater_input"] = torch.cat(seen.contexts, -1)[0], seen.token[0]
            assert out[f"{key}.n2n"].shape[-1] == width
            norm = parity.Normalizer.fit(step.scene.points, step.scene.valid, "isotropic", tracker.config.norm_scale)
            coords = norm.normalize(coords[None])[0]
        out[f"{key}.norm_coords_in"], out[f"{key}.visibs_in"] = coords, logits
        out[f"{key}.updater_output"] = seen.output[0]
        coords, logits = coords + seen.output[0, ..., :3], logits + seen.output[0, ..., 3]
        out[f"{key}.norm_coords_out"], out[f"{key}.visibs_out"] = coords, logits
        count = min(len(frames) - step.start, 8)
        world, visible = torch.zeros(count, queries.shape[1], 3), torch.zeros(count, queries.shape[1])
        world[:, step.columns], visible[:, step.columns] = step.xyz[0, :count], step.logits[0, :count]
        out[f"{key}.coords_world"], out[f"{key}.visib_logits"] = world, visible
    out["out.coords"], out["out.visib_logits"] = (
        x[0, : len(frames)] for x in (golden.state.coords, golden.state.logits)
    )
    np.savez_compressed(path, **arrays, **{key: value.numpy() for key, value in out.items()})


def _window(out, tracker, whole, support, step, name):
    norm = parity.Normalizer.fit(step.scene.points, step.scene.valid, "isotropic", tracker.config.norm_scale)
    out[f"{name}.range"] = torch.tensor([step.start, step.start + 8])
    out[f"{name}.mean_coords"], out[f"{name}.std_coords"] = norm.mean.flatten(), norm.std.flatten().expand(3)
    for i, near in enumerate(x.normalized(norm) for x in support):
        out[f"{name}.pyr{i}.norm_coords"] = norm.normalize(whole.levels[i].points)[0].movedim(-1, 1)
        out[f"{name}.sup{i}.feats_raw"], out[f"{name}.sup{i}.offsets"] = near.features[0], near.offsets[0]


if __name__ == "__main__":
    record(parity.SMALL)
