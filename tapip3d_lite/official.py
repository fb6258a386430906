"""The authors' checkpoints {"cfg": OmegaConf, "weight": state_dict, …}: their configuration and parameter names to ours.

The mapping is strict: what is not understood raises, since a silently ignored option would change the numbers.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from tapip3d_lite.model.blocks import time_embedding
from tapip3d_lite.model.config import TrackerConfig
from tapip3d_lite.model.tracker import Tracker
from tapip3d_lite.model.weights import outline
from tapip3d_lite.pickled import Name, Record
from tapip3d_lite.saved import read_saved
from tapip3d_lite.validate import check_state

# Their key -> our field, and the released value, for a stored configuration names only what differs from the code's
# defaults. None: it must be there, since no parameter's shape would show a wrong guess.
_PLAIN = {
    "seq_len": ("window", 16),
    "corr_levels": ("levels", 4),
    "norm_mode": ("norm_mode", "none"),
    "norm_scale": ("norm_scale", 1.0),
    "use_uv_input": ("use_uv", False),
    "center_rgb": ("center_rgb", False),
    "encoder.output_dim": ("feature_dim", 128),
    "encoder.stride": ("stride", None),
    "corr_feature.k_neighbors": ("neighbors", None),
    "corr_feature.posenc_mlp_dim": ("offset_dim", 128),
    "corr_feature.posenc_mlp_layers": ("offset_layers", 3),
    "corr_feature.transformer_dim": ("token_dim", 128),
    "corr_feature.transformer_num_heads": ("context_heads", None),
    "corr_feature.transformer_head_dim": ("context_head_dim", 128),
    "corr_feature.transformer_mlp_ratio": ("context_mlp_ratio", 1.0),
    "corr_feature.use_features": ("use_features", False),
    "corr_feature.share_weights_across_levels": ("share_levels", False),
    "point_updater.space_depth": ("space_depth", 3),
    "point_updater.time_depth": ("time_depth", 3),
    "point_updater.hidden_size": ("hidden", 384),
    "point_updater.num_heads": ("heads", 8),
    "point_updater.output_dim": ("outputs", 5),
    "point_updater.mlp_ratio": ("mlp_ratio", 4.0),
    "point_updater.num_virtual_tracks": ("virtual_tracks", 64),
    "point_updater.linear_layer_for_vis_conf": ("separate_vis_head", False),
}
_REQUIRED = {  # options that we have in one value only
    "name": ("point_tracker_3d", "point_tracker_3d_local"),
    "encoder.name": ("cotracker_cnn",),
    "corr_feature.name": ("knn_corr_4d", "knn_corr_4d_optimized"),
    "corr_feature.use_absolute_pos": (False,),
    "corr_feature.better_depth_downsample": (True,),
    "corr_feature._clip_depth": (None, False),
    "point_updater.name": ("efficient_updateformer",),
    "point_updater.add_space_attn": (True,),
    "use_local_pos_input": (False,),
    "relative": (False,),
}
# Without meaning for inference, or restated by other options.
_IGNORED = {"image_size", "eval_mode", "scale_aug", "find_knn_in_normalized_space", "point_updater.input_dim"}
_IGNORED |= {"encoder.pretrained", "encoder.freeze_mode"}
_VALUES, _DEPTH, _LETTERS = 20_000, 20, 100  # of a configuration: values, levels, letters of a key


def load_official(path: str | Path, fast: bool = True) -> Tracker:
    """Read the authors' checkpoint file (.pth) {"cfg", "weight", …}; no code from the file can run.

    Returns the tracker on the CPU, in evaluation mode, with the `fast` forms of its parts or the clear ones.

    Raises:
        ValueError: not such a file, a refused global in its pickle, or a model that we do not know.
    """
    return from_official_state(*read_checkpoint(path), fast=fast)


def from_official_state(cfg: Mapping[str, Any], state: Mapping[str, Tensor], fast: bool = True) -> Tracker:
    """Build the tracker that a released checkpoint describes.

    Args:
        cfg: the checkpoint's configuration as plain mappings: `model`, and `train_dataset.resolution` unless
            `model.image_size` is given.
        state: parameters under the authors' names.
        fast: use the fast forms of its parts, see `Tracker`.

    Returns the tracker in evaluation mode; its space is `"world"`, and `"camera"` serves as well.

    Raises:
        ValueError: options or parameters that are unknown, missing or of another shape, by name.
    """
    config, state = official_config(cfg), dict(state)
    plan = outline(config)
    _check_time(plan, state.pop("time_emb", None))
    names, own = parameter_names(plan), plan.state_dict()
    if (virtual := state.get(_VIRTUAL)) is not None and virtual.ndim == 4:
        state[_VIRTUAL] = virtual.transpose(1, 2)  # (1, V, 1, U) -> (1, 1, V, U)
    check_state(state, {theirs: own[ours] for theirs, ours in names.items()})
    tracker = Tracker(config, fast)
    tracker.load_state_dict({ours: state[theirs].float() for theirs, ours in names.items()})
    return tracker.eval()


def official_config(cfg: Mapping[str, Any]) -> TrackerConfig:
    """Translate the authors' configuration; ValueError names options that cannot be honoured."""
    model = cfg.get("model") if isinstance(cfg, Mapping) else None
    if not isinstance(model, Mapping):
        raise ValueError(f"cfg: expected a mapping with a mapping 'model', got {str(cfg)[:200]}")
    flat = {k: v for k, v in flatten(model).items() if k not in _IGNORED}
    for key, allowed in _REQUIRED.items():
        value = flat.pop(key, allowed[0])
        if value not in allowed:
            raise ValueError(f"cfg.model.{key}: only {' or '.join(map(repr, allowed))} is supported, got {value!r}")
    ours = {}
    for key, (field, default) in _PLAIN.items():
        value = flat.pop(key, default)
        if value is None:
            raise ValueError(f"cfg.model.{key}: missing")
        ours[field] = value
    if flat:
        raise ValueError(f"cfg.model: unknown options {', '.join(sorted(flat))}; they might change the numbers")
    size = model.get("image_size") or flatten(cfg).get("train_dataset.resolution") or (384, 512)
    # The released updater's heads are 48 wide, whatever its width.
    return TrackerConfig(image_size=size, as_released=True, space="world", head_dim=48, **ours)


def parameter_names(tracker: Tracker) -> dict[str, str]:
    """The authors' parameter names, each with ours."""
    return {_their_name(name): name for name in tracker.state_dict()}


_VIRTUAL = "point_updater.virual_tracks"
_RENAMES = (  # our prefix -> theirs; the first that fits wins, then the rest of the name goes on
    ("encoder.stem.", "encoder.backbone.conv1."),
    ("encoder.fuse.", "encoder.backbone.conv2."),
    ("encoder.head.", "encoder.backbone.conv3."),
    ("context.embed.norm.", "corr_processor.in_norm."),
    ("context.embed.project.", "corr_processor.feat_transform."),
    ("context.embed.offsets.", "corr_processor.posenc_mlps."),
    ("context.pairs.", "corr_processor.transformers."),
    ("updater.input.", "point_updater.input_transform."),
    ("updater.virtual", _VIRTUAL),
    ("updater.time.", "point_updater.time_blocks."),
    ("updater.gather.", "point_updater.space_virtual2point_blocks."),
    ("updater.mix.", "point_updater.space_virtual_blocks."),
    ("updater.scatter.", "point_updater.space_point2virtual_blocks."),
    ("updater.head.", "point_updater.flow_head."),
    ("updater.vis_head.", "point_updater.vis_conf_head."),
)
_PARTS = (  # inside a context
    ("support_from_context", "xblock1_2"),
    ("context_from_support", "xblock2_1"),
    ("pool_support.token", "output_token_1"),
    ("pool_context.token", "output_token_2"),
    ("pool_support.attention", "aggr1"),
    ("pool_context.attention", "aggr2"),
    (".mlp.0.", ".mlp.fc1."),
    (".mlp.2.", ".mlp.fc2."),
    (".skip.", ".downsample.0."),
)


def _their_name(name: str) -> str:
    if name.startswith("encoder.stages."):
        _, _, stage, rest = name.split(".", 3)
        name = f"encoder.backbone.layer{int(stage) + 1}.{rest}"
    for ours, theirs in _RENAMES:
        if name.startswith(ours):
            name = theirs + name[len(ours) :]
    for ours, theirs in _PARTS:
        name = name.replace(ours, theirs)
    crosses = "xblock" in name or "2point_blocks" in name or "2virtual_blocks" in name
    return name.replace(".attention.", ".cross_attn." if crosses else ".attn.")


def _check_time(tracker: Tracker, value: Tensor | None) -> None:
    expected = time_embedding(*tracker.time.shape)[None]
    got = "nothing" if value is None else f"shape {tuple(value.shape)}"
    if value is None or value.shape != expected.shape or not torch.allclose(value.float().cpu(), expected, atol=1e-5):
        raise ValueError(f"state['time_emb']: expected sinusoids of shape {tuple(expected.shape)}, got {got}")


def flatten(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested values by dotted names."""
    flat = {}
    for key, value in values.items():
        flat |= flatten(value, f"{prefix}{key}.") if isinstance(value, Mapping) else {f"{prefix}{key}": value}
    return flat


def read_checkpoint(path: str | Path) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """The configuration, as plain dictionaries, and the parameters of a checkpoint {"cfg", "weight", …}; else ValueError."""
    content = read_saved(path)
    content = content if type(content) is dict else {type(content).__name__: content}
    missing = " and ".join(key for key in ("cfg", "weight") if key not in content)
    if missing:
        found = ", ".join(map(str, itertools.islice(content, 20)))
        raise ValueError(f'{path}: expected a checkpoint {{"cfg", "weight"}}, {missing} missing in {found}')
    weight = content["weight"]
    if not isinstance(weight, dict) or not all(isinstance(x, Tensor) for x in weight.values()):
        raise ValueError(f'{path}: expected named tensors in "weight", got {type(weight).__name__} of other things')
    try:
        cfg = plain(content["cfg"])
        return _resolved(cfg, cfg, itertools.count()), {str(name): value for name, value in weight.items()}
    except ValueError as error:
        raise ValueError(f"{path}: {error}; the file is damaged") from None


def plain(value: Any, depth: int = 0, steps: Iterator[int] | None = None) -> Any:
    """Configuration records as plain dictionaries, lists and values; ValueError if too large, as what holds itself is."""
    steps = _count(depth, steps or itertools.count())
    if isinstance(value, Record):
        for key in ("_content", "_val"):
            if key in value.state:
                return plain(value.state[key], depth + 1, steps)
        value = dict(value) or value.state or {"arguments": value.arguments}
    if isinstance(value, Mapping):
        if any(len(str(key)) > _LETTERS for key in value):
            raise ValueError(f"cfg: keys of over {_LETTERS} letters")
        return {key: plain(item, depth + 1, steps) for key, item in value.items()}
    if isinstance(value, Name):
        return ".".join(value)
    if isinstance(value, list | tuple):
        return [plain(item, depth + 1, steps) for item in value]
    if not isinstance(value, str | int | float | None):
        raise ValueError(f"cfg: expected numbers and text, got {type(value).__name__}")
    return value


def _resolved(value: Any, root: Any, steps: Iterator[int], depth: int = 0) -> Any:
    """OmegaConf's references `${a.b.c}` replaced by what they name."""
    _count(depth, steps)
    if isinstance(value, dict):
        return {key: _resolved(item, root, steps, depth + 1) for key, item in value.items()}
    if isinstance(value, list):
        return [_resolved(item, root, steps, depth + 1) for item in value]
    named = re.fullmatch(r"\$\{([\w.]+)\}", value) if isinstance(value, str) else None
    if not named:
        return value
    target = root
    for part in named.group(1).split("."):
        if not isinstance(target, dict) or part not in target:
            return value  # a reference into a part we do not need; the strict mapping complains if we do
        target = target[part]
    return _resolved(target, root, steps, depth + 1)


def _count(depth: int, steps: Iterator[int]) -> Iterator[int]:
    if depth > _DEPTH or next(steps) > _VALUES:
        raise ValueError(f"cfg refers to itself, or has over {_VALUES} values or {_DEPTH} levels")
    return steps
