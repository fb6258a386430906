"""The memory that a stream's frames leave behind: `python -m tests.stream_memory --frames 2000`."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch

import tapip3d_lite as t3d


def resident() -> float:
    """MiB of this process (Linux)."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096 / 2**20


def grown(frames: int, side: int, points: int, report: int = 0) -> dict[str, float]:
    """MiB a frame by which the process grew over the later two thirds of a stream of noise, by how it keeps its tracks."""
    rng, result = np.random.default_rng(0), {}
    config = t3d.TrackerConfig.preset("lite", image_size=(side, side), window=8, iterations=1, neighbors=4, levels=2)
    tracker = t3d.Tracker(config).eval()
    camera = np.array([[side, 0, side / 2], [0, side, side / 2], [0, 0, 1.0]]), np.eye(4)
    queries = np.column_stack([np.zeros(points), *rng.uniform(-0.4, 0.4, (2, points)), np.ones(points)])
    for keep in (False, True):
        stream, sizes = tracker.stream(queries, keep=keep), []
        for t in range(frames):
            image = rng.integers(0, 255, (side, side, 3), dtype=np.uint8)
            stream.push(image, rng.uniform(1, 3, (side, side)).astype(np.float32), *camera)
            if t % 16 == 15:  # queries come and go
                stream.drop(stream.followed[:2])
                stream.add(queries[:2] + [t, 0, 0, 0])
            sizes.append(resident())
            if report and t % report == report - 1:
                print(f"keep={keep}, {t + 1} frames: {sizes[-1]:.0f} MiB")
        stream.finish()
        result[f"keep={keep}"] = (sizes[-1] - sizes[frames // 3]) / (frames - frames // 3)
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=2000)
    parser.add_argument("--side", type=int, default=64, help="pixels")
    parser.add_argument("--points", type=int, default=64)
    options = parser.parse_args()
    torch.set_num_threads(1)
    for name, growth in grown(options.frames, options.side, options.points, max(1, options.frames // 8)).items():
        print(f"{name}: {growth * 1024:.1f} KiB a frame")


if __name__ == "__main__":
    main()
