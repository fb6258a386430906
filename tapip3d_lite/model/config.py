"""`TrackerConfig`: every system that the paper compares is one value of this dataclass.

Paper: section 3.2 (the method) and the ablations, one field each. The defaults are the released model.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

from tapip3d_lite.parts import allowed_parts, find_part, part_name
from tapip3d_lite.validate import check_range, check_types

CHOICES = {
    "space": ("uv", "uvd", "uvlogd", "camera", "world", "first"),
    "neighborhood": ("knn", "window", "planes"),
    "context": ("n2n", "p2n", "correlation", "planes"),
    "updater": ("transformer", "temporal"),
    "norm_mode": ("isotropic", "anisotropy", "none"),
}
SWITCHES = ("space", "neighborhood", "context", "updater")
INTERCHANGEABLE = ("camera", "world", "first")  # spaces that one checkpoint serves
_MAY_BE_ZERO = ("support_grid", "visible_threshold")
_LAYERS = ("levels", "offset_layers", "time_depth", "space_depth")
_MOST, _MOST_LAYERS = 2**13, 64  # a file from outside may ask for anything

Part = str | Callable[..., Any]


@dataclass(frozen=True)
class TrackerConfig:
    """Sizes and switches of a tracker; frozen, so a checkpoint's config cannot drift from its weights.

    Each of the first four is a built-in name, a class (which alone can be saved and loaded again), a module or function,
    or `"module:Class"`, which is imported and stands for the class. `lab.check_part` tells whether a part of yours
    keeps to its contract.

    Attributes:
        space: where a trajectory lives; see `spaces.Space`.
        neighborhood: which cells a point looks at; see `neighbors.KNearest`.
        context: what it makes of them; see `n2n.Context`.
        updater: how trajectories are corrected; see `updater.Transformer`.
        image_size: (H, W) pixels that the tracker works at.
        as_released: resized clips get intrinsics up to |1 - W'/W| / 2 px beside the image, and logits alone make points
            visible, as in the released code.
        window: S frames that are solved together, even; the next window starts S / 2 later.
        feature_dim: C, channels of the feature map.
        stride: pixels per feature cell.
        center_rgb: map colours to [-1, 1] before the encoder's own centring (a quirk of some released weights).
        levels: L, resolutions of the feature cloud.
        norm_mode: one standard deviation for all axes, one an axis, or no normalisation.
        norm_scale: standard deviation of the normalised cloud.
        exclude_invalid: keep cells without depth out of the neighbourhoods; the released model leaves them in. They
            lie at the camera's centre, so it matters only where depth is so sparse that K valid cells are not at hand;
            there it is the better choice (measured in tests/test_switches.py).
        neighbors: K, cells in a neighbourhood, beside the query itself on the support side.
        token_dim: D, width of the neighbourhood tokens.
        context_heads, context_head_dim, context_mlp_ratio: attention inside the context.
        offset_layers, offset_dim: the MLP on Fourier-embedded offsets.
        share_levels: one context for all levels instead of one each.
        use_features: append the query's own feature to the context.
        depth_ratio: let the correlation context see how depths around the estimate compare with its own.
        use_uv: append pixel coordinates to the trajectory token.
        hidden, heads, head_dim, mlp_ratio: the updating transformer.
        time_depth, space_depth: its blocks over time, and of those the ones followed by blocks over tracks.
        virtual_tracks: V, learned tracks through which all tracks talk to each other.
        separate_vis_head: an own linear layer for visibility and (unused) confidence.
        outputs: 4 = (dx, dy, dz, dvis), or 5 with the unused confidence.
        iterations: M, updates of a window when the caller names no number.
        support_grid: side of the grid of extra queries that `track` adds when the caller names none; 0: none.
        visible_threshold: probability from which a point counts as visible when the caller names none.

    Raises:
        ValueError: a value or combination that cannot work, and why.
    """

    space: Part = "world"
    neighborhood: Part = "knn"
    context: Part = "n2n"
    updater: Part = "transformer"
    image_size: tuple[int, int] = (384, 512)
    as_released: bool = False
    window: int = 16
    feature_dim: int = 128
    stride: int = 4
    center_rgb: bool = False
    levels: int = 4
    norm_mode: str = "isotropic"
    norm_scale: float = 1.0
    exclude_invalid: bool = False
    neighbors: int = 32
    token_dim: int = 128
    context_heads: int = 1
    context_head_dim: int = 128
    context_mlp_ratio: float = 1.0
    offset_layers: int = 3
    offset_dim: int = 128
    share_levels: bool = False
    use_features: bool = False
    depth_ratio: bool = False
    use_uv: bool = True
    hidden: int = 384
    heads: int = 8
    head_dim: int = 48
    mlp_ratio: float = 4.0
    time_depth: int = 3
    space_depth: int = 3
    virtual_tracks: int = 64
    separate_vis_head: bool = True
    outputs: int = 5
    iterations: int = 6
    support_grid: int = 16
    visible_threshold: float = 0.9

    def __post_init__(self) -> None:
        check_types(self)
        object.__setattr__(self, "image_size", tuple(map(int, self.image_size)))
        for name, allowed in CHOICES.items():
            value = getattr(self, name)
            if name in SWITCHES:
                object.__setattr__(self, name, find_part(f"TrackerConfig.{name}", value, allowed))
            elif value not in allowed:
                raise ValueError(f"TrackerConfig.{name}: expected one of {', '.join(allowed)}; got {value!r}")
        for field in fields(self):
            value = getattr(self, field.name)
            most = _MOST_LAYERS if field.name in _LAYERS else _MOST
            if field.type in ("int", "float") and not 0 < value <= most and field.name not in _MAY_BE_ZERO:
                raise ValueError(f"TrackerConfig.{field.name}: expected a positive number up to {most}, got {value}")
        self._check_sizes()
        self._check_combination()

    @classmethod
    def preset(cls, name: str, **changes: Any) -> TrackerConfig:
        """The `"paper"` configuration (about 26 M parameters), or `"lite"` for two CPU cores (under 3 M).

        Args:
            name: `"lite"` or `"paper"`.
            changes: fields to set differently.

        Raises:
            ValueError: an unknown preset or field.
        """
        if name not in _PRESETS:
            raise ValueError(f"TrackerConfig.preset: expected one of {', '.join(_PRESETS)}, got {name!r}")
        if unknown := sorted(changes.keys() - cls.__dataclass_fields__):
            raise ValueError(f"TrackerConfig.preset: no field {', '.join(unknown)}; see TrackerConfig's attributes")
        return cls(**(_PRESETS[name] | changes))

    @property
    def grid_sizes(self) -> list[tuple[int, int]]:
        """(h, w) of each level of the feature cloud, finest first."""
        height, width = self.image_size[0] // self.stride, self.image_size[1] // self.stride
        return [(height >> level, width >> level) for level in range(self.levels)]

    @property
    def custom(self) -> list[Any]:
        """The parts that are not built in."""
        return [part for name in SWITCHES if not isinstance(part := getattr(self, name), str)]

    def to_dict(self) -> dict[str, Any]:
        """Plain values for a weights file, classes as `"module:Class"`; ValueError where a part has no name."""
        parts = {name: part_name(getattr(self, name), f"TrackerConfig.{name}") for name in SWITCHES}
        return asdict(self) | parts | {"image_size": list(self.image_size)}

    @classmethod
    def from_dict(cls, values: dict[str, Any], parts: Sequence[Any] = ()) -> TrackerConfig:
        """The inverse of `to_dict`; ValueError names unknown fields, and classes not among `parts` (see `load_tracker`)."""
        if unknown := sorted(values.keys() - cls.__dataclass_fields__):
            raise ValueError(f"TrackerConfig: unknown fields {', '.join(unknown)}; the file is from another version")
        return cls(**(values | allowed_parts(values, SWITCHES, parts)))

    def replace(self, **changes: Any) -> TrackerConfig:
        """A copy with some fields changed, checked again."""
        return replace(self, **changes)

    def _check_sizes(self) -> None:
        if self.window % 2:
            raise ValueError(f"TrackerConfig.window: expected an even number of frames, got {self.window}")
        height, width = self.grid_sizes[-1]
        if self.neighborhood == "knn" and height * width < self.neighbors:
            raise ValueError(
                f"TrackerConfig.neighbors: the coarsest of {self.levels} levels has {height}x{width} cells for images of "
                f"{self.image_size}, fewer than K = {self.neighbors}; use fewer neighbors or levels, or larger images"
            )
        if self.feature_dim % 4:
            raise ValueError(f"TrackerConfig.feature_dim: expected a multiple of 4, got {self.feature_dim}")
        if self.time_depth % self.space_depth:
            raise ValueError(
                f"TrackerConfig.space_depth: expected a number that can divide time_depth = {self.time_depth}, got {self.space_depth}"
            )
        check_range(self, 0, 2**10, "support_grid")
        check_range(self, 1, _MOST, "image_size")
        if self.window * self.levels * self.token_dim > 2**22:
            raise ValueError(f"TrackerConfig: window x levels x token_dim must be at most {2**22}; lower one of them")
        if not 0 <= self.visible_threshold <= 1:
            raise ValueError(f"TrackerConfig.visible_threshold: expected a probability, got {self.visible_threshold}")
        if self.outputs not in (4, 5) or (self.separate_vis_head and self.outputs != 5):
            raise ValueError(f"TrackerConfig.outputs: expected 4, or 5 with a confidence, got {self.outputs}")

    def _check_combination(self) -> None:
        own = not (isinstance(self.neighborhood, str) and isinstance(self.context, str))  # may fit anything
        if (self.neighborhood == "planes") != (self.context == "planes") and not own:
            raise ValueError(
                f"TrackerConfig: neighborhood {self.neighborhood!r} with context {self.context!r}: planes are read only by "
                "the context 'planes', and it reads nothing else; set both or none"
            )
        if self.space == "uv" and self.neighborhood == "planes":
            raise ValueError("TrackerConfig: three planes need three axes, but space 'uv' has two; use 'uvd'")
        if self.context == "correlation" and self.neighborhood == "knn":
            raise ValueError(
                "TrackerConfig: context 'correlation' compares cells place by place, and nearest neighbours have no places; "
                "set neighborhood='window'"
            )
        if self.depth_ratio and (self.context in ("n2n", "p2n", "planes") or self.space in ("uv", "world")):
            raise ValueError(
                "TrackerConfig.depth_ratio: only the context 'correlation' reads it, and only where the third axis is depth, "
                "that is in the spaces 'uvd', 'uvlogd' and 'camera'"
            )
        if self.use_features and self.context in ("p2n", "correlation", "planes"):
            raise ValueError(
                f"TrackerConfig.use_features: only the context 'n2n' appends the query's feature, not {self.context!r}"
            )


_PRESETS: dict[str, dict[str, Any]] = {
    "paper": {},
    "lite": {
        "image_size": (128, 128),
        "window": 8,
        "feature_dim": 64,
        "stride": 2,  # images are small: features of 4 pixels place a point no better than to 1.3 of them
        "levels": 4,
        "neighbors": 9,
        "token_dim": 64,
        "context_head_dim": 64,
        "offset_layers": 2,
        "offset_dim": 64,
        "exclude_invalid": True,
        "hidden": 128,
        "heads": 4,
        "head_dim": 32,
        "mlp_ratio": 2.0,
        "time_depth": 3,
        "space_depth": 3,
        "virtual_tracks": 16,
        "iterations": 3,
        "support_grid": 0,  # held-out clips score no better with one, and take 2.5 times as long
    },
}
