"""Persons in one picture, each with 33 landmarks, by the networks of BlazePose.

Source: Bazarevsky, Grishchenko, Raveendran, Zhu, Zhang, Grundmann, "BlazePose: on-device real-time
body pose tracking", CVPR workshop 2020. A detector says where a person's hips are, how large the person
is and how turned; a second network looks at that square and places the landmarks.
"""

import dataclasses
import importlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from fourd.checksum import check_sha256

NUM_LANDMARKS = 33
DETECTOR_SIDE_PX = 224
LANDMARK_SIDE_PX = 256
# Of the detector's grid: cell size in px of its picture, and boxes per cell.
DETECTOR_CELLS = ((8, 2), (16, 2), (32, 6))
# Squares that are searched beside the whole picture, as shares of its shorter side.
TILE_SHARES = (1.0, 0.6)
DETECTION_SCORE = 0.4
PERSON_SCORE = 0.5
# The square around a person is this many times the distance from hips to the end of the body.
SQUARE_OF_REACH = 2.5
# Two finds are one person if their landmarks lie within this share of the larger one's height.
SAME_PERSON_SHARE = 0.15
FILES = {
    "pose_detection.tflite": "9ba9dd3d42efaaba86b4ff0122b06f29c4122e756b329d89dca1e297fd8f866c",
    "pose_landmark_full.tflite": "e9a5c5cb17f736fafd4c2ec1da3b3d331d6edbe8a0d32395855aeb2cdfd64b9f",
}


@dataclasses.dataclass(frozen=True, eq=False)
class Pose:
    """One person in one picture: (33, 2) px, (33,) visibility in [0, 1], the network's score."""

    pixels: np.ndarray
    visibility: np.ndarray
    score: float

    @property
    def extent_px(self) -> float:
        """Diagonal of the box around the landmarks."""
        return float(np.linalg.norm(np.ptp(self.pixels, axis=0)))


class PoseNetwork:
    """Detector and landmark network on one thread of the CPU."""

    def __init__(self, folder: Path) -> None:
        """Raises InputError if a file is missing or another one."""
        for name, sha256 in FILES.items():
            check_sha256(folder / name, sha256)
        self._detector, self._landmarks = (_load(folder / name) for name in FILES)
        self._anchors = _grid_anchors()

    def find(self, image: np.ndarray) -> list[Pose]:
        """Persons in an (H, W, 3) uint8 RGB picture, best score first.

        The whole picture is searched, and overlapping squares of it: the detector was made for persons
        who fill a good part of its picture.
        """
        finds = [find for tile in _tiles(image.shape[:2]) for find in self._detect(image, *tile)]
        finds.sort(key=lambda find: -find[0])
        hips_seen: list[np.ndarray] = []
        poses = []
        for _, hips, end in finds:
            reach = np.linalg.norm(end - hips)
            if any(np.linalg.norm(hips - other) < reach / 2 for other in hips_seen):
                continue
            hips_seen.append(hips)
            pose = self._place_landmarks(image, hips, end)
            if pose.score > PERSON_SCORE:
                poses.append(pose)
        return _drop_repeats(poses)

    def _detect(
        self, image: np.ndarray, left: float, top: float, side: float
    ) -> list[tuple[float, np.ndarray, np.ndarray]]:
        """(score, hips px, end of the body px) in one square; what is outside the picture is black."""
        scale = DETECTOR_SIDE_PX / side
        warp = np.array([[scale, 0, -left * scale], [0, scale, -top * scale]])
        tile = cv2.warpAffine(image, warp, (DETECTOR_SIDE_PX,) * 2, flags=cv2.INTER_LINEAR)
        boxes, logits = _run(self._detector, np.asarray(tile) / np.float32(127.5) - np.float32(1))
        scores = _sigmoid(logits[0, :, 0])
        found = []
        for index in np.flatnonzero(scores > DETECTION_SCORE):
            points = boxes[0, index, 4:8].reshape(2, 2) / DETECTOR_SIDE_PX + self._anchors[index]
            hips, end = points * side + [left, top]
            found.append((float(scores[index]), hips, end))
        return found

    def _place_landmarks(self, image: np.ndarray, hips: np.ndarray, end: np.ndarray) -> Pose:
        # The network says where it would have looked itself: a second look is steadier.
        pose = None
        for _ in range(2):
            axis = end - hips
            angle = np.pi / 2 - np.arctan2(-axis[1], axis[0])
            side = SQUARE_OF_REACH * np.linalg.norm(axis)
            turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
            turn *= side / LANDMARK_SIDE_PX
            middle = np.full(2, (LANDMARK_SIDE_PX - 1) / 2)
            warp = np.column_stack([turn, hips - turn @ middle])
            flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
            square = cv2.warpAffine(image, warp, (LANDMARK_SIDE_PX,) * 2, flags=flags)
            found = _run(self._landmarks, np.asarray(square) / np.float32(255))
            values = found[0].reshape(-1, 5).astype(np.float64)
            pixels = values[:, :2] @ turn.T + warp[:, 2]
            visibility = _sigmoid(values[:NUM_LANDMARKS, 3])
            pose = Pose(pixels[:NUM_LANDMARKS], visibility, float(found[1].ravel()[0]))
            hips, end = pixels[NUM_LANDMARKS : NUM_LANDMARKS + 2]
        assert pose is not None
        return pose


def _load(path: Path) -> Any:
    network = importlib.import_module("ai_edge_litert.interpreter").Interpreter(str(path), num_threads=1)
    network.allocate_tensors()
    return network


def _run(network: Any, image: np.ndarray) -> list[np.ndarray]:
    network.set_tensor(network.get_input_details()[0]["index"], image[None].astype(np.float32))
    network.invoke()
    return [network.get_tensor(entry["index"]) for entry in network.get_output_details()]


def _grid_anchors() -> np.ndarray:
    """(2254, 2) centres of the detector's boxes as shares of its picture."""
    anchors = []
    for cell, count in DETECTOR_CELLS:
        cells = DETECTOR_SIDE_PX // cell
        y, x = np.mgrid[:cells, :cells]
        centers = np.stack([x.ravel() + 0.5, y.ravel() + 0.5], axis=1) / cells
        anchors.append(np.repeat(centers, count, axis=0))
    return np.concatenate(anchors)


def _tiles(shape: tuple[int, int]) -> list[tuple[float, float, float]]:
    """(left, top, side) of overlapping squares, px: the whole picture, then smaller ones."""
    height, width = shape
    tiles = []
    for side in (max(shape), *(share * min(shape) for share in TILE_SHARES)):
        for top in _spread(height, side):
            tiles += [(left, top, float(side)) for left in _spread(width, side)]
    return list(dict.fromkeys(tiles))


def _spread(length: int, side: float) -> list[float]:
    """Starts of squares that cover a length and overlap by half or more; centred if one is enough."""
    if side >= length:
        return [(length - side) / 2]
    return np.linspace(0, length - side, int(np.ceil((length - side) / (side / 2))) + 1).tolist()


def _drop_repeats(poses: list[Pose]) -> list[Pose]:
    kept: list[Pose] = []
    for pose in sorted(poses, key=lambda pose: -pose.score):
        for other in kept:
            height = max(np.ptp(pose.pixels[:, 1]), np.ptp(other.pixels[:, 1]))
            distance = np.median(np.linalg.norm(pose.pixels - other.pixels, axis=1))
            if distance < SAME_PERSON_SHARE * height:
                break
        else:
            kept.append(pose)
    return kept


def _sigmoid(values: np.ndarray) -> np.ndarray:
    return 1 / (1 + np.exp(-np.clip(values.astype(np.float64), -50, 50)))
