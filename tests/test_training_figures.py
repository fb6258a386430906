"""Figures and live plot of notebook 06, by their state; the miniature chain."""

import asyncio
import json
import signal
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import tapip3d_lite as t3d
from lessons.n06 import LivePlot, learning_curve, tracks_and_truth, train_live
from lessons.n06_augmentations import SHOWN, TITLES, augmented, before_and_after, motion_paths
from lessons.n06_chain import Chain, plain, saving
from tapip3d_lite.figures.curves import learning_curves
from tapip3d_lite.lab import make_trainer
from tests import tiny


def recipe(**changes):
    """A training of 2 + 4 steps."""
    return tiny.recipe(
        **({"matching_steps": 2, "steps": 4, "frames": (4, 4), "evaluate_every": 2, "save_every": 100} | changes)
    )


@pytest.fixture
def lines():
    first = [{"step": i, "stage": "matching", "right": i / 4, "loss": 1.0, "seconds": i} for i in (1, 2)]
    values = [{"loss": 0.4, "apd": 0.2, "apd_dynamic": None}, {"loss": 0.2, "apd": 0.4, "apd_dynamic": 0.1}]
    then = [{"step": 3 + i, "stage": "tracking", "seconds": 60 * (i + 1), **v} for i, v in enumerate(values)]
    then[-1] |= {"val_APD3D_none": 0.5, "val_APD3D_none_dynamic": 0.3}
    return first + then


def watched(trainer, **options):
    return asyncio.run(train_live(trainer, **options))


def drawn(ax):
    return [tuple(np.round(x, 6).tolist() for x in line.get_data()) for line in ax.lines]


def test_curves_show_each_line_its_mean_and_what_was_held_out(lines):
    zero = {"APD3D_none": 0.45, "APD3D_none_dynamic": 0.15, "OA": 0.9}
    left, middle, right = learning_curves([("", lines)], zero, window=2).axes
    assert drawn(left) == [([1, 2], [0.25, 0.5]), ([1, 2], [0.25, 0.375])]
    assert drawn(middle) == [([3, 4], [0.4, 0.2]), ([3, 4], [0.4, 0.3])] and middle.get_yscale() == "log"
    assert drawn(right)[:3] == [([3, 4], [0.2, 0.4]), ([3, 4], [0.2, 0.3]), ([4], [0.5])]
    assert drawn(right)[4:7] == [([4], [0.1]), ([4], [0.1]), ([4], [0.3])]  # a step without moving points is left out
    assert [drawn(right)[i][1] for i in (3, 7)] == [[0.45] * 2, [0.15] * 2]
    assert [line.get_linestyle() for line in right.lines].count("--") == 2


def test_curves_over_minutes_of_a_window_and_of_nothing(lines):
    middle = learning_curves([("", lines)], by="minutes", window=1).axes[1]
    assert drawn(middle) == [([1, 2], [0.4, 0.2])] * 2
    assert not any(ax.lines for ax in learning_curve([]).axes if ax.get_ylabel() != "APD3D")
    for wrong in ({"by": "day"}, {"window": 0}):
        with pytest.raises(ValueError, match="learning_curves"):
            learning_curves([("", lines)], **wrong)


def test_trainings_have_a_row_each_and_the_command_draws_them(lines, tmp_path):
    figure = learning_curves([("first", lines), ("second", lines[:2])], window=2)
    rows = np.reshape(figure.axes, (2, 3))
    assert [row[0].get_ylabel().splitlines()[0] for row in rows] == ["first", "second"]
    assert drawn(rows[0, 1]) == drawn(learning_curves([("", lines)], window=2).axes[1]) and not rows[1, 1].lines
    both = np.reshape(learning_curves([("", lines), ("", lines[2:])]).axes, (2, 3))
    texts = [[text.get_text() for text in row[0].texts] for row in both]
    assert texts == [[], ["as it was"]]  # a training that takes its encoder as it finds it
    assert [ax.get_ylabel() for ax in learning_curve(lines[2:]).axes] == ["loss", "APD3D"]
    few = [{**lines[2], "step": step, "loss": loss} for step, loss in ((10, 0.4), (20, 0.2), (30, 0.6))]
    assert drawn(learning_curves([("", few)], window=20).axes[0])[1] == ([10, 20, 30], [0.4, 0.3, 0.4])
    (tmp_path / "log.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    curves = "curves", "--out", tmp_path / "c.png"
    assert tiny.command(*curves, tmp_path, tmp_path / "log.jsonl").returncode == 0
    assert (tmp_path / "c.png").read_bytes()[:4] == b"\x89PNG"
    absent = tiny.command(*curves, tmp_path / "none")
    assert absent.returncode == 2 and "no such log" in absent.stderr


def test_learnt_tracks_stand_beside_the_truth():
    clip = t3d.simulate_clip(seed=4, frames=6, size=(32, 32), tracks=30)
    pred = t3d.load_tracker("static").track(clip)
    figure = tracks_and_truth(clip, pred, [3, 5])
    assert [ax.get_title() for ax in figure.axes] == [f"{w} · frame {t}" for w in ("truth", "learnt") for t in (3, 5)]
    shown = int((clip.tracks.visible[5] & (clip.tracks.queries[:, 0] <= 5) & clip.tracks.dynamic).sum())
    truth, learnt = figure.axes[1], figure.axes[3]
    dots = [line for line in truth.lines if line.get_marker() == "o"]
    assert len(dots) == shown > 0
    assert len(learnt.lines) == len(truth.lines) + shown  # what it misses by
    for line in dots:
        uv = t3d.geometry.project(clip.tracks.xyz[5:], clip.intrinsics[5:], clip.extrinsics[5:])[0][0]
        assert np.abs(uv - np.array(line.get_data())[:, 0]).sum(-1).min() < 1e-4
    with pytest.raises(ValueError, match="same queries"):
        tracks_and_truth(clip, pred.select(np.arange(3)))


def test_the_live_plot_is_drawn_anew_and_can_be_stopped(lines):
    live = LivePlot(lines[:1])
    before = live.picture.value
    live.lines += lines[1:3]
    assert live.picture.value == before
    live.draw()
    assert live.picture.value != before and "tracking, step 3" in live.words.value
    assert not live.stopped
    live.button.click()
    assert live.stopped and live.button.disabled


@pytest.fixture
def trainer(tmp_path, clips):
    held_out = [t3d.load_clip(clips[0])]
    return make_trainer(tmp_path / "run", recipe(), clips, held_out)


def test_training_watched_goes_to_the_end(trainer):
    lines = watched(trainer, every=0.01)
    assert [line["step"] for line in lines] == [1, 2, 3, 4, 5, 6]
    assert sum("val_APD3D_none" in line for line in lines) == 2
    assert (trainer.folder.path / "weights.safetensors").exists()


def test_what_was_stopped_goes_on(trainer, monkeypatch):
    monkeypatch.setattr(LivePlot, "stopped", property(lambda live: len(live.lines) >= 3))
    assert len(watched(trainer)) == 3
    assert (trainer.folder.path / "checkpoint.pt").exists()
    assert len(watched(trainer)) == 4  # the button again, after one more step
    monkeypatch.undo()
    assert [line["step"] for line in watched(trainer)] == [1, 2, 3, 4, 5, 6]


def test_interrupting_the_kernel_stops_between_two_steps(trainer, monkeypatch):
    step = trainer._one_step

    def interrupted():
        if trainer.step == 2:
            signal.raise_signal(signal.SIGINT)
        return step()

    before = signal.getsignal(signal.SIGINT)
    monkeypatch.setattr(trainer, "_one_step", interrupted)
    lines = watched(trainer)
    assert len(lines) == trainer.step == 3 and signal.getsignal(signal.SIGINT) == before
    assert len((trainer.folder.path / "log.jsonl").read_text().splitlines()) == 3
    assert (trainer.folder.path / "checkpoint.pt").exists()


def test_drawing_takes_a_small_share_of_the_time(trainer, monkeypatch):
    clock, drawings, draw = [0.0], [], LivePlot.draw

    def slow(live):
        drawings.append(clock[0])
        clock[0] += 10.0
        draw(live)

    monkeypatch.setattr("lessons.n06.time", SimpleNamespace(monotonic=lambda: clock[0]))
    monkeypatch.setattr(LivePlot, "draw", slow)
    step = trainer._one_step
    monkeypatch.setattr(trainer, "_one_step", lambda: (clock.__setitem__(0, clock[0] + 100.0), step())[1])
    watched(trainer)
    assert drawings == [0, 110, 420, 630]  # first, after a step, when ten seconds are a twentieth, and last


def test_the_button_is_heard_between_two_steps(trainer, monkeypatch):
    async def cell():
        training = asyncio.create_task(train_live(trainer))
        while trainer.step < 2:
            await asyncio.sleep(0)
        shown[0].press()
        return await training

    shown, show = [], LivePlot.__init__
    monkeypatch.setattr(LivePlot, "__init__", lambda live, *args: (shown.append(live), show(live, *args))[1])
    assert len(asyncio.run(cell())) <= 4


def test_what_goes_wrong_while_watched_is_raised(trainer, monkeypatch):
    def fail(*_):
        raise FloatingPointError("not finite")

    monkeypatch.setattr(trainer, "_one_step", fail)
    with pytest.raises(FloatingPointError, match="not finite"):
        watched(trainer)


def test_the_chain_watches_what_autograd_holds():
    chains = [Chain(np.random.default_rng(0), 5) for _ in range(3)]
    one, two, three = saving(chains[0]), plain(chains[1]), saving(chains[2], leaf=False, keep=True)
    for other in (two, three):
        for a, b in zip(one[:2], other[:2], strict=True):
            torch.testing.assert_close(a, b, rtol=1e-12, atol=1e-12)
    assert [result[2] for result in (one, two, three)] == [1, 5, 1]
    assert [chain.passes for chain in chains] == [2, 2, 6]


def test_augmentations_are_shown_in_pairs():
    clip = t3d.simulate_clip(seed=4, frames=6, size=(32, 32), tracks=30)
    figure = before_and_after(clip, frame=2)
    titles = [ax.get_title() for ax in figure.axes]
    assert titles == [f"{TITLES[name]}: {w}" for name in SHOWN for w in ("before", "after")]
    shown = dict(zip(titles, figure.axes, strict=True))
    for name in ("colour jitter", "mirrored in x", "backward in time"):
        before, after = (np.asarray(shown[f"{name}: {w}"].images[0].get_array()) for w in ("before", "after"))
        same = {"mirrored in x": before[:, ::-1], "backward in time": before}.get(name)
        assert (same is None and not np.array_equal(before, after)) or np.array_equal(same, after)
    with pytest.raises(ValueError, match="frame"):
        before_and_after(clip, frame=6)


@pytest.mark.parametrize("title", TITLES.values())
def test_each_augmentation_can_be_explored(title):
    clip = t3d.simulate_clip(seed=4, frames=6, size=(32, 32), tracks=30)
    axes = augmented(clip, title, seed=1, frame=3).axes
    assert [ax.get_title() for ax in axes] == [f"{title}: {w}" for _ in range(2) for w in ("before", "after")]
    assert np.asarray(axes[0].images[0].get_array()).ndim == 3  # colour above, depth below
    assert np.asarray(axes[2].images[0].get_array()).ndim == 2
    with pytest.raises(ValueError, match="eraser"):
        augmented(clip, "nothing", seed=1, frame=3)


def test_paths_are_drawn_in_three_coordinates_of_one_scale():
    clip = t3d.simulate_clip(seed=4, frames=6, size=(32, 32), tracks=60, camera="handheld")
    world, camera, moved, turn = motion_paths(clip, still=3, moving=2).axes
    assert [len(ax.lines) for ax in (world, camera, moved)] == [10, 10, 10]
    still = world.lines[0].get_xydata()
    assert np.ptp(still, 0).max() < 1e-5 < np.ptp(camera.lines[0].get_xydata(), 0).max()
    assert len(turn.lines) == 2 and len(turn.lines[0].get_xdata()) == 5
    sides = [np.ptp(limits) for ax in (world, camera, moved) for limits in (ax.get_xlim(), ax.get_ylim())]
    np.testing.assert_allclose(sides, sides[0])
    for ax in (world, camera, moved):
        for line in ax.lines:
            assert (np.abs(line.get_xydata() - [np.mean(ax.get_xlim()), np.mean(ax.get_ylim())]) <= sides[0] / 2).all()
    assert [text.get_text() for text in world.get_legend().get_texts()][:2] == [
        "point at rest in the world",
        "moving point",
    ]
