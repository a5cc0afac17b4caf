"""Joint names of other skeletons: which of their joints are the 22 of SMPL, by name or by a map file."""

from __future__ import annotations

import itertools
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from avatar.body.model import SMPL_JOINTS
from avatar.checks import AvatarError, DataError, unknown_name
from avatar.io.documents import read_yaml

INDEX = {name: index for index, name in enumerate(SMPL_JOINTS)}
SIDES = {"left": "left", "l": "left", "right": "right", "r": "right"}
WORDS = re.compile(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])|\d+")  # of "LeftUpLeg", "L Thigh", "thigh.L", "upperarm_l"
PREFIX = re.compile(r"^(mixamorig|bip|character|ccbase|mavg|jbip)\d*")
# Our joint: names of Mixamo, CMU, LAFAN, Biped, MakeHuman, Rokoko, Xsens, Unreal and older skeletons, the likeliest
# first; lower case, without prefix, side, blanks and signs. A joint takes the first that is there.
TRUNK = {
    "pelvis": ("hips", "pelvis", "hip", "root"),
    "neck": ("neck", "lowerneck"),
    "head": ("head",),
}
LIMB = {
    "hip": ("upleg", "thigh", "upperleg", "hip", "femur", "thighbend"),
    "knee": ("knee", "shin", "calf", "lowleg", "lowerleg", "leg", "tibia"),
    "ankle": ("ankle", "foot"),
    "foot": ("toebase", "toe", "toes", "ball"),
    "collar": ("collar", "clavicle"),
    "shoulder": ("uparm", "upperarm", "arm", "humerus", "shldr", "shldrbend"),
    "elbow": ("elbow", "forearm", "lowarm", "lowerarm", "radius", "forearmbend"),
    "wrist": ("wrist", "hand"),
}
CHAINS = [("hip", "knee", "ankle"), ("shoulder", "elbow", "wrist")]  # each below the one before
NEEDED = [f"{side}_{joint}" for side in ("left", "right") for joint in ("hip", "knee", "ankle", "shoulder", "elbow")]
MAP_HINT = "Give joints=map.yaml, a file with lines such as 'left_elbow: name in the skeleton'."


def map_joints(names: Sequence[str], parents: Sequence[int], given: Mapping[str, str] | None = None) -> dict[int, int]:
    """Our joint index to a skeleton's: those ``given`` by a map (`read_joint_map`), then SMPL's or other common names.

    The joints between hips and neck are shared over the spine. Raises `AvatarError` for joints that were not found,
    names that the skeleton lacks, and knees, ankles, elbows or wrists that are not below the joints above them.
    """
    found = {INDEX[name]: index for index, name in enumerate(names) if name in INDEX}
    exact = not given and all(INDEX[joint] in found for joint in NEEDED)
    if not exact:
        found = _given_joints(names, given or {})
        for joint, index in _named_joints(names).items():
            if index not in found.values():
                found.setdefault(joint, index)
        found.setdefault(0, 0)
    missing = [joint for joint in NEEDED if INDEX[joint] not in found]
    if missing:
        problem = f"found none for {', '.join(missing)} among {', '.join(names[:40])}."
        raise AvatarError(f"joints: expected the names of a SMPL, Mixamo, CMU or LAFAN skeleton, {problem}")
    _check_chains(names, parents, found)
    return dict(sorted((found if exact else found | _spine(parents, found)).items()))


def read_joint_map(path: Path | None) -> dict[str, str]:
    """A YAML file of our joint names to a skeleton's, as ``left_elbow: Bone 12``; empty for None.

    Raises `DataError` for a name that is none of SMPL's 22 and values that are no names.
    """
    given = read_yaml(path) if path is not None else {}
    for ours, theirs in given.items():
        if ours not in INDEX:
            raise DataError(Path(path or ""), str(unknown_name("joints", ours, SMPL_JOINTS)))
        if not isinstance(theirs, (str, int)):
            raise DataError(Path(path or ""), f"{ours}: expected the name of a joint, got {theirs!r}.")
    return {ours: str(theirs) for ours, theirs in given.items()}


def _given_joints(names: Sequence[str], given: Mapping[str, str]) -> dict[int, int]:
    absent = [f"{ours}: {theirs}" for ours, theirs in given.items() if theirs not in names]
    if absent:
        problem = f"joints: expected names in the skeleton, got {', '.join(absent)}; it has {', '.join(names[:80])}."
        raise AvatarError(problem)
    return {INDEX[ours]: names.index(theirs) for ours, theirs in given.items()}


def _named_joints(names: Sequence[str]) -> dict[int, int]:
    """Our joints to a skeleton's, by `TRUNK` and `LIMB`."""
    plain: dict[tuple[str, str], int] = {}
    for index, parts in enumerate(_plain_names(names)):
        for key in parts:
            plain.setdefault(key, index)  # of two of one name, the one nearer to the root
    wanted = {joint: [("", name) for name in known] for joint, known in TRUNK.items()}
    for side in ("left", "right"):
        has = {part for found, part in plain if found == side}
        limb = dict(LIMB)
        if not has & set(LIMB["hip"]) and "leg" in has and has & {"knee", "shin", "calf"}:
            limb["hip"] = ("leg",)
        if has & set(LIMB["shoulder"]):
            limb["collar"] = (*limb["collar"], "shoulder")  # Mixamo's LeftShoulder is LeftArm's parent
        else:
            limb["shoulder"] = ("shoulder",)  # older skeletons': below LeftCollar, above LeftElbow
        if "ankle" in has:
            limb["foot"] = (*limb["foot"], "foot")
        wanted |= {f"{side}_{joint}": [(side, name) for name in known] for joint, known in limb.items()}
    places = {joint: [plain[key] for key in keys if key in plain] for joint, keys in wanted.items()}
    return {INDEX[joint]: indices[0] for joint, indices in places.items() if indices}


def _plain_names(names: Sequence[str]) -> list[list[tuple[str, str]]]:
    """Side ("left", "right", "") and part in lower case of each name, the likelier reading first."""
    bare = [re.split(r"[:|]", name)[-1] for name in names]
    if len(bare) > len(NEEDED):  # Character1_LeftArm: what all but the root begin with says nothing
        same = itertools.takewhile(lambda letters: len(set(letters)) == 1, zip(*bare[1:]))
        shared = len(re.match(r"(.*[^A-Za-z0-9])?", "".join(letters[0] for letters in same)).group())
        bare = [name[shared:] if index and len(name) > shared else name for index, name in enumerate(bare)]
    return [_readings(name) for name in bare]


def _readings(name: str) -> list[tuple[str, str]]:
    """Side and part of a name, with and without its numbers."""
    whole = PREFIX.sub("", re.sub(r"[^a-z0-9]", "", name.lower()))
    words = WORDS.findall(re.sub(r"^\W*(?i:mixamorig\d*|bip\d+|cc_base|m_avg|j_bip)[\W_]*", "", name))
    sides = [SIDES[word.lower()] for word in words if word.lower() in SIDES]
    glued = re.match(r"(left|right|l|r)(.+)", whole)
    readings = []
    if len(set(sides)) == 1:
        rest = [word.lower() for word in words if word.lower() not in SIDES]
        numberless = [word for word in rest if not word.isdigit()]
        readings = [(sides[0], "".join(rest)), (sides[0], "".join(numberless))]
    elif glued:  # lfemur
        readings = [(SIDES[glued[1]], glued[2])]
    return [*readings, ("", whole), ("", re.sub(r"\d+$", "", whole))] if not sides else readings


def _spine(parents: Sequence[int], found: Mapping[int, int]) -> dict[int, int]:
    """Our spine joints to those between hips and neck that nothing else was mapped to."""
    upper = found.get(INDEX["neck"], found[INDEX["left_shoulder"]])
    chain: list[int] = []
    while (upper := parents[upper]) > found[0]:
        chain.insert(0, upper)
    chain = [index for index in chain if index not in found.values()]
    free = [joint for joint in ("spine1", "spine2", "spine3") if INDEX[joint] not in found]
    spine = {1: free[2:] or free, 2: (free[:1] + free[2:]) or free}.get(len(chain), free)
    return {INDEX[joint]: index for joint, index in zip(reversed(spine), reversed(chain))}


def _check_chains(names: Sequence[str], parents: Sequence[int], found: Mapping[int, int]) -> None:
    """Refuses joints that do not lie below those they hang from, as of a map to the wrong names."""
    for side in ("left", "right"):
        for chain in CHAINS:
            mapped = [(f"{side}_{joint}", found.get(INDEX[f"{side}_{joint}"])) for joint in chain]
            for (upper, above), (lower, below) in itertools.pairwise(mapped):
                at = below
                while at is not None and at > above:
                    at = parents[at]
                if at is not None and at != above:
                    problem = f"{lower} is {names[below]!r}, which is not below {names[above]!r}, taken for {upper}."
                    raise AvatarError(f"joints: expected {lower} below {upper}, got others: {problem}")
