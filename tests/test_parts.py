"""Parts of a user's own: named, saved, loaded where that is allowed, trained and used like those built in."""

import json
import logging
import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

import tapip3d_lite as t3d
from tapip3d_lite import lab, parts
from tapip3d_lite.evaluation.benchmark import version_of
from tapip3d_lite.lab.train import train
from tapip3d_lite.model import registry
from tapip3d_lite.model.blocks import DEGREES
from tapip3d_lite.model.n2n import N2N, Context
from tapip3d_lite.model.neighbors import KNearest
from tapip3d_lite.model.spaces import World
from tapip3d_lite.trackers import tracker_runs
from tapip3d_lite.training.loss import LossConfig, step_loss
from tapip3d_lite.training.recipe import TrainConfig
from tapip3d_lite.training.trainer import Trainer
from tests.tiny import ROOT, SIZES, command, recipe, untrained

CODE = '''
from pathlib import Path
from os import system
import torch
from torch import nn
from tapip3d_lite.model.n2n import Context
from tapip3d_lite.training.loss import LossConfig, step_loss

(Path(__file__).parent / "imported").touch()

class MyContext(Context):
    """The query's feature times the mean of its surroundings'."""

    def __init__(self, config):
        super().__init__()
        self.width = config.token_dim
        self.layer = nn.Linear(config.feature_dim, config.token_dim)

    def describe(self, index, support):
        return support.features[..., 0, :]

    def forward(self, index, kept, near):
        return self.layer(kept[:, None] * near.features.mean(-2))

def my_loss(step, truth, iterations):
    position, visibility = step_loss(step, truth, iterations, LossConfig())
    return 2 * position, visibility
'''


class Mine(Context):
    """As `MyContext` of the code above."""

    def __init__(self, config):
        super().__init__()
        self.width = config.token_dim
        self.layer = nn.Linear(config.feature_dim, config.token_dim)

    def describe(self, index, support):
        return support.features[..., 0, :]

    def forward(self, index, kept, near):
        return self.layer(kept[:, None] * near.features.mean(-2))


class Shift(World):
    """The world, moved."""

    name = "shift"

    def lift(self, depths, intrinsics, extrinsics):
        return super().lift(depths, intrinsics, extrinsics) + 1

    def from_world(self, xyz, intrinsics, extrinsics):
        return xyz + 1

    def to_world(self, coords, intrinsics, extrinsics, depths):
        return coords - 1

    def to_pixels(self, coords, intrinsics, extrinsics):
        return super().to_pixels(coords - 1, intrinsics, extrinsics)


class Each(nn.Module):
    """An updater without a constructor's worth of sizes."""

    def __init__(self, config, inputs):
        super().__init__()
        self.layer = nn.Linear(inputs, 4)

    def forward(self, tokens, active=None):
        return 1e-3 * self.layer(tokens)


class Near(KNearest):
    """Nearest neighbours by another name."""


class Loss:
    """The built-in loss, three times."""

    def __call__(self, step, truth, iterations):
        return tuple(3 * part for part in step_loss(step, truth, iterations, LossConfig()))


OWN = {"space": Shift, "neighborhood": Near, "context": Mine, "updater": Each}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A working directory with `my_parts.py`, not imported yet."""
    (tmp_path / "my_parts.py").write_text(CODE)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.chdir(tmp_path)
    yield tmp_path
    sys.modules.pop("my_parts", None)


@pytest.fixture(scope="module")
def clip():
    return t3d.simulate_clip(seed=1, frames=8, size=(32, 32), tracks=5)


def test_a_name_and_its_class_are_one(folder):
    config = t3d.TrackerConfig(**SIZES, context="my_parts:MyContext")
    import my_parts

    assert config.context is my_parts.MyContext and config == t3d.TrackerConfig(**SIZES, context=my_parts.MyContext)
    assert config.to_dict()["context"] == "my_parts:MyContext" and config.custom == [my_parts.MyContext]
    assert (
        recipe(tracker=SIZES | {"context": my_parts.MyContext}).to_dict()["tracker"]["context"] == "my_parts:MyContext"
    )
    assert recipe(loss="my_parts:my_loss").to_dict()["loss"] == "my_parts:my_loss"
    assert recipe(loss="paper").loss == LossConfig(form="paper")


@pytest.mark.parametrize("switch", OWN)
def test_saved_and_loaded_only_where_allowed(switch, tmp_path, clip):
    tracker, path = untrained(**{switch: OWN[switch]}), tmp_path / "w.safetensors"
    t3d.save_weights(tracker, path)
    name = f"tests.test_parts:{OWN[switch].__name__}"
    with pytest.raises(
        ValueError,
        match=rf"{switch}: '{name}' is a custom part.*parts=\[{OWN[switch].__name__}\].*--allow tests.test_parts",
    ):
        t3d.load_tracker(path)
    expected = tracker.track(clip)
    for allowed in ([OWN[switch]], OWN[switch], ["tests.test_parts"], "tests", [name], list(OWN.values())):
        again = t3d.load_tracker(path, parts=allowed)
        assert again.config == tracker.config
        np.testing.assert_array_equal(again.track(clip).xyz, expected.xyz)
    for other in ([], ["test_parts"], ["tests.test_part"], [N2N], "os"):
        with pytest.raises(ValueError, match="is a custom part, and a file alone imports no code"):
            t3d.load_tracker(path, parts=other)


def test_a_file_alone_imports_nothing(folder):
    tracker = untrained(context="my_parts:MyContext")
    t3d.save_weights(tracker, "w.safetensors")
    config = recipe(tracker=SIZES | {"context": "my_parts:MyContext"}, loss="my_parts:my_loss").to_dict()
    sys.modules.pop("my_parts")
    (folder / "imported").unlink()
    for read in (lambda p: t3d.load_tracker("w.safetensors", parts=p), lambda p: TrainConfig.from_dict(config, p)):
        with pytest.raises(ValueError, match="custom part"):
            read([])
    TrainConfig.complete(config)
    assert not (folder / "imported").exists() and "my_parts" not in sys.modules
    assert type(t3d.load_tracker("w.safetensors", parts=["my_parts"]).context).__name__ == "MyContext"
    assert TrainConfig.from_dict(config, ["my_parts"]).loss.__name__ == "my_loss"


@pytest.mark.parametrize(
    "name", ["my_parts:system", "my_parts:torch.load", "my_parts:Path", "my_parts:Context", "os:system"]
)
def test_an_allowed_module_does_not_allow_what_it_imports(folder, name):
    values = t3d.TrackerConfig(**SIZES).to_dict() | {"context": name}
    with pytest.raises(ValueError, match="imports no code"):
        t3d.TrackerConfig.from_dict(values, ["my_parts"])


def test_parts_of_a_notebook_are_given_back_or_found_in_their_new_module(folder, tmp_path):
    tracker = untrained(context=Mine)
    values = tracker.config.to_dict() | {"context": "__main__:MyContext"}
    with pytest.raises(
        ValueError, match=r"parts=\[MyContext\], or on the command line by --allow the module that holds"
    ):
        t3d.TrackerConfig.from_dict(values)
    given = type("MyContext", (Mine,), {})
    assert t3d.TrackerConfig.from_dict(values, [given]).context is given
    assert t3d.TrackerConfig.from_dict(values, ["my_parts"]).context.__module__ == "my_parts"

    class Local(Mine):
        pass

    values = t3d.TrackerConfig(**SIZES, context=Local).to_dict()
    assert (
        values["context"].endswith("<locals>.Local") and t3d.TrackerConfig.from_dict(values, [Local]).context is Local
    )
    run = "import tapip3d_lite as t3d\nclass M(t3d.model.n2n.Context): pass\nprint(t3d.TrackerConfig(context=M).to_dict()['context'])"
    run = run.replace("import tapip3d_lite as t3d\n", "import tapip3d_lite as t3d, tapip3d_lite.model.n2n\n")
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    assert subprocess.check_output([sys.executable, "-c", run], text=True, env=environment).strip() == "__main__:M"


def test_what_no_class_stands_for_is_not_saved(tmp_path, clips):
    config = t3d.TrackerConfig.preset("lite", **SIZES)
    for part in (Mine(config), lambda index, kept, near: None):
        with pytest.raises(ValueError, match=r"TrackerConfig.context is a custom part and has no name"):
            config.replace(context=part).to_dict()
    with pytest.raises(ValueError, match=r"TrainConfig.tracker\['context'\] is a custom part"):
        Trainer(tmp_path / "run", recipe(tracker=SIZES | {"context": Mine(config)}), clips)
    with pytest.raises(ValueError, match=r"TrainConfig.loss is a custom part"):
        recipe(loss=Loss()).to_dict()
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("part", "message"),
    [
        (
            "moon",
            "context: expected one of n2n, p2n, correlation, planes, \"module:Class\" or a custom part; got 'moon'",
        ),
        ("no_such_module:A", "'no_such_module:A': module 'no_such_module' cannot be imported (ModuleNotFoundError"),
        ("my_parts:Nothing", "'my_parts:Nothing': module 'my_parts' has no 'Nothing'"),
        ("my_parts:", "has no ''"),
        (":A", "cannot be imported"),
        ("broken:A", "'broken' cannot be imported (SyntaxError"),
        ("quits:A", "cannot be imported (SystemExit: 3)"),
        ("math:pi", "got 3.14"),
    ],
)
def test_names_that_name_nothing(folder, part, message):
    (folder / "broken.py").write_text("def f(:\n")
    (folder / "quits.py").write_text("raise SystemExit(3)")
    with pytest.raises(ValueError, match=re.escape(message)) as error:
        t3d.TrackerConfig(context=part)
    assert "\n" not in str(error.value)
    with pytest.raises(ValueError, match=r"TrainConfig.loss: expected one of paper, pixels, \"module:Class\""):
        recipe(loss="moon")


@pytest.mark.parametrize("switch", OWN)
def test_own_parts_track_stream_and_are_recorded(switch, clip, monkeypatch):
    # 2^13 x would magnify the last bit, in which the clear and the fast form differ.
    monkeypatch.setattr("tapip3d_lite.model.blocks._SCALES", tuple(2.0 ** min(degree, 2) for degree in DEGREES))
    tracker = untrained(**{switch: OWN[switch]})
    tracks = tracker.track(clip, support_grid=2)
    assert np.isfinite(tracks.xyz).all()
    with t3d.Recorder(tracker, columns=[0]) as record:
        tracker.track(clip)
    assert record.steps[0].xyz.shape == (4, 1, 3)
    assert (record.steps[0].levels[0].pool_context is None) == (switch == "context")
    stream = tracker.stream(clip.queries)
    for i in range(len(clip)):
        stream.push(clip.video[i], clip.depths[i], clip.intrinsics[i], clip.extrinsics[i])
    forward = tracker.track(clip, bidirectional=False, support_grid=0, depth_roi=None)
    np.testing.assert_allclose(stream.finish().xyz, forward.xyz, atol=1e-4)
    clear = t3d.Tracker(tracker.config, fast=False).eval()
    clear.load_state_dict(tracker.state_dict())
    np.testing.assert_allclose(clear.track(clip, support_grid=2).xyz, tracks.xyz, atol=1e-4)


def test_the_recorder_shows_no_attention_that_a_users_context_does_not_compute(clip):
    class Half(N2N):
        def forward(self, index, kept, near):
            return 0.5 * super().forward(index, kept, near)

    for context, shown in ((Half, False), (type("Same", (N2N,), {}), True)):
        tracker = untrained(context=context)
        with t3d.Recorder(tracker, columns=[0]) as record:
            tracker.track(clip)
        assert (record.steps[0].levels[0].pool_context is not None) == shown


def test_functions_as_parts(clip):
    def looks(index, kept, near):
        return near.features[..., 0, :4]

    with pytest.raises(ValueError, match="attribute width"):
        untrained(context=looks)
    looks.width = 4
    assert np.isfinite(untrained(context=looks).track(clip).xyz).all()

    class Bare(nn.Module):
        """Without a constructor."""

        def forward(self, tokens, active=None):
            return tokens[..., :4] * 0

    tracks = untrained(updater=Bare, space=Shift).track(clip)
    np.testing.assert_allclose(tracks.xyz, np.broadcast_to(clip.queries[:, 1:], tracks.xyz.shape), atol=1e-5)
    with pytest.raises(ValueError, match=r"updater: Mine\(config\) must be made by Mine\(config, inputs\)"):
        untrained(updater=Mine)


def test_own_parts_and_loss_are_trained_and_continued(tmp_path, clips, one_thread):
    config = recipe(tracker=SIZES | OWN, loss=Loss, matching_steps=1, steps=4)
    whole = Trainer(tmp_path / "whole", config, clips)
    assert whole.run(progress=False)
    half = Trainer(tmp_path / "half", config, clips)
    half.run(stop=lambda: half.step >= 3, progress=False)
    again = Trainer(tmp_path / "half", config, clips, resume=True)
    assert again.step == 3 and again.run(progress=False)
    for one, other in zip(whole.tracker.parameters(), again.tracker.parameters(), strict=True):
        assert torch.equal(one, other)
    assert again.tracker.context.layer.weight.grad.abs().sum() > 0
    stored = json.loads((tmp_path / "half" / "config.json").read_text())
    assert stored["tracker"]["updater"] == "tests.test_parts:Each" and stored["loss"] == "tests.test_parts:Loss"
    read = TrainConfig.from_dict(stored, [*OWN.values(), Loss])
    assert read.tracker_config() == config.tracker_config() and read.loss is Loss
    saved = t3d.load_tracker(tmp_path / "half" / "weights.safetensors", parts=list(OWN.values()))
    assert isinstance(saved.context, Mine)
    with pytest.raises(ValueError, match="begun with another recipe"):
        Trainer(tmp_path / "half", recipe(matching_steps=1, steps=4), clips, resume=True)
    started = Trainer(
        tmp_path / "from", replace(config, init=str(tmp_path / "half" / "weights.safetensors"), matching_steps=0), clips
    )
    weights = saved.context.layer.weight
    assert torch.equal(started.tracker.context.layer.weight, weights)  # init reads numbers, so it needs no permission


def test_the_loss_is_the_callers(tmp_path, clips, one_thread):
    lines = [
        next(Trainer(tmp_path / name, recipe(matching_steps=0, loss=loss), clips).steps())
        for name, loss in (("own", Loss), ("built in", LossConfig()))
    ]
    assert lines[0]["position"] == pytest.approx(3 * lines[1]["position"], rel=1e-4)
    assert lines[0]["visibility"] == pytest.approx(3 * lines[1]["visibility"], rel=1e-4)


def test_a_run_folder_is_trusted_no_more_than_weights(tmp_path, clips, monkeypatch):
    monkeypatch.setattr("tapip3d_lite.lab.train.training_clips", lambda *_, **__: clips)
    config = recipe(tracker=SIZES | {"context": Mine}, loss=Loss, matching_steps=0, steps=1, clips=3)
    Trainer(tmp_path, config, clips).run(progress=False)
    with pytest.raises(ValueError, match=r"tests.test_parts:.* is a custom part.*--allow tests.test_parts"):
        train(tmp_path, TrainConfig(), tmp_path, True, "cpu")
    for given in (TrainConfig(), ["tests.test_parts"]), (replace(config, steps=9), []):
        finished, text = train(tmp_path, given[0], tmp_path, True, "cpu", allow=given[1])
        assert finished and text.endswith("weights.safetensors")


def test_a_graph_holds_no_part_that_may_wait_for_the_gpu(monkeypatch, caplog):
    monkeypatch.setattr(registry, "import_part", lambda name, what="": name)
    assert registry.fast_step("cpu", [Mine]) is None and registry.fast_step("cuda") == registry.CUDA_STEP
    assert registry.fast_step("cuda", [Mine]) is None
    assert [r.getMessage() for r in caplog.records] == [
        "no CUDA graph, as Mine may wait for the GPU; it says otherwise by sync_free = True"
    ]
    monkeypatch.setattr(Mine, "sync_free", True, raising=False)
    assert registry.fast_step("cuda", [Mine]) == registry.CUDA_STEP and len(caplog.records) == 1


def test_the_fast_path_says_in_one_line_what_it_leaves(caplog):
    with caplog.at_level(logging.INFO, "tapip3d_lite"):
        tracker = untrained(context=Mine)
        assert [r.getMessage() for r in caplog.records] == ["context: Mine has no fast form and runs as it is written"]
        assert type(tracker.neighborhood).__name__ == "BoxKNearest"  # the other parts stay fast
        t3d.Tracker(tracker.config, fast=False)
    assert len(caplog.records) == 1


def test_benchmarks_know_own_parts(tmp_path):
    t3d.save_weights(untrained(context=Mine), tmp_path / "c.safetensors")
    t3d.save_weights(untrained(space=Shift), tmp_path / "s.safetensors")
    paths = [str(tmp_path / name) for name in ("c.safetensors", "s.safetensors")]
    runs = list(tracker_runs(paths, ["world", "camera"], parts=["tests.test_parts"]))
    assert [(label.rpartition(" · ")[2], options) for label, _, options in runs] == [
        ("world", {"space": "world"}), ("camera", {"space": "camera"}), ("shift", {})
    ]  # fmt: skip
    first, again = (version_of(t3d.load_tracker(paths[0], parts=[Mine]), {}) for _ in range(2))
    assert first == again == version_of(runs[0][1], {})


def test_other_code_of_a_part_is_scored_anew(folder):
    versions = []
    for code in (CODE, CODE.replace("mean(-2)", "amax(-2)")):
        sys.modules.pop("my_parts", None)
        (folder / "my_parts.py").write_text(code)
        os.utime(folder / "my_parts.py", (len(versions), len(versions)))
        __import__("linecache").clearcache()
        versions.append(version_of(untrained(context="my_parts:MyContext"), {}))
    assert versions[0] != versions[1]


def process(*arguments, cwd):
    environment = os.environ | {
        "PYTHONPATH": str(ROOT),
        "PYTHONWARNINGS": "error",
        "OMP_NUM_THREADS": "1",
        "COLUMNS": "200",
    }
    command = [sys.executable, "-m", "tapip3d_lite", *map(str, arguments)]
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, env=environment)


def test_from_file_to_result_by_command_line(folder, clips):
    words = [str(x) for item in SIZES.items() if item[0] != "image_size" for x in item]
    small = [
        "--clips",
        "1",
        "--matching-steps",
        "0",
        "--steps",
        "1",
        "--frames",
        "4",
        "4",
        "--validation",
        "0",
        "--sampling.tracks",
        "4",
    ]
    run = ["train", "--out", "run", "--data", "data"]
    own = ["--tracker", *words, "context", "my_parts:MyContext", "--loss", "my_parts:my_loss"]
    result = process(*run, *small, *own, cwd=folder)
    assert result.returncode == 0 and "finished" in result.stdout, result.stderr
    weights, clip = Path("run/weights.safetensors"), clips[0]
    assert "my_parts" not in sys.modules
    refused = [command("track", clip, "--tracker", weights, cwd=folder), command(*run, "--resume", cwd=folder)]
    for result in refused:
        assert result.returncode == 2 and len(result.stderr.splitlines()) == 1 and "--allow my_parts" in result.stderr
    assert "my_parts" not in sys.modules
    result = command("track", clip, "--tracker", weights, "--allow", "my_parts", cwd=folder)
    assert result.returncode == 0 and "points over 8 frames" in result.stdout, result.stderr
    result = command(*run, "--loss", "paper", "--loss.soften", 2, cwd=folder)
    assert result.returncode == 2 and "give it or them" in result.stderr
    result = command(*run[:2], "other", "--tracker", "context", "my_part:A", cwd=folder)
    assert result.returncode == 2 and "module 'my_part' cannot be imported" in result.stderr


def test_the_readmes_part_keeps_the_contract(folder):
    (code,) = (
        block
        for block in re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text("utf-8"), re.S)
        if "MyContext(Context)" in block
    )
    (folder / "my_parts.py").write_text(code)
    assert str(lab.check_part("my_parts:MyContext")) == "my_parts:MyContext (context): keeps the contract"


def test_part_names():
    assert parts.part_name("n2n") == "n2n" and parts.part_name(step_loss) == "tapip3d_lite.training.loss:step_loss"
    with pytest.raises(ValueError, match="parts: an instance is a custom part"):
        t3d.TrackerConfig.from_dict({"context": "a:B"}, [Loss()])
