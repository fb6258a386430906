"""The image encoder: CoTracker's residual CNN.

    F = head(relu(norm(fuse(concat of the four stages, resized to (H, W) / stride))))

Paper: section 3.2 (feature maps); the architecture is CoTracker's "BasicEncoder".
"""

from __future__ import annotations

from itertools import pairwise

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from tapip3d_lite.model.config import TrackerConfig

# Encoded at once without gradient, on a GPU 16 times as many: frames are independent, so this only bounds memory.
_PIXELS = 2**18


class ResidualBlock(nn.Module):
    """Two 3x3 convolutions with instance norm, and a skip that is projected where the size changes."""

    def __init__(self, inputs: int, outputs: int, stride: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(inputs, outputs, 3, stride, 1)
        self.conv2 = nn.Conv2d(outputs, outputs, 3, 1, 1)
        self.skip = nn.Identity() if stride == 1 else nn.Conv2d(inputs, outputs, 1, stride)

    def forward(self, x: Tensor) -> Tensor:
        """(F, inputs, h, w) to (F, outputs, h / stride, w / stride)."""
        y = F.relu(F.instance_norm(self.conv1(x)))
        y = F.relu(F.instance_norm(self.conv2(y)))
        skip = x if isinstance(self.skip, nn.Identity) else F.instance_norm(self.skip(x))
        return F.relu(skip + y)


class Encoder(nn.Module):
    """Images to feature maps: four residual stages, resized to one size, concatenated and fused."""

    def __init__(self, config: TrackerConfig) -> None:
        super().__init__()
        width, self.stride, self.center_rgb = config.feature_dim, config.stride, config.center_rgb
        widths = [width // 2, width // 2, width * 3 // 4, width, width]
        self.stem = nn.Conv2d(3, widths[0], 7, 2, 3)
        self.stages = nn.ModuleList(
            nn.Sequential(ResidualBlock(a, b, 1 if i == 0 else 2), ResidualBlock(b, b, 1))
            for i, (a, b) in enumerate(pairwise(widths))
        )
        self.fuse = nn.Conv2d(sum(widths[1:]), width * 2, 3, 1, 1)
        self.head = nn.Conv2d(width * 2, width, 1)

    def forward(self, rgb: Tensor) -> Tensor:
        """Encode frames (B, T, 3, H, W), in [0, 1], one by one: (B, T, C, H // stride, W // stride) float32."""
        images = rgb.flatten(0, 1)  # (B T, 3, H, W)
        budget = _PIXELS * (16 if rgb.is_cuda else 1)
        step = len(images) if torch.is_grad_enabled() else max(1, budget // rgb[0, 0, 0].numel())
        maps = [self._encode(part).float() for part in images.split(step)]
        return (maps[0] if len(maps) == 1 else torch.cat(maps)).unflatten(0, rgb.shape[:2])  # (B, T, C, h, w)

    def _encode(self, images: Tensor) -> Tensor:
        size = images.shape[-2] // self.stride, images.shape[-1] // self.stride
        x = 2 * images - 1 if self.center_rgb else images
        x = F.relu(F.instance_norm(self.stem((x - 0.5) / 0.5)))
        maps = []
        for stage in self.stages:
            x = stage(x)
            maps.append(F.interpolate(x, size, mode="bilinear", align_corners=True))
        return self.head(F.relu(F.instance_norm(self.fuse(torch.cat(maps, 1)))))
