"""The tracker as a whole: windows, batches, spaces, training steps, and what a user calls."""

import contextlib
import copy
import dataclasses
import io
import re

import numpy as np
import pytest
import torch

import tapip3d_lite as t3d
from tapip3d_lite.clip import Clip
from tapip3d_lite.geometry import invert, project, transform, unproject
from tapip3d_lite.model import stream, track
from tapip3d_lite.model.frames import Frames, frames_from_clip, resize_clip
from tapip3d_lite.model.n2n import Context
from tapip3d_lite.model.neighbors import KNearest
from tapip3d_lite.model.spaces import World
from tapip3d_lite.model.tracker import Tracker, TrackerConfig
from tapip3d_lite.model.windows import State, window_ends
from tapip3d_lite.official import from_official_state, parameter_names
from tests import parity
from tests.tiny import SMALL

pytestmark = pytest.mark.filterwarnings("ignore:clip .* does not fit together")  # the golden clip is noise


@pytest.fixture(scope="module")
def golden():
    return parity.Golden(parity.SMALL)


@pytest.fixture(scope="module")
def clip(golden):
    return parity.as_clip(golden)


@pytest.fixture(autouse=True)
def _no_grad(request):
    with torch.set_grad_enabled("gradient" in request.node.name):
        yield


def run(golden, frames=None, queries=None, **options):
    frames, queries = golden.frames if frames is None else frames, golden.queries if queries is None else queries
    return golden.tracker(frames, queries, **{"iterations": 2} | options)


def small_tracker(**changes):
    torch.manual_seed(0)
    return Tracker(TrackerConfig(**(SMALL | changes))).eval()


# --- windows ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("frames", "ends"), [(4, []), (8, [8]), (12, [8, 12]), (20, [8, 12, 16, 20])])
def test_windows_overlap_by_half(frames, ends):
    assert list(window_ends(frames, 8)) == ends


def test_short_clips_have_no_window_and_return_the_query(golden):
    queries = golden.queries[:, golden.queries[0, :, 0] < 4]
    xyz, logits = run(golden, golden.frames.cut(0, 4), queries)
    assert torch.equal(xyz, queries[:, None, :, 1:].expand_as(xyz))
    assert not logits.any()
    moved, _ = run(golden, golden.frames.cut(0, 6), queries)
    assert not torch.equal(moved, queries[:, None, :, 1:].expand_as(moved))


def test_padding_repeats_the_last_frame(golden):
    xyz, _ = run(golden)
    longer, _ = run(golden, golden.frames.pad(4))
    assert torch.equal(longer[:, : xyz.shape[1]], xyz)


def test_initial_values_of_a_window():
    still = torch.arange(2.0)[None, None, :, None].expand(1, 8, 2, 3).clone()
    state = State(still, torch.zeros(1, 8, 2), still[:, 0].clone(), torch.tensor([[0, 3]]))
    state.coords[:, :4, 0] = torch.arange(4.0)[None, :, None]
    state.logits[:, :4] = torch.arange(4.0)[None, :, None]
    assert state.members(3, None)[0].tolist() == [0]
    columns, active = state.members(6, None)
    assert columns.tolist() == [0, 1] and bool(active.all())
    coords, logits = state.initial(2, 6, columns)
    assert coords[0, :, 0, 0].tolist() == [2, 3, 3, 3]  # half is known, its last frame is repeated
    assert coords[0, :, 1, 0].tolist() == [1, 1, 1, 1]
    assert logits[0, :, 0].tolist() == [2, 3, 3, 3]
    late = State(still, state.logits, still[:, 0], torch.tensor([[0, 4]]))
    coords, logits = late.initial(2, 6, columns)  # queried in the second half: no history
    assert coords[0, :, 1, 0].tolist() == [1, 1, 1, 1] and logits[0, :, 1].tolist() == [0, 0, 0, 0]


def test_a_late_query_changes_nothing_in_windows_before_it(golden):
    early = golden.queries[:, golden.queries[0, :, 0] < 3]
    late = early[:, :2].clone()
    late[..., 0] = 9
    alone, _ = run(golden, queries=early)
    both, _ = run(golden, queries=torch.cat([early, late], 1))
    count = early.shape[1]
    assert torch.equal(both[:, :4, :count], alone[:, :4])
    assert torch.equal(both[:, :4, count:], late[:, None, :, 1:].expand(1, 4, 2, 3))


# --- batches ------------------------------------------------------------------------------------------------------


def stack(*parts):
    return Frames(*(torch.cat([getattr(p, f.name) for p in parts]) for f in dataclasses.fields(Frames)))


def test_a_batch_equals_its_elements_and_masked_tracks_are_absent(golden):
    other = golden.frames.flip()
    count = golden.queries.shape[1]
    queries = golden.queries.repeat(2, 1, 1)
    active = torch.ones(2, count, dtype=torch.bool)
    active[1, 4:] = False
    queries[1, 4:, 1:] = 0
    batch, logits = run(golden, stack(golden.frames, other), queries, active=active)
    for b, frames, number in ((0, golden.frames, count), (1, other, 4)):
        alone = run(golden, frames, queries[b : b + 1, :number])
        assert torch.allclose(batch[b, :, :number], alone[0][0], atol=2e-4)
        assert torch.allclose(logits[b, :, :number], alone[1][0], atol=5e-3)
    assert torch.equal(batch[1, :, 4:], torch.zeros_like(batch[1, :, 4:]))


def test_chunks_of_tracks_have_no_meaning(golden, monkeypatch):
    whole, _ = run(golden)
    monkeypatch.setattr("tapip3d_lite.model.tracker._CHUNK", 4000)
    assert torch.allclose(run(golden)[0], whole, atol=1e-4)


def test_no_queries_give_no_tracks(golden):
    xyz, logits = run(golden, queries=golden.queries[:, :0])
    assert xyz.shape == (1, 10, 0, 3) and logits.shape == (1, 10, 0)


# --- spaces -------------------------------------------------------------------------------------------------------


def rigid(seed):
    rng = np.random.default_rng(seed)
    rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation * np.linalg.det(rotation), rng.normal(size=3)
    return torch.tensor(pose, dtype=torch.float32)


def moved(golden, pose):
    """The same scene and cameras in another world frame."""
    frames = dataclasses.replace(golden.frames, extrinsics=golden.frames.extrinsics @ invert(pose))
    queries = torch.cat([golden.queries[..., :1], transform(golden.queries[..., 1:], pose)], -1)
    return frames, queries


@pytest.mark.parametrize("space", ["camera", "first"])
@pytest.mark.parametrize("seed", [0, 1])
def test_a_rigid_motion_of_scene_and_cameras_moves_the_tracks_with_it(golden, space, seed):
    pose = rigid(seed)
    xyz, _ = run(golden, space=space, iterations=1)
    other, _ = run(golden, *moved(golden, pose), space=space, iterations=1)
    assert (xyz - golden.queries[:, None, :, 1:]).abs().max() > 0.05  # there is motion to compare
    assert torch.allclose(other, transform(xyz, pose), atol=1e-4)


def test_a_translation_of_the_world_moves_world_tracks_with_it(golden):
    pose = torch.eye(4)
    pose[:3, 3] = torch.tensor([1.0, -2, 0.5])
    xyz, _ = run(golden, iterations=1)
    other, _ = run(golden, *moved(golden, pose), iterations=1)
    assert torch.allclose(other, transform(xyz, pose), atol=1e-4)


def test_a_rotation_of_the_world_is_seen_in_world_but_not_in_first(golden):
    pose = rigid(2)
    pose[:3, 3] = 0
    xyz, _ = run(golden, iterations=1)
    other, _ = run(golden, *moved(golden, pose), iterations=1)
    assert not torch.allclose(other, transform(xyz, pose), atol=1e-2)  # the released model reads axis by axis
    first = dataclasses.replace(
        golden.frames, extrinsics=golden.frames.extrinsics @ invert(golden.frames.extrinsics[:, :1])
    )
    queries = torch.cat(
        [golden.queries[..., :1], transform(golden.queries[..., 1:], golden.frames.extrinsics[:, 0])], -1
    )
    world, _ = run(golden, first, queries, iterations=1)
    assert torch.allclose(run(golden, first, queries, space="first", iterations=1)[0], world, atol=1e-5)


def test_world_and_camera_differ_only_by_the_cameras_motion(golden):
    still = dataclasses.replace(golden.frames, extrinsics=torch.eye(4).expand_as(golden.frames.extrinsics))
    assert torch.allclose(run(golden, still, space="camera")[0], run(golden, still, space="world")[0], atol=1e-5)
    assert not torch.allclose(run(golden, space="camera")[0], run(golden, space="world")[0], atol=1e-2)


# --- training -----------------------------------------------------------------------------------------------------


def step_loss(step):
    return step.xyz.square().mean() + step.logits.square().mean()


def test_gradient_of_steps_one_by_one_is_the_gradient_of_their_sum(golden):
    tracker, total = golden.tracker, []
    for at_once in (True, False):
        tracker.zero_grad()
        features = tracker.encoder(golden.frames.rgb).detach().requires_grad_()
        losses = []
        for step in tracker.steps(golden.frames, golden.queries, iterations=2, features=features):
            losses.append(step_loss(step))
            if not at_once:
                losses.pop().backward(retain_graph=True)
        if at_once:
            sum(losses).backward()
        assert all(p.grad is not None for n, p in tracker.named_parameters() if not n.startswith("encoder"))
        total.append([features.grad.clone(), *[p.grad.clone() for p in tracker.updater.parameters()]])
    tracker.zero_grad(set_to_none=True)
    for a, b in zip(*total, strict=True):
        assert torch.allclose(a, b, rtol=1e-3, atol=1e-4 * float(a.abs().max()) + 1e-7)


def test_gradient_does_not_flow_from_one_iteration_to_the_one_before(golden):
    steps = list(golden.tracker.steps(golden.frames, golden.queries, iterations=2))
    (gradient,) = torch.autograd.grad(steps[1].coords.sum(), steps[0].coords, allow_unused=True)
    assert gradient is None
    assert len(steps) == 4 and [s.start for s in steps] == [0, 0, 4, 4]


def test_bf16_autocast_keeps_coordinates_in_float32(golden):
    with torch.autocast("cpu", torch.bfloat16):
        xyz, logits = run(golden, iterations=1)
    assert xyz.dtype == logits.dtype == torch.float32
    assert torch.allclose(xyz, run(golden, iterations=1)[0], atol=0.1)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
def test_a_gpu_gives_the_same_tracks(golden):
    tracker = copy.deepcopy(golden.tracker).cuda()
    xyz, logits = tracker(golden.frames.to("cuda"), golden.queries.cuda(), iterations=1)
    expected = run(golden, iterations=1)
    assert torch.allclose(xyz.cpu(), expected[0], atol=1e-3)
    assert torch.allclose(logits.cpu(), expected[1], atol=3e-2)


# --- configuration ------------------------------------------------------------------------------------------------


def test_presets_have_their_sizes():
    sizes = {
        name: sum(p.numel() for p in Tracker(TrackerConfig.preset(name)).parameters()) for name in ("lite", "paper")
    }
    assert sizes["lite"] <= 3e6
    assert 25e6 < sizes["paper"] < 27e6


class Mean(Context):
    """The mean feature around the estimate, minus the query's own."""

    def __init__(self, config):
        super().__init__()
        self.width = config.feature_dim

    def forward(self, index, kept, near):
        return near.features.mean(-2) - kept[:, None, :, 0]


class Mirror(World):
    """The world with x mirrored."""

    def flip(self, x):
        return x * x.new_tensor([-1, 1, 1])

    def lift(self, depths, intrinsics, extrinsics):
        return self.flip(super().lift(depths, intrinsics, extrinsics))

    def from_world(self, xyz, intrinsics, extrinsics):
        return self.flip(xyz)

    def to_world(self, coords, intrinsics, extrinsics, depths):
        return self.flip(coords)

    def to_pixels(self, coords, intrinsics, extrinsics):
        return super().to_pixels(self.flip(coords), intrinsics, extrinsics)


def test_own_parts_can_be_passed_for_a_switch(golden):
    calls = []

    def neighborhood(level, coords, cells):
        calls.append(cells)
        return KNearest(TrackerConfig(**SMALL))(level, coords, cells)

    changes = {"image_size": (48, 64), "context": Mean, "neighborhood": neighborhood, "space": Mirror()}
    xyz, logits = small_tracker(**changes)(golden.frames, golden.queries, iterations=1)
    assert xyz.isfinite().all() and logits.isfinite().all() and calls
    assert (xyz[:, 9] - golden.queries[:, :, 1:]).abs().max() < 0.5  # it came back from the mirror
    with pytest.raises(ValueError, match="updater: expected one of"):
        TrackerConfig(updater="none")


def test_inputs_that_cannot_work(golden):
    tracker, frames, queries = golden.tracker, golden.frames, golden.queries
    bad = queries.clone()
    bad[0, 0, 0] = 10
    cases = [
        (
            dataclasses.replace(frames, rgb=frames.rgb[..., :40], depths=frames.depths[..., :40]),
            queries,
            {},
            "images of",
        ),
        (frames, queries[0], {}, "queries: expected"),
        (frames, bad, {}, "t must be in"),
        (frames, queries, {"iterations": 0}, "iterations"),
        (frames, queries, {"depth_roi": (50.0, 60.0)}, "widen depth_roi"),
    ]
    for frames, rows, options, message in cases:
        with pytest.raises(ValueError, match=message):
            tracker(frames, rows, **options)
    with pytest.raises(ValueError, match=r"Frames\.rgb"):
        Frames(frames.rgb[:, :1], frames.depths, frames.intrinsics, frames.extrinsics)


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ({"corr_feature": {"name": "knn_corr_4d"}}, r"corr_feature\.k_neighbors: missing"),
        ({"colour": 1}, "unknown options colour"),
        ({"relative": True}, "relative: only False"),
        ({"seq_len": 10}, "time_emb"),
    ],
)
def test_official_options_are_strict(golden, option, message):
    model = {k: v for k, v in (golden.config["model"] | option).items() if v is not None}
    with pytest.raises(ValueError, match=message):
        from_official_state({"model": model}, {})


# Exactly what the released checkpoint stores: options that have a default in the released code are not in it.
RELEASED = {
    "name": "point_tracker_3d",
    "seq_len": 16,
    "norm_mode": "isotropic",
    "corr_levels": 4,
    "use_local_pos_input": False,
    "find_knn_in_normalized_space": False,
    "use_uv_input": True,
    "center_rgb": True,
    "encoder": {"name": "cotracker_cnn", "output_dim": 128, "stride": 4, "pretrained": True, "freeze_mode": "none"},
    "corr_feature": {
        "name": "knn_corr_4d",
        "k_neighbors": 32,
        "posenc_mlp_layers": 3,
        "posenc_mlp_dim": 128,
        "transformer_dim": 128,
        "transformer_num_heads": 1,
        "transformer_head_dim": 128,
        "transformer_mlp_ratio": 1.0,
        "better_depth_downsample": True,
    },
    "point_updater": {
        "name": "efficient_updateformer",
        "space_depth": 3,
        "time_depth": 3,
        "input_dim": 777,
        "hidden_size": 384,
        "output_dim": 5,
        "mlp_ratio": 4.0,
        "num_virtual_tracks": 64,
        "add_space_attn": True,
        "linear_layer_for_vis_conf": True,
    },
}


@pytest.mark.parametrize("size", [None, (256, 320)])
def test_the_released_configuration_loads(size):
    torch.manual_seed(0)
    ours = Tracker(TrackerConfig.preset("paper", center_rgb=True, image_size=size or (384, 512)))
    own = ours.state_dict()
    state = {theirs: own[name] for theirs, name in parameter_names(ours).items()}
    state["point_updater.virual_tracks"] = state["point_updater.virual_tracks"].transpose(1, 2)
    cfg = {"model": RELEASED} | ({"train_dataset": {"resolution": list(size)}} if size else {})
    loaded = from_official_state(cfg, state | {"time_emb": ours.time[None]})
    assert (
        loaded.config == ours.config.replace(as_released=True)
        and loaded.config.heads == 8
        and loaded.config.head_dim == 48
    )
    assert all(torch.equal(x, own[name]) for name, x in loaded.state_dict().items())
    assert sum(p.numel() for p in loaded.parameters()) == pytest.approx(25.7e6, rel=0.01)


def test_a_bar_that_is_redrawn_at_every_update(monkeypatch):
    """What `tqdm.update` returns when it draws must not become the updater's result."""
    monkeypatch.setenv("TQDM_MININTERVAL", "0")
    torch.manual_seed(0)
    tracker = Tracker(TrackerConfig.preset("lite", **SMALL)).eval()
    clip = t3d.simulate_clip(seed=0, frames=6, size=SMALL["image_size"], tracks=8)
    shown = io.StringIO()
    with contextlib.redirect_stderr(shown):
        watched = tracker.track(clip, progress=True)
    np.testing.assert_array_equal(watched.xyz, tracker.track(clip).xyz)
    total = int(re.findall(r"(\d+)/(\d+)", shown.getvalue())[-1][1])
    assert f"{total}/{total}" in shown.getvalue() and total > 2


def test_a_space_may_be_a_name_a_class_or_an_object(golden):
    tracker, inputs = golden.tracker, (golden.frames, golden.queries)
    results = [tracker(*inputs, space=space, iterations=1)[0] for space in ("world", World, World())]
    assert torch.equal(results[0], results[1]) and torch.equal(results[0], results[2])


def test_official_parameters_are_strict(golden):
    state = {key[6:]: golden[key] for key in golden.arrays.files if key.startswith("param.")}
    name = "point_updater.flow_head.weight"
    missing = {key: value for key, value in state.items() if key != name}
    for wrong, message in (
        (missing, f"missing parameters: {name}"),
        (state | {"extra": torch.ones(1)}, "unknown parameters: extra"),
        (state | {name: state[name][:1]}, "flow_head.*expected shape"),
        (state | {"time_emb": state["time_emb"] + 1}, "time_emb"),
    ):
        with pytest.raises(ValueError, match=message):
            from_official_state(golden.config, wrong)
    with pytest.raises(ValueError, match="'model'"):
        from_official_state({}, state)


# --- what a user calls --------------------------------------------------------------------------------------------


def pixel_queries(clip, count=5, frame=0):
    from tapip3d_lite.queries import grid_queries

    return grid_queries(clip, 4, frame)[:count]


def test_track_returns_world_tracks_in_the_order_of_the_queries(golden, clip):
    queries = np.concatenate([pixel_queries(clip, 3, frame) for frame in (5, 0, 9)])
    pred = golden.tracker.track(clip, queries, iterations=2, support_grid=3)
    assert pred.xyz.shape == (10, 9, 3) and np.array_equal(pred.queries, queries)
    roi = (1e-7, 1e3)
    forward = golden.tracker.track(clip, queries, iterations=2, support_grid=3, bidirectional=False, depth_roi=roi)
    both = golden.tracker.track(clip, queries, iterations=2, support_grid=3, depth_roi=roi)
    backward = np.arange(10)[:, None] < queries[:, 0]
    assert np.array_equal(both.xyz[~backward], forward.xyz[~backward])
    assert np.abs(both.xyz[backward] - forward.xyz[backward]).max() > 1e-3


def test_tracking_backward_is_tracking_the_reversed_clip(golden, clip):
    queries = pixel_queries(clip, 6, 9)
    options = {"iterations": 2, "support_grid": 2}
    pred = golden.tracker.track(clip, queries, **options)
    back = Clip(*(np.ascontiguousarray(x[::-1]) for x in (clip.video, clip.depths, clip.intrinsics, clip.extrinsics)))
    turned = queries.copy()
    turned[:, 0] = 0
    other = golden.tracker.track(back, turned, **options)
    np.testing.assert_allclose(pred.xyz[:9], other.xyz[::-1][:9], atol=1e-5)


def test_threshold_single_query_and_progress(golden, clip):
    query = pixel_queries(clip, 1)
    options = {"iterations": 1, "support_grid": 0, "depth_roi": None}
    everything = golden.tracker.track(clip, query, visible_threshold=0.0, **options)
    nothing = golden.tracker.track(clip, query, visible_threshold=1.0, progress=True, **options)
    assert everything.xyz.shape == (10, 1, 3)
    assert everything.visible.all() and not nothing.visible.any()


def test_clips_of_another_size_are_resized(golden, clip):
    larger = resize_clip(clip, (95, 127))
    pred = golden.tracker.track(larger, pixel_queries(larger), iterations=1, support_grid=0)
    assert pred.xyz.shape[0] == 10 and np.isfinite(pred.xyz).all()
    frames = frames_from_clip(larger, (48, 64))
    assert frames.size == (48, 64)
    assert torch.allclose(frames.intrinsics[0], torch.from_numpy(clip.intrinsics), atol=1e-3)


def blob_clip(size, at, width=6.0):
    """One frame of size (H, W) with a white blob around the pixel `at`, and a gentle dent of that form in its depth."""
    v, u = np.mgrid[: size[0], : size[1]]
    blob = np.exp(-((u - at[0]) ** 2 + (v - at[1]) ** 2) / (2 * width**2))
    intrinsics = np.array([[[110.0, 0, 60], [0, 90, 50], [0, 0, 1]]], np.float32)
    video = np.rint(255 * blob)[None, ..., None].repeat(3, -1).astype(np.uint8)
    return Clip(video, (2 - 0.1 * blob[None]).astype(np.float32), intrinsics, np.eye(4, dtype=np.float32)[None])


def middle_of(weight):
    """The centroid (u, v) of a map of weights."""
    v, u = np.mgrid[: weight.shape[0], : weight.shape[1]]
    return np.array([(u * weight).sum(), (v * weight).sum()]) / weight.sum()


@pytest.mark.parametrize("size", [(24, 32), (48, 64), (71, 100), (150, 333), (96, 50)], ids=str)
def test_image_depth_and_camera_of_a_resized_clip_agree(size):
    """A blob at a known point, found in the image and in the depth, against the point's projection."""
    at = np.array([[24.0, 70.0]])
    clip = blob_clip((96, 128), at[0])
    point = unproject(at, np.full(1, 1.9), clip.intrinsics[0])
    ratio = np.array([size[1] / 128, size[0] / 96])
    ours, released = (resize_clip(clip, size, corners) for corners in (False, True))
    assert np.array_equal(ours.video, released.video) and np.array_equal(ours.depths, released.depths)
    seen, dented = middle_of(ours.video[0, ..., 0].astype(float)), middle_of(2.0 - ours.depths[0])
    np.testing.assert_allclose(seen, dented, atol=0.02)
    np.testing.assert_allclose(seen, project(point, ours.intrinsics[0])[0][0], atol=0.02)
    # As released, the camera lies beside the image: by half of 1 - ratio at the edges, not at all in the middle.
    beside = project(point, released.intrinsics[0])[0][0] - seen
    share = 1 - 2 * at[0] / (np.array([128, 96]) - 1)
    np.testing.assert_allclose(beside, share * (1 - ratio) / 2, atol=0.02)


def test_only_the_released_model_keeps_the_released_rule(golden, clip, monkeypatch):
    assert (
        golden.tracker.config.as_released
        and not TrackerConfig().as_released
        and not TrackerConfig.preset("lite").as_released
    )
    tracker, larger, rules = golden.tracker, resize_clip(clip, (96, 128)), []
    for module in (track, stream):
        spy = lambda clip, size, corners: rules.append(corners) or resize_clip(clip, size, corners)  # noqa: E731
        monkeypatch.setattr(module, "resize_clip", spy)
    queries, before = pixel_queries(larger), tracker.config
    xyz = []
    try:
        for corners in (True, False):
            tracker.config = before.replace(as_released=corners)
            xyz.append(tracker.track(larger, queries, iterations=1, support_grid=0, bidirectional=False).xyz)
            online = tracker.stream(queries, iterations=1, support_grid=0)
            online.push(larger.video[0], larger.depths[0], larger.intrinsics[0], larger.extrinsics[0])
    finally:
        tracker.config = before
    assert rules == [True, True, False, False] and not np.array_equal(*xyz)


def test_resized_depth_mixes_valid_pixels_only():
    depths = np.full((1, 8, 8), 2, np.float32)
    depths[0, 3, 3] = 0
    depths[0, :, 6:] = 0
    eye = np.eye(4, dtype=np.float32)[None]
    clip = Clip(np.zeros((1, 8, 8, 3), np.uint8), depths, eye[:, :3, :3], eye)
    small = resize_clip(clip, (4, 4)).depths[0]
    np.testing.assert_allclose(small[:, :3], 2, atol=1e-5)
    assert not small[:, 3].any()


@pytest.mark.parametrize("size", [(12, 12), (7, 9), (40, 33)], ids=str)
def test_resized_depth_holds_no_mean_of_front_and_back(size):
    depths = np.full((1, 16, 16), 4, np.float32)
    depths[0, 5:, 3:9] = 2
    depths[0, :3] = 0
    eye = np.eye(4, dtype=np.float32)[None]
    resized = resize_clip(Clip(np.zeros((1, 16, 16, 3), np.uint8), depths, eye[:, :3, :3], eye), size).depths
    share = np.abs(resized[..., None] / (2, 4) - 1).min(-1)  # from the nearer of the two depths
    assert share[resized > 0].max() <= 0.02 and (resized == 0).any()
    slope = np.linspace(2, 2.3, 16, dtype=np.float32)[None, None].repeat(16, 1)
    smooth = resize_clip(Clip(np.zeros((1, 16, 16, 3), np.uint8), slope, eye[:, :3, :3], eye), size).depths[0, 0]
    u = (np.arange(size[1]) + 0.5) * 16 / size[1] - 0.5
    np.testing.assert_allclose(smooth, 2 + 0.02 * np.clip(u, 0, 15), atol=1e-5)  # where it can, it interpolates


def test_the_config_names_the_support_grid_where_the_caller_does_not(golden, clip):
    tracker = golden.tracker
    queries, options = pixel_queries(clip)[:2], {"iterations": 1, "bidirectional": False}
    before = tracker.config
    try:
        tracker.config = before.replace(support_grid=2)
        named, unnamed = (tracker.track(clip, queries, **options, **x).xyz for x in ({"support_grid": 2}, {}))
        alone = tracker.track(clip, queries, **options, support_grid=0).xyz
    finally:
        tracker.config = before
    assert np.array_equal(named, unnamed) and not np.array_equal(alone, named)
    assert TrackerConfig().support_grid == 16
    with pytest.raises(ValueError, match="support_grid"):
        before.replace(support_grid=-1)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"space": "uvd"}, "only camera, world and first"),
        ({"visible_threshold": 3}, "probability"),
        ({"support_grid": -1}, "support_grid"),
        ({"depth_roi": "near"}, "depth_roi"),
        ({"queries": np.zeros((1, 3))}, "queries"),
    ],
)
def test_bad_options_of_track(golden, clip, options, message):
    with pytest.raises(ValueError, match=message):
        golden.tracker.track(clip, **options)
