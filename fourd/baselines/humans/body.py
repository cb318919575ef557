"""A parametric body: the base mesh of MakeHuman, its average adult, a skeleton of 31 bones.

The data are released under CC0. Lengths are in the mesh's own unit (about 0.1 m), x to the person's
left, y up, z ahead.
"""

import dataclasses
import gzip
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from fourd.checksum import check_sha256

FILES = {
    "base.obj": "8e761e6624b8f54536409135d1636da63b32486a90d4897f84e121d144f6fb4c",
    "rig.cmu_mb.json": "a751d730091304de2a7f7407a57976e86f71f75125e21fa2626ca5c661a6ad68",
    "weights.cmu_mb.json": "e349f27b120b848858fca21c386b257de0b93e7ec26113f6dd2e8caa8ce11e9b",
    "african-female-young.target.gz": "1147ae55ecb0f66bade3f45176b3af187e265878322db172ad1090e9f3108e84",
    "african-male-young.target.gz": "05ed84d6df36e788cdfa8da0be15376850524b960cf2f17f3e592b9cf7d21c85",
    "asian-female-young.target.gz": "ee17da733288434e5b6fa120497f1fa6e72bf7faad5d694b0431d7275139170d",
    "asian-male-young.target.gz": "0928ed8b9f08f60afb9884cf9e9f33a939ed3a85d7f136de9ccc88a76981d6d7",
    "caucasian-female-young.target.gz": "e9d6212373ac5f1e2c596fa145e363385f4d169c3c6c88ede3bab93b681af041",
    "caucasian-male-young.target.gz": "ffe69537e53148edff2776204ba48cf3bf1f3cbc72966592c8a562ab80b07333",
}
ROOT = "Hips"
# Parameters: bones that share one rotation vector, and by what share of it each turns.
TURNS: dict[str, tuple[str, ...]] = {
    "spine": ("LowerBack", "Spine", "Spine1"),
    "neck": ("Neck", "Neck1", "Head"),
    **{
        side + bone: (side + bone,)
        for side in ("Left", "Right")
        for bone in ("Shoulder", "Arm", "ForeArm", "Hand", "UpLeg", "Leg", "Foot")
    },
}
# Bones whose length is a parameter, on both sides.
LIMB_BONES = {
    "legs": ("UpLeg", "Leg", "Foot", "ToeBase"),
    "arms": ("Arm", "ForeArm", "Hand", "Thumb", "FingerBase", "HandFinger1"),
}
# Landmark of the pose network -> (bone, where it is on the resting body): a joint of the mesh.
_JOINTS = {
    2: ("Head", "joint-l-eye"),
    5: ("Head", "joint-r-eye"),
    **{
        left + (side == "r"): (f"{name}{bone}", f"joint-{side}-{joint}")
        for side, name in (("l", "Left"), ("r", "Right"))
        for left, bone, joint in (
            (11, "Arm", "shoulder"),
            (13, "ForeArm", "elbow"),
            (15, "Hand", "hand"),
            (17, "Hand", "finger-5-1"),
            (19, "Hand", "finger-2-1"),
            (23, "UpLeg", "upper-leg"),
            (25, "Leg", "knee"),
            (27, "Foot", "ankle"),
            (31, "Foot", "toe-2-2"),
        )
    },
}
# Landmark -> (bone, axis, sign): the outermost vertex of that bone in a direction.
_TIPS = {
    0: ("Head", 2, 1),
    7: ("Head", 0, 1),
    8: ("Head", 0, -1),
    29: ("LeftFoot", 2, -1),
    30: ("RightFoot", 2, -1),
}
NUM_PARAMETERS = 7 + len(LIMB_BONES) + 3 * len(TURNS)


@dataclasses.dataclass(frozen=True, eq=False)
class BodyModel:
    """The resting body.

    vertices: (V, 3);  faces: (F, 3) int32, triangles;  weights: (V, B) of the bones, each row sums to 1
    bones: names, parents before children;  parents: (B,) index, -1 of the root;  heads: (B, 3) joints
    landmarks: (L,) indices of the pose network;  marks: (L, 3) where they are;  mark_bones: (L,)
    limb_of: (B,) index in `LIMB_BONES`, -1 for the trunk
    """

    vertices: np.ndarray
    faces: np.ndarray
    weights: np.ndarray
    bones: tuple[str, ...]
    parents: np.ndarray
    heads: np.ndarray
    landmarks: np.ndarray
    marks: np.ndarray
    mark_bones: np.ndarray
    limb_of: np.ndarray

    def pose_bones(self, parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(N, B, 3, 3) and (N, B, 3): a resting point p of a bone is at A (p - head) + b.

        parameters: (N, NUM_PARAMETERS): place of the hips (3), rotation vector of the whole (3), log
        of the size, logs of the limbs' lengths against the trunk's (legs, arms), rotation vectors in
        the order of `TURNS`
        """
        count = len(parameters)
        place, turn, log_size = parameters[:, :3], parameters[:, 3:6], parameters[:, 6]
        log_limbs = parameters[:, 7 : 7 + len(LIMB_BONES)]
        vectors = parameters[:, 7 + len(LIMB_BONES) :].reshape(count, len(TURNS), 3)
        turns = {ROOT: Rotation.from_rotvec(turn).as_matrix()}
        for i, bones in enumerate(TURNS.values()):
            matrix = Rotation.from_rotvec(vectors[:, i] / len(bones)).as_matrix()
            turns |= dict.fromkeys(bones, matrix)
        rotations = np.empty((count, len(self.bones), 3, 3))
        matrices = np.empty_like(rotations)
        origins = np.empty((count, len(self.bones), 3))
        for i, (bone, parent) in enumerate(zip(self.bones, self.parents, strict=True)):
            if parent < 0:
                rotations[:, i], origins[:, i] = turns[ROOT], place
            else:
                turn = turns.get(bone, np.eye(3))
                rotations[:, i] = rotations[:, parent] @ turn
                offset = self.heads[i] - self.heads[parent]
                origins[:, i] = origins[:, parent] + matrices[:, parent] @ offset
            log_length = log_size + (log_limbs[:, self.limb_of[i]] if self.limb_of[i] >= 0 else 0)
            matrices[:, i] = rotations[:, i] * np.exp(log_length)[:, None, None]
        return matrices, origins

    def place_marks(self, parameters: np.ndarray) -> np.ndarray:
        """(N, L, 3) landmarks of N posed bodies."""
        matrices, origins = self.pose_bones(parameters)
        offsets = self.marks - self.heads[self.mark_bones]
        return np.einsum("nlij,lj->nli", matrices[:, self.mark_bones], offsets) + origins[:, self.mark_bones]

    def place_vertices(self, parameters: np.ndarray) -> np.ndarray:
        """(V, 3) vertices of one posed body, by linear blend skinning."""
        matrices, origins = (part[0] for part in self.pose_bones(parameters[None]))
        offsets = origins - np.einsum("bij,bj->bi", matrices, self.heads)
        blended = np.einsum("vb,bij->vij", self.weights, matrices, optimize=True)
        return np.einsum("vij,vj->vi", blended, self.vertices) + self.weights @ offsets


def read_body(folder: Path) -> BodyModel:
    """The average of six adults from a folder with `FILES`. Raises InputError for other files."""
    for name, sha256 in FILES.items():
        check_sha256(folder / name, sha256)
    vertices, faces, groups = _read_mesh((folder / "base.obj").read_text(encoding="utf-8"))
    targets = [name for name in FILES if name.endswith(".target.gz")]
    for name in targets:
        rows = gzip.decompress((folder / name).read_bytes()).decode("ascii").splitlines()
        index, *offsets = np.array([row.split() for row in rows if row and row[0] != "#"], np.float64).T
        vertices[index.astype(int)] += np.stack(offsets, axis=1) / len(targets)
    rig = json.loads((folder / "rig.cmu_mb.json").read_text(encoding="utf-8"))
    weights = json.loads((folder / "weights.cmu_mb.json").read_text(encoding="utf-8"))["weights"]
    return assemble_body(vertices, faces, groups, rig, weights)


def assemble_body(
    vertices: np.ndarray,
    faces: np.ndarray,
    groups: Mapping[str, np.ndarray],
    rig: Mapping[str, Any],
    weights: Mapping[str, Sequence[tuple[int, float]]],
) -> BodyModel:
    """The model from a mesh with helper groups, a rig and weights in MakeHuman's form.

    vertices: (N, 3) of body and helpers;  faces: (F, 3) of the body;  groups: vertices of each group
    """
    bones = _parents_first({name: bone["parent"] for name, bone in rig.items()})
    heads = np.stack([_find_head(rig[bone]["head"], vertices, groups) for bone in bones])
    parents = np.array([bones.index(rig[bone]["parent"]) if rig[bone]["parent"] else -1 for bone in bones])
    used, faces = np.unique(faces, return_inverse=True)
    dense = np.zeros((len(vertices), len(bones)))
    for i, bone in enumerate(bones):
        index, values = np.array(weights[bone], np.float64).T
        dense[index.astype(int), i] = values
    dense = dense[used] / dense[used].sum(axis=1, keepdims=True)
    marks = {mark: (bone, vertices[groups[group]].mean(axis=0)) for mark, (bone, group) in _JOINTS.items()}
    for mark, (bone, axis, sign) in _TIPS.items():
        of_bone = vertices[used][dense[:, bones.index(bone)] > 0.5]
        marks[mark] = (bone, of_bone[np.argmax(sign * of_bone[:, axis])])
    landmarks = sorted(marks)
    return BodyModel(
        vertices[used],
        faces.reshape(-1, 3).astype(np.int32),
        dense,
        bones,
        parents,
        heads,
        np.array(landmarks),
        np.stack([marks[mark][1] for mark in landmarks]),
        np.array([bones.index(marks[mark][0]) for mark in landmarks]),
        np.array([_limb_of(bone) for bone in bones]),
    )


def _limb_of(bone: str) -> int:
    for side in ("Left", "Right", "L", "R"):
        name = bone.removeprefix(side)
        for i, limb in enumerate(LIMB_BONES.values()):
            if name != bone and name in limb:
                return i
    return -1


def _parents_first(parents: Mapping[str, str]) -> tuple[str, ...]:
    """Bone names sorted so that each stands after its parent."""
    ordered: list[str] = []
    while len(ordered) < len(parents):
        ordered += [b for b, p in parents.items() if b not in ordered and (not p or p in ordered)]
    return tuple(ordered)


def _find_head(head: Mapping[str, Any], vertices: np.ndarray, groups: Mapping[str, np.ndarray]) -> np.ndarray:
    index = groups[head["cube_name"]] if head["strategy"] == "CUBE" else head["vertex_indices"]
    return vertices[index].mean(axis=0)


def _read_mesh(text: str) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """(N, 3) vertices, (F, 3) triangles of the group `body`, and the vertices of each group."""
    vertices: list[list[float]] = []
    corners: dict[str, list[list[int]]] = {}
    group = ""
    for line in text.splitlines():
        kind, _, rest = line.partition(" ")
        if kind == "v":
            vertices.append([float(word) for word in rest.split()])
        elif kind == "g":
            group = rest.strip()
        elif kind == "f":
            corners.setdefault(group, []).append([int(word.split("/")[0]) - 1 for word in rest.split()])
    quads = np.array(corners["body"])
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    groups = {name: np.unique(np.concatenate(faces)) for name, faces in corners.items()}
    return np.array(vertices), faces, groups
