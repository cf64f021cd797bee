"""Matching of a foreign skeleton's bones to ours: by name, then by place in the hierarchy."""

from __future__ import annotations

import re

from pipelines.session.errors import DataError
from pipelines.session.records import SkeletalMotion
from pipelines.simulation.rig import SIDES

# Names of a bone without side, prefix and separators; the first one that is there is taken.
_SIDED = {
    "thigh": ("upleg", "upperleg01", "upperleg", "thigh", "thigh1", "femur", "hip"),
    "shank": ("leg", "lowerleg01", "lowerleg", "lowleg", "shin", "shin1", "calf", "tibia", "knee"),
    "foot": ("foot", "ankle"),
    "toes": ("toebase", "toe", "toes", "toe0", "toe11", "ball"),
    "upper_arm": ("arm", "upperarm01", "upperarm", "uparm", "shldr", "humerus", "shoulder"),
    "forearm": ("forearm", "lowerarm01", "lowerarm", "lowarm", "radius", "elbow"),
    "hand": ("hand", "wrist"),
    "clavicle": ("clavicle", "collar", "clav", "shoulder", "shoulder01"),
}
_MIDDLE = {
    "pelvis": ("hips", "pelvis", "hip", "root", "lowertorso"),
    "neck": ("neck", "neck1", "neck01"),
    "head": ("head",),
}
_ESSENTIAL_SIDED = ("thigh", "shank", "foot", "upper_arm", "forearm")
_LIMB_ABOVE = {"shank": "thigh", "foot": "shank", "forearm": "upper_arm"}


def match_bones(source: SkeletalMotion) -> dict[str, int]:
    """Find the bone of the source that moves as each of ours does.

    Names are compared without prefix (`mixamorig:`, `Bip01_`), case and separators; a side is `left`,
    `right`, or a lone `l` or `r` before or after. The trunk is the chain from the pelvis to the bone that
    both arms hang on; spine, back and chest are its first, middle and last bone. A part that the source lacks
    moves with its parent: toes with the foot, hands with the forearm, clavicles with the chest.

    Raises:
        DataError: essential bones were not found; the message lists them and the source's bones.
    """
    named: dict[tuple[str, str], int] = {}
    for index, name in enumerate(source.bones):
        named.setdefault(_parts_of(name), index)
    found: dict[str, int] = {}
    for ours, variants in _MIDDLE.items():
        _take(found, ours, [named.get(("", variant)) for variant in variants])
    if "pelvis" not in found and source.parent.count(-1) == 1:
        found["pelvis"] = source.parent.index(-1)
    for side in SIDES:
        for ours, variants in _SIDED.items():
            free = [named.get((side, v)) for v in variants]
            _take(found, f"{side}_{ours}", [index for index in free if index not in found.values()])
    missing = [name for name in _essential() if name not in found]
    missing += [
        f"{side}_{below}"
        for side in SIDES
        for below, above in _LIMB_ABOVE.items()
        if not missing and not _hangs_on(source, found[f"{side}_{below}"], found[f"{side}_{above}"])
    ]
    if missing:
        raise DataError(
            "skeleton",
            f"found no {', '.join(missing)} among its bones {', '.join(source.bones)}",
            "name them as usual (LeftUpLeg, LeftLeg, LeftFoot, LeftArm, LeftForeArm, ...)",
        )
    _trunk(source, found)
    for side in SIDES:
        found.setdefault(f"{side}_clavicle", found["chest"])
        found.setdefault(f"{side}_hand", found[f"{side}_forearm"])
        found.setdefault(f"{side}_toes", found[f"{side}_foot"])
    return found


def _parts_of(name: str) -> tuple[str, str]:
    """Split a name into its side (left, right or empty) and the rest."""
    bare = re.sub(r"^(bip\d*|character\d*|def)(?=[\W_])", "", name.rsplit(":", 1)[-1], flags=re.IGNORECASE)
    lower = [word.lower() for word in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+", bare)]
    for position in (0, -1):
        for letter, side in (("l", "left"), ("r", "right")):
            if lower and lower[position] in (letter, side):
                del lower[position]
                return side, "".join(lower)
    joined = "".join(lower)
    for side in SIDES:
        if joined.startswith(side):
            return side, joined.removeprefix(side)
    return "", joined


def _essential() -> list[str]:
    return ["pelvis", *(f"{side}_{bone}" for side in SIDES for bone in _ESSENTIAL_SIDED)]


def _take(found: dict[str, int], ours: str, candidates: list[int | None]) -> None:
    for index in candidates:
        if index is not None:
            found[ours] = index
            return


def _above(source: SkeletalMotion, bone: int) -> list[int]:
    """Return the bones that a bone hangs on, nearest first."""
    chain = []
    while (bone := source.parent[bone]) >= 0:
        chain.append(bone)
    return chain


def _hangs_on(source: SkeletalMotion, bone: int, other: int) -> bool:
    return other in _above(source, bone)


def _trunk(source: SkeletalMotion, found: dict[str, int]) -> None:
    """Add spine, back and chest from the chain that both arms hang on; add neck and head if missing."""
    pelvis = found["pelvis"]
    both = [
        bone
        for bone in _above(source, found["left_upper_arm"])
        if bone in _above(source, found["right_upper_arm"])
    ]
    chain = [bone for bone in reversed(both) if pelvis in _above(source, bone)]
    first, middle, last = (chain[0], chain[len(chain) // 2], chain[-1]) if chain else (pelvis, pelvis, pelvis)
    found |= {"spine": first, "back": middle, "chest": last}
    found.setdefault("neck", last)
    found.setdefault("head", found["neck"])
