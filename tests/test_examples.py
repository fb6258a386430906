"""The input of a training is the same in one process, with workers, and shared between several ranks."""

import multiprocessing
import os
import signal
import subprocess
from dataclasses import fields, is_dataclass

import pytest
import torch

from tapip3d_lite.training.data import Batch
from tapip3d_lite.training.examples import Examples
from tapip3d_lite.training.pretrain import FramePair, MatchingConfig
from tapip3d_lite.training.run_folder import read_log
from tapip3d_lite.training.trainer import Trainer
from tests.tiny import RUN, checkpoint, recipe, start, wait_for

pytestmark = [
    pytest.mark.filterwarnings("ignore:This DataLoader will create 2 worker:UserWarning"),  # where there is one core
    pytest.mark.filterwarnings("ignore:.*multi-threaded, use of fork:DeprecationWarning"),  # from Python 3.12 on
]


def values(example):
    """All tensors and names in an example, in order."""
    if is_dataclass(example):
        example = [getattr(example, field.name) for field in fields(example)]
    return [x for part in example for x in values(part)] if isinstance(example, list | tuple) else [example]


def tensors(example):
    return [x for x in values(example) if isinstance(x, torch.Tensor)]


def same(one, other):
    one, other = values(one), values(other)
    return len(one) == len(other) and all(
        torch.equal(a, b) and a.dtype == b.dtype if isinstance(a, torch.Tensor) else a == b
        for a, b in zip(one, other, strict=True)
    )


def both_stages(clips, rank=0, share=2):
    config = recipe(train_encoder=True, matching_steps=3, steps=4, batch=share, matching=MatchingConfig(pairs=share))
    return Examples(config, clips, rank)


def places(first, last):
    """(step, position) of each step."""
    return [(step, step) for step in range(first, last)]


def test_other_processes_make_the_same_examples_in_the_same_order(clips):
    examples = both_stages(clips)
    alone = list(examples.stream(places(0, 7)))
    assert [type(x) for x in alone] == [list] * 3 + [Batch] * 4 and isinstance(alone[0][1], FramePair)
    assert not any(same(alone[i], alone[j]) for i in range(7) for j in range(i))
    for first in (0, 2, 5):
        last = 3 if first < 3 else 7
        made = list(examples.stream(places(first, last), workers=2))
        assert all(same(a, b) for a, b in zip(alone[first:last], made, strict=True))


def test_examples_are_short_at_first_then_of_all_lengths(clips):
    examples = Examples(recipe(matching_steps=10, steps=100, short=0.3, frames=(4, 8), iterations=(1, 3)), clips)
    assert {examples.lengths(step, step) for step in range(10, 40)} == {(4, 1)}
    assert {examples.lengths(step, step) for step in range(40, 110)} == {(t, m) for t in (4, 6, 8) for m in (1, 2, 3)}
    assert all(examples.lengths(step, 12.5) == (4, 1) for step in range(200, 210))  # by a clock
    batch = examples.batch(50, 50)
    assert (len(batch.frames), batch.iterations) == examples.lengths(50, 50)


@pytest.mark.parametrize("train_encoder", [True, False])
def test_workers_change_no_bit_of_a_training(tmp_path, clips, one_thread, train_encoder):
    for workers in (0, 2):
        trainer = Trainer(tmp_path / f"{workers}", recipe(train_encoder=train_encoder), clips, workers=workers)
        assert trainer.run(progress=False)
    alone, helped = checkpoint(tmp_path / "0"), checkpoint(tmp_path / "2")
    assert alone.keys() == helped.keys() and all(torch.equal(alone[name], helped[name]) for name in alone)


def test_a_negative_number_of_workers_is_refused(tmp_path, clips):
    with pytest.raises(ValueError, match="workers must not be negative, got -1"):
        Trainer(tmp_path, recipe(), clips, workers=-1)


def test_workers_leave_the_callers_random_generator_alone(tmp_path, clips):
    before = torch.get_rng_state()
    Trainer(tmp_path, recipe(train_encoder=True, matching_steps=0, steps=1), clips, workers=1).run(progress=False)
    assert torch.equal(torch.get_rng_state(), before)


def test_ranks_share_what_one_process_draws(clips):
    alone, first, second = both_stages(clips, share=4), both_stages(clips), both_stages(clips, rank=1)
    for step in (0, 1):
        pairs = first[step, step] + second[step, step]
        assert len(pairs) == 4 and same(alone[step, step], pairs)
        assert not any(same(pairs[i], pairs[j]) for i in range(4) for j in range(i))
    for step in (3, 6):
        whole, parts = alone[step, step], [first[step, step], second[step, step]]
        assert len(whole.names) == 4 and whole.names == parts[0].names + parts[1].names
        assert len(tensors(whole)) == 11
        assert same(tensors(whole), [torch.cat(x) for x in zip(*map(tensors, parts), strict=True)])


def test_colours_are_bytes_until_they_are_used(clips):
    batch = both_stages(clips)[3, 3]
    colours, ready = batch.frames.rgb, batch.to("cpu").frames.rgb
    assert colours.dtype == torch.uint8 and colours.shape[:3] == (2, 4, 3) and int(colours.max()) > 100
    assert ready.dtype == torch.float32 and torch.equal(ready, colours.float() / 255)
    assert float(ready.min()) >= 0 and 0.4 < float(ready.max()) <= 1


def test_workers_leave_interrupts_to_the_training(clips):
    examples, others = both_stages(clips), multiprocessing.active_children()
    stream = examples.stream(places(3, 7), workers=2)
    made = [next(stream), next(stream)]  # so both have begun
    workers = set(multiprocessing.active_children()) - set(others)
    assert len(workers) == 2
    for worker in workers:
        os.kill(worker.pid, signal.SIGINT)
    made += stream
    assert len(made) == 4 and all(same(a, b) for a, b in zip(examples.stream(places(3, 7)), made, strict=True))


def test_an_interrupt_from_the_terminal_saves_and_ends_all_processes(tmp_path, clips):
    run = RUN.replace("recipe()", "recipe(train_encoder=True, steps=1000)").replace("resume=True", "workers=2")
    with start(tmp_path / "run", clips, run, stderr=subprocess.PIPE, start_new_session=True) as process:
        wait_for(process, 8)
        os.killpg(process.pid, signal.SIGINT)
        errors = process.communicate(timeout=60)[1]
    assert process.returncode == 130 and "Traceback" not in errors, errors
    with pytest.raises(ProcessLookupError):
        os.killpg(process.pid, 0)
    saved = torch.load(tmp_path / "run" / "checkpoint.pt", weights_only=True)
    assert 8 <= saved["step"] == read_log(tmp_path / "run")[-1]["step"] < 1004
