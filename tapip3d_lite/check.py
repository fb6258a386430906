"""`check_clip`: find the usual mistakes in RGB-D clips from the data alone, with the evidence as a number.

`measures` says how well the parts of a clip fit together. Where they do not, each mistake of the catalogue
(`mistakes.py`) is undone, and the one that makes them fit is named; two where a clip's poses and units are both wrong.

A camera that never moves provides no evidence about poses, and about units only that sensors store millimetres as
whole numbers. Colour order (BGR for RGB) cannot be determined from the data and is not checked.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np

from tapip3d_lite.clip import Clip
from tapip3d_lite.geometry import invert
from tapip3d_lite.measures import USUAL_COLOUR, USUAL_DEPTH, Agreement, agreement, curvature, edges, reduced
from tapip3d_lite.mistakes import CATALOGUE, Case, Fix, depths, ray_to_z, rescaled, swapped_axes
from tapip3d_lite.queries import near_origin

_GAIN = 0.4  # a fix must leave at most this share of the error, once for each change that it makes
_NOISE = 0.001  # exact clips stay well below; a mistake that changes less than this does no harm either
_STILL = 0.06  # of a camera at rest colours hardly change
_FAR = 100.0  # cameras further from the origin than this, in median depths, cost float32's last digits


@dataclass(frozen=True)
class Finding:
    """One suspected mistake.

    Attributes:
        name: short key, e.g. `"camera_to_world"`; `"unknown"` where the clip does not fit together and nothing repairs it.
        message: what seems wrong.
        remedy: what to do, in words.
        fix: maps the clip to the corrected clip.
        measure: what the two numbers measure.
        before: the measure of the clip as given.
        after: the measure once the fix is applied.
        usual: what good clips stay below, where that is known.
    """

    name: str
    message: str
    remedy: str
    fix: Callable[[Clip], Clip]
    measure: str
    before: float
    after: float
    usual: float | None = None

    def __str__(self) -> str:
        usual = "" if self.usual is None else f" where less than {self.usual:.2g} is usual"
        after = "" if self.name == "unknown" else f", {self.after:.3g} after the fix"
        return f"{self.name}: {self.message} ({self.measure}: {self.before:.3g}{usual}{after}). {self.remedy}"


def check_clip(clip: Clip) -> list[Finding]:
    """Findings for a clip, whose true tracks are not used, most basic first; none where nothing is suspicious.

    There is one for each mistake in the simplest set of fixes that makes the clip consistent. Applying them in their
    order repairs the clip. Takes a fraction of a second for a good clip, some seconds for another one.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of what candidates do to depths
        findings, repaired = [], clip
        if not clip.depths.any():
            return findings
        for test in (_far_world, _stand_in, _normalised, _bulging):
            for finding in test(repaired):
                findings.append(finding)
                repaired = finding.fix(repaired)
        return findings + (_misfit if _moves(clip) else _at_rest)(reduced(repaired))


def _moves(clip: Clip) -> bool:
    return bool(np.ptp(clip.extrinsics, axis=0).max() > 1e-6)


def _far_world(clip: Clip) -> Iterator[Finding]:
    places = invert(clip.extrinsics.astype(np.float64))[:, :3, 3]
    travel = float(np.ptp(places, 0).max())
    away = float(np.linalg.norm(places, axis=-1).min()), max(travel, float(np.median(clip.depths[clip.depths > 0])))
    if away[0] > _FAR * away[1] and clip.extrinsics.dtype == np.float32:  # in 64 bits nothing is lost
        message = f"the world's origin is {away[0]:.3g} from the cameras: numbers of 32 bits are rounded to {away[0] * 6e-8:.1g} there"
        remedy = "Subtract one camera's place from all poses and points, in 64 bits, before anything else."
        fix, far = lambda clip: near_origin(clip)[0], away[0] / away[1]
        yield Finding("far_world", message, remedy, fix, "distance in depths", far, 0.0)


def _stand_in(clip: Clip) -> Iterator[Finding]:
    """One value far beyond all others, on many pixels, stands for unknown: 65.535 m, 1e4."""
    known = clip.depths[clip.depths > 0]
    top = known.max()
    rest = known[known < 0.999 * top]
    share = 1 - rest.size / known.size
    if rest.size and share > 1e-3 and top > 3 * rest.max():
        message = f"{share:.1%} of the depths are {top:.6g}, all others below {rest.max():.3g}: it stands for unknown"
        fix = depths(lambda x: np.where(x < 0.999 * top, x, 0))
        measure = "largest depth over the next", float(top / rest.max()), 1.0
        yield Finding("stand_in_depth", message, "Set these depths to 0.", fix, *measure)


def _normalised(clip: Clip) -> Iterator[Finding]:
    """Intrinsics for an image of size 1, and those for an image so large or turned that their centre lies outside."""
    (height, width), point = clip.size, np.median(clip.intrinsics[:, :2, 2], axis=0).astype(np.float64)
    focal = float(np.median(clip.intrinsics[:, 0, 0]))
    if focal < width / 20 and (np.abs(point) < 2).all():
        message = f"intrinsics look normalised: fx = {focal:.3g} for an image {width} pixels wide"
        remedy = "Multiply row 0 by W and row 1 by H, then subtract 0.5 from cx and cy."
        fix = partial(rescaled, scale=(width, height), shift=-0.5)
        measure = "focal length in image widths", focal / width, focal
        yield Finding("normalised_intrinsics", message, remedy, fix, *measure)


def _bulging(clip: Clip) -> Iterator[Finding]:
    (before, chance), (after, _) = curvature(clip), curvature(ray_to_z(clip))
    bulges = before > max(5e-4, chance) and after < 0.3 * before
    if bulges and (not _moves(clip) or agreement(reduced(ray_to_z(clip))).usual(1.3)):
        row = CATALOGUE["ray_length"]
        yield Finding(row.name, row.message, row.remedy, ray_to_z, "curvature of planes in 1/depth", before, after)


def _at_rest(clip: Clip) -> list[Finding]:
    """What shows without camera motion: swapped or huge intrinsics, whole millimetres, mirrored or displaced colours."""
    point = np.median(clip.intrinsics[:, :2, 2], axis=0)
    centre = (np.array(clip.size[::-1]) - 1) / 2
    away = [float(np.abs(x / centre - 1).max()) for x in (point, point[::-1])]
    measure = "principal point's distance from the centre, in half images"
    if away[0] > 0.1 and away[1] < 0.03:
        return [_found("principal_point_swapped", swapped_axes, "", measure, *away)]
    if (point > 2 * centre).any():
        ((fix, remark),) = CATALOGUE["intrinsics_of_another_size"].undo(Case(clip))
        return [_found("intrinsics_of_another_size", fix, remark, measure, away[0], 0.0)]
    known = clip.depths[clip.depths > 0]
    whole = [float((x == np.rint(x)).mean()) for x in (known, known * np.float32(1e-3))]
    if whole[0] == 1 and np.median(known) >= 100:
        fix = depths(lambda x: x * 1e-3)
        return [_found("depth_in_millimetres", fix, "", "share of whole numbers", *whole)]
    before = agreement(clip)
    for fix, remark in CATALOGUE["poses_at_rest"].undo(Case(clip)) if before.colour > _STILL else ():
        after = agreement(fix(clip))
        if after.usual() and after.colour < 0.5 * before.colour:
            return [_found("poses_at_rest", fix, remark, *_worst(before, after))]
    return _displaced(clip)


def _displaced(clip: Clip) -> list[Finding]:
    """Colours that are mirrored or seen from another place than depth: the silhouettes lie elsewhere."""
    agree, measure = edges(clip), "changes of colour at silhouettes of the depth"
    middle, best = float(agree[len(agree) // 2]), float(agree.max())
    if best > 1.05 * middle:
        for fix, remark in CATALOGUE["unregistered"].undo(Case(clip)):
            return [_found("unregistered", fix, remark, measure, middle, best)]
    for name in () if _moves(clip) else ("colour_mirrored", "colour_shifted_in_time"):  # colours tell, where it moves
        options = CATALOGUE[name].undo(Case(clip))
        row = [(edges(fix(clip)), fix, remark) for fix, remark in options]
        shown, fix, remark = max(row, key=lambda x: x[0][len(agree) // 2], default=(agree, None, ""))
        after = float(shown[len(agree) // 2])
        if middle < 1.03 * np.median(agree) and after > 1.35 * middle and after > 1.08 * np.median(shown):
            return [_found(name, fix, remark, measure, middle, after)]
    return []


def _found(name: str, fix: Fix, remark: str, *numbers: object) -> Finding:
    row = CATALOGUE[name]
    return Finding(name, row.message + (f": {remark}" if remark else ""), row.remedy, fix, *numbers)


# How poses are written and in which unit may be wrong together.
_POSES = ["camera_to_world"], ["opengl_axes"], ["camera_to_world", "opengl_axes"]
_UNITS = [], ["depth_in_millimetres"], ["poses_in_millimetres"]
_TOGETHER = [pose + unit for pose in _POSES for unit in _UNITS if len(pose + unit) > 1]
_Chain = list[tuple[str, Fix, str]]  # names, what undoes them, remarks


def _misfit(clip: Clip) -> list[Finding]:
    """The simplest fixes that make an inconsistent clip consistent; where there are none, that it is inconsistent."""
    memory = {}
    before = agreement(clip, memory=memory)
    if before.depth < _NOISE and before.colour < _STILL:
        return _displaced(clip)

    def silhouettes(attempt: tuple[float, Agreement, _Chain]) -> float:
        """Of those that fit alike: how clearly the depth's edges are the colours' own."""
        agree = edges(_applied(clip, attempt[2]))
        return float(agree[len(agree) // 2])

    def accepted(attempts: list, slack: float, share: float) -> list[Finding]:
        """What is done in the best attempt, if the clip fits then, and much better."""
        best = attempts[0] if attempts else (0, before, [])
        for other in (x for x in attempts[1:] if x[0] < best[0] + 0.3):
            best = other if silhouettes(other) > 1.1 * silhouettes(best) else best
        _, after, chain = best
        # Where nothing need be wrong, one of many rare mistakes undone helps by chance.
        many = 1.3 if before.usual() and any(CATALOGUE[step[0]].price > 1 for step in chain) else 1
        better = before.badness() - after.badness() > -many * max(len(chain), 1) * np.log(share)
        return [_found(*step, *_worst(before, after)) for step in chain] if better and after.usual(slack) else []

    tried = []
    for prices in ((1, 1.35),) if before.usual() else ((1, 2), (2.1, 3)):  # the dear ones only where they are needed
        attempts = sorted(_attempts(clip, prices, memory), key=lambda attempt: attempt[0])
        if found := accepted(attempts, 1.0, _GAIN):
            return found
        tried = sorted([*tried, *attempts], key=lambda attempt: attempt[0])
    if not before.usual(1.3) and (found := accepted(tried, 1.3, _GAIN**0.5)):
        return found
    if not before.doubtful():
        return _displaced(clip)
    likely = ", ".join(list(dict.fromkeys("+".join(step[0] for step in chain) for *_, chain in tried))[:3])
    message = f"inconsistent: {before.numbers()}; cause unknown, likeliest: {likely or 'none'}"
    remedy = "Compare poses, intrinsics, depth and their order with where they come from; much motion does that, too."
    return [Finding("unknown", message, remedy, lambda clip: clip, *_worst(before, before))]


def _attempts(clip: Clip, prices: tuple[float, float], memory: dict) -> Iterator[tuple[float, Agreement, _Chain]]:
    """Mistakes undone, one by one and together: badness with a price for each change, how the clip fits then, the changes."""
    rows, case = [row for row in CATALOGUE.values() if prices[0] <= row.price <= prices[1]], Case(clip)
    chains = [([(row.name, *option)], row.price) for row in rows for option in row.undo(case)]
    together = _TOGETHER if prices[0] == 1 else []
    chains += [(chain, float(len(chain))) for names in together if (chain := _chain(clip, names))]
    ranked = []
    for chain, price in chains:
        try:
            changed = _applied(clip, chain)
            ranked.append((agreement(changed, 2, 150, memory).badness() - price * np.log(_GAIN), price, chain, changed))
        except ValueError:  # noqa: PERF203 (a change that leaves no valid depth, for example)
            continue
    for _, price, chain, changed in sorted(ranked, key=lambda x: x[0])[:12]:  # the others are not worth a closer look
        after = agreement(changed, memory=memory)
        yield after.badness() - price * np.log(_GAIN), after, chain


def _applied(clip: Clip, chain: _Chain) -> Clip:
    for _, fix, _ in chain:
        clip = fix(clip)
    return clip


def _chain(clip: Clip, names: list[str]) -> _Chain:
    """The first way to undo each of these mistakes, one after the other; empty where one is impossible."""
    chain = []
    for name in names:
        option = next(CATALOGUE[name].undo(Case(_applied(clip, chain))), None)
        if option is None:
            return []
        chain.append((name, *option))
    return chain


def _worst(before: Agreement, after: Agreement) -> tuple[str, float, float, float]:
    """The measure that a change improves most, or that is worst: its name, both numbers, and what is usual."""
    depth = ("relative depth error of what rests", before.depth, after.depth, USUAL_DEPTH)
    colour = ("colour error of what rests", before.colour, after.colour, USUAL_COLOUR)
    return max(
        depth, colour, key=lambda x: (x[1] + 1e-3 * x[3]) / (x[2] + 1e-3 * x[3]) if after != before else x[1] / x[3]
    )
