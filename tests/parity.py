"""Compare the tracker with recorded numbers of the authors' released model, stage by stage.

`python -m tests.parity` prints the table; `test_parity.py` asserts it. Each entry is (largest difference, tolerance).
Teacher-forced stages get the recorded inputs of that very stage; free-running ones only the clip and the queries.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import torch

from tapip3d_lite.model.cloud import Level, Normalizer, quantile_roi
from tapip3d_lite.model.frames import Frames
from tapip3d_lite.model.n2n import N2N
from tapip3d_lite.model.neighbors import Neighbors
from tapip3d_lite.model.registry import make_space
from tapip3d_lite.model.windows import State, Window
from tapip3d_lite.official import from_official_state
from tapip3d_lite.queries import grid_queries

GOLDEN = Path(__file__).resolve().parents[2] / "shared" / "golden"
SMALL = Path(__file__).resolve().parent / "data" / "parity_small.npz"
FAST = True  # which form of the parts is measured
STAGED = ("A_raw", "A_local", "A_pad", "A_rough", "B_raw")
# Noise between valid float32 evaluations of normalised coordinates, after 1, 2, ... updates in a row (times 10).
_FREE = [1e-5, 6e-5, 3e-4, 2e-3, 7e-3, 4e-2]


class Report(dict):
    """stage -> (largest difference so far, tolerance)."""

    def add(self, stage, ours, theirs, tolerance):
        difference = float((ours.double() - theirs.double()).abs().max()) if ours.numel() else 0.0
        worst = np.maximum(self.get(stage, (0.0, 0))[0], difference)  # unlike max(), keeps NaN
        self[stage] = float(worst), tolerance

    def same_sets(self, stage, ours, theirs):
        self.add(stage, ours.sort(-1).values, theirs.sort(-1).values, 0)

    def failures(self):
        return {stage: value for stage, value in self.items() if not value[0] <= value[1]}


class Golden:
    """A recorded run, its tracker and its inputs with B = 1."""

    def __init__(self, path):
        self.arrays = np.load(path)
        self.config = json.loads(str(self.arrays["config_json"]))
        state = {key[6:]: self[key] for key in self.arrays.files if key.startswith("param.")}
        if state:
            self.tracker = from_official_state(self.config, state, FAST)
        self.frames = Frames(*(self[f"in.{key}"][None] for key in ("rgb", "depth", "intrinsics", "extrinsics")))
        self.queries = self["in.query_point"][None]
        self.space = make_space("camera" if self.config.get("eval_mode") == "local" else "world")
        self.state = State.start(self.queries, self.frames, self.space, self.config["model"]["seq_len"] // 2)

    def __getitem__(self, key):
        return torch.from_numpy(self.arrays[key])

    def __contains__(self, key):
        return key in self.arrays.files

    def windows(self):
        index = 0
        while f"w{index}.range" in self:
            yield f"w{index}", *self[f"w{index}.range"].tolist()
            index += 1


@torch.no_grad()
def measure(path):
    """Every recorded stage of one file."""
    golden, report = Golden(path), Report()
    _cloud(golden, report)
    for name, start, stop in golden.windows():
        _window(golden, report, name, start, stop)
    if "rough" not in Path(path).stem:  # chaotic on purpose: meaningful only teacher-forced
        free_running(golden.tracker, golden, report, golden.config["num_iters"])
    return report


def _scene(golden, features):
    return golden.tracker.scene(golden.frames, features, golden.space, None)


def _cloud(golden, report):
    features = golden.tracker.encoder(golden.frames.rgb)
    theirs = golden["image_feats"][None]
    report.add("features", features[0], theirs[0, : len(golden.frames)], 1e-5)
    scene = _scene(golden, theirs[:, : len(golden.frames)])
    support = golden.tracker.support(scene, golden.queries, golden.state.queries)
    for i, level in enumerate(scene.levels):
        report.add("pyramid features", level.features[0].movedim(-1, 1), golden[f"pyr{i}.feats"], 1e-5)
        report.add("pyramid points", level.points[0].movedim(-1, 1), golden[f"pyr{i}.world_coords"], 1e-5)
        report.same_sets("support indices", support[i].indices[0, :, 1:], golden[f"support_knn_idx{i}"])
    for name, start, stop in golden.windows():
        cut = scene.cut(start, stop)
        config = golden.tracker.config
        norm = Normalizer.fit(cut.points, cut.valid, config.norm_mode, config.norm_scale)
        report.add("mean and std", norm.mean.flatten(), golden[f"{name}.mean_coords"], 1e-6)
        report.add("mean and std", norm.std.flatten().expand(3), golden[f"{name}.std_coords"], 1e-6)
        for i, near in enumerate(x.normalized(norm) for x in support):
            report.add(
                "normalised points",
                norm.normalize(scene.levels[i].points)[0].movedim(-1, 1),
                golden[f"{name}.pyr{i}.norm_coords"],
                1e-5,
            )
            order, other = near.indices[0].argsort(-1), golden[f"support_knn_idx{i}"].argsort(-1) + 1
            other = torch.cat([torch.zeros_like(other[:, :1]), other], 1)
            for stage, ours in (("feats_raw", near.features), ("offsets", near.offsets)):
                rows = [
                    x.gather(1, o[..., None].expand(-1, -1, x.shape[-1]))
                    for x, o in ((ours[0], order), (golden[f"{name}.sup{i}.{stage}"], other))
                ]
                report.add(f"support {stage.split('_')[0]}", *rows, 5e-5 if stage == "feats_raw" else 1e-5)


def _forced_window(golden, name, start, stop, columns):
    """The recorded normalised window, as our tracker would hold it."""
    tracker, config = golden.tracker, golden.tracker.config
    norm = Normalizer(
        golden[f"{name}.mean_coords"].view(1, 1, 1, 3), golden[f"{name}.std_coords"].view(1, 1, 1, 3), config.norm_scale
    )
    scene = _scene(golden, golden["image_feats"][None, : len(golden.frames)]).cut(start, stop)
    levels, kept, supports = [], [], []
    for i, level in enumerate(scene.levels):
        points = golden[f"{name}.pyr{i}.norm_coords"][None, start:stop].movedim(2, -1)
        features = golden[f"pyr{i}.feats"][None, start:stop].movedim(2, -1)
        levels.append(tracker.context.prepare(i, Level(features, points, level.valid)))
        features, offsets = (golden[f"{name}.sup{i}.{key}"][None] for key in ("feats_raw", "offsets"))
        pick = columns if features.shape[1] != len(columns) else slice(None)
        support = Neighbors(features[:, pick], offsets[:, pick], torch.zeros_like(offsets[:, pick, 0]))
        kept.append(tracker.context.describe(i, support))
        supports.append(support)
    return Window(scene, norm, levels, kept, support=supports)


def _window(golden, report, name, start, stop):
    tracker = golden.tracker
    columns = (golden.queries[0, :, 0] < stop).nonzero()[:, 0]
    window = _forced_window(golden, name, start, stop, columns)
    seen = Recording(tracker)
    for i in range(golden.config["num_iters"]):
        step = f"{name}.i{i}"
        coords, logits = golden[f"{step}.norm_coords_in"][None], golden[f"{step}.visibs_in"][None]
        coords, logits = tracker.update(window, coords, logits)
        report.add("coords, forced", coords[0], golden[f"{step}.norm_coords_out"], 1e-5)
        report.add("logits, forced", logits[0], golden[f"{step}.visibs_out"], 5e-5)
        report.add(
            "updater output, end to end", seen.output[0, ..., :4], golden[f"{step}.updater_output"][..., :4], 5e-5
        )
        if i == 0:
            _first_iteration(golden, report, step, window, seen)
    seen.close()


def _first_iteration(golden, report, step, window, seen):
    tracker, width = golden.tracker, golden[f"{step}.n2n"].shape[-1]
    for level in range(tracker.config.levels):
        report.same_sets("context indices", seen.near[level].indices[0], golden[f"{step}.context_knn_idx{level}"])
    n2n = torch.cat(seen.contexts, -1)[0]
    report.add("n2n", n2n, golden[f"{step}.n2n"], 3e-4)
    token, theirs = seen.token[0], golden[f"{step}.updater_input"]
    # One float32 ulp of a coordinate, times 2^13 inside the sine, is 1e-3: the noise of the raw Fourier features.
    report.add("token: fourier", token[..., 1 + width :], theirs[..., 1 + width :], 4e-3)
    report.add("token: visibility, n2n", token[..., : 1 + width], theirs[..., : 1 + width], 3e-4)
    report.add(
        "updater, forced", tracker.updater(theirs[None])[0, ..., :4], golden[f"{step}.updater_output"][..., :4], 2e-5
    )
    if f"{step[:2]}.n2n_l0_support_tokens" in golden or f"{step}.n2n_l0_support_tokens" in golden:
        prefix = step if f"{step}.n2n_l0_support_tokens" in golden else step[:2]
        support = golden[f"{prefix}.n2n_l0_support_tokens"]
        report.add("support tokens", N2N.describe(tracker.context, 0, window.support[0])[0], support, 3e-4)
        near, theirs = seen.near[0], golden[f"{prefix}.n2n_l0_context_tokens"]
        ours = (near.features + tracker.context.embed.offset(0, near.offsets))[0].flatten(0, 1)
        orders = near.indices[0].flatten(0, 1).argsort(-1), golden[f"{step}.context_knn_idx0"].flatten(0, 1).argsort(-1)
        rows = [
            x.gather(1, o[..., None].expand(-1, -1, x.shape[-1])) for x, o in zip((ours, theirs), orders, strict=True)
        ]
        report.add("context tokens", *rows, 3e-4)


class Recording:
    """What passes through the tracker's parts during the last update, by hooks."""

    def __init__(self, tracker):
        assert isinstance(tracker.context, N2N)
        self.near, self.contexts, self.token, self.output = {}, [], None, None
        self.hooks = [
            tracker.context.register_forward_hook(self._context),
            tracker.updater.register_forward_hook(self._updater),
        ]

    def _context(self, module, args, out):
        self.contexts = [] if args[0] == 0 else self.contexts
        self.contexts.append(out)
        self.near[args[0]] = args[2]

    def _updater(self, module, args, out):
        self.token, self.output = args[0], out

    def close(self):
        for hook in self.hooks:
            hook.remove()


def free_running(tracker, golden, report, iterations, prefix="", space=None):
    """Nothing but the clip goes in; each update of each window and the result are compared."""
    space = golden.space if space is None else make_space(space)
    steps = tracker.steps(golden.frames, golden.queries, iterations=iterations, space=space)
    for done, step in enumerate(steps):
        name = f"{prefix}w{2 * step.start // tracker.config.window}.i{step.iteration}"
        tolerance = _FREE[min(done, len(_FREE) - 1)]
        theirs = golden[f"{name}.coords_world"][:, step.columns], golden[f"{name}.visib_logits"][:, step.columns]
        count = len(theirs[0])  # padded frames are cut from the record
        report.add(f"free run, update {done + 1}: coords", step.xyz[0, :count], theirs[0], tolerance)
        report.add(f"free run, update {done + 1}: logits", step.logits[0, :count], theirs[1], 30 * tolerance)
    xyz, logits = tracker(golden.frames, golden.queries, iterations=iterations, space=space)
    out = prefix or "out."
    report.add("final: coords", xyz[0], golden[f"{out}coords"], _FREE[-1])
    report.add("final: logits", logits[0], golden[f"{out}visib_logits"], 30 * _FREE[-1])


def as_clip(golden):
    """The recorded inputs as a clip; colours were recorded as k / 255 or not, so the tracker reads its own frames."""
    from tapip3d_lite.clip import Clip

    video = (golden["in.rgb"].movedim(1, -1) * 255).round().byte().numpy()
    return Clip(video, *(golden[f"in.{key}"].numpy() for key in ("depth", "intrinsics", "extrinsics")))


@torch.no_grad()
def measure_bidirectional(path):
    """Complete inference: two directions, a support grid, a region of interest, a threshold."""
    golden, report = Golden(path), Report()
    clip, roi = as_clip(golden), golden["in.depth_roi"]
    report.add("region of interest", torch.tensor(quantile_roi(golden["in.depth"])), roi, 1e-6)
    for name, frame in (("fwd", 0), ("bwd", len(clip) - 1)):
        grid = torch.from_numpy(grid_queries(clip, golden.config["grid_size"], frame))
        report.add("grid queries", grid[:, 1:], golden[f"{name}.grid_queries"][:, 1:], 1e-5)
    pred = golden.tracker.track(
        clip, golden.queries[0].numpy(), support_grid=golden.config["grid_size"], iterations=golden.config["num_iters"]
    )
    report.add("final: coords", torch.from_numpy(pred.xyz), golden["out.coords"], _FREE[-1])
    before = torch.arange(len(clip))[:, None] < golden.queries[0, :, 0]
    logits = torch.where(before, golden["bwd.visib_logits"].flip(0), golden["fwd.visib_logits"])
    report.add("final: logits", torch.from_numpy(pred.visible_logits), logits, 30 * _FREE[-1])
    clear = (logits.sigmoid() - 0.9).abs() > 0.05
    report.add("final: visible", torch.from_numpy(pred.visible)[clear], golden["out.visibs"][clear], 0)
    return report


@torch.no_grad()
def measure_checkpoint(path):
    """A checkpoint file in the authors' format, in both spaces."""
    from tapip3d_lite.official import load_official

    golden, report = Golden(path), Report()
    tracker = load_official(path.with_name("checkpoint_small.pth"), FAST)
    report.add("features", tracker.encoder(golden.frames.rgb[:, :1])[0, 0], golden["image_feats_f0"], 1e-5)
    for prefix, space in (("raw.", "world"), ("local.", "camera")):
        part = Report()
        free_running(tracker, golden, part, golden.config["num_iters"], prefix, space)
        report |= {f"{space}: {stage}": value for stage, value in part.items()}
    return report


def measurements():
    """(name, function) of every recorded file beside the checkout."""
    yield from ((name, measure) for name in STAGED)
    yield "A_bidir", measure_bidirectional
    yield "checkpoint_small_expected", measure_checkpoint


def main():
    failed = 0
    for name, function in measurements():
        report = function(GOLDEN / f"{name}.npz")
        failed += len(report.failures())
        for stage, (difference, tolerance) in report.items():
            sys.stdout.write(
                f"{name:10s} {stage:34s} {difference:9.1e} <= {tolerance:7.0e} {'' if difference <= tolerance else 'FAILS'}\n"
            )
    sys.exit(failed)


if __name__ == "__main__":
    main()
