"""LightGlue, a learned matcher: two pictures' keypoints are compared in the context of all the others.

Source: P. Lindenberger, P.-E. Sarlin, M. Pollefeys, "LightGlue: Local Feature Matching at Light Speed",
ICCV 2023.
"""

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import torch

NUM_LAYERS = 9
NUM_HEADS = 4
_MIN_PROBABILITY = 0.1
_CONFIDENT_SHARE = 0.95


class LightGlue:
    """LightGlue with given weights, names and shapes as published."""

    def __init__(self, state: Mapping[str, "torch.Tensor"]) -> None:
        self._weights = dict(state)

    def match(
        self, places: tuple[np.ndarray, np.ndarray], descriptors: tuple[np.ndarray, np.ndarray]
    ) -> np.ndarray:
        """(M, 2) int64 indices of keypoints of two pictures that show the same thing.

        places: (N, 2) and (P, 2), see `normalise_places`;  descriptors: (N, D) and (P, D) float32
        """
        import torch

        if min(map(len, places)) == 0:
            return np.zeros((0, 2), dtype=np.int64)
        with torch.inference_mode():
            turns = [self._turns(torch.from_numpy(p.astype(np.float32))) for p in places]
            a, b = (self._linear(torch.from_numpy(d), "input_proj") for d in descriptors)
            last = 0
            for last in range(NUM_LAYERS):
                a, b = self._layer(a, b, turns, f"transformers.{last}.")
                if last < NUM_LAYERS - 1 and self._is_confident(torch.cat([a, b]), last):
                    break
            return _mutual(self._log_probability(a, b, f"log_assignment.{last}.")).numpy()

    def _linear(self, x: "torch.Tensor", name: str) -> "torch.Tensor":
        import torch.nn.functional as F

        return F.linear(x, self._weights[f"{name}.weight"], self._weights.get(f"{name}.bias"))

    def _turns(self, places: "torch.Tensor") -> tuple["torch.Tensor", "torch.Tensor"]:
        """(N, C / 2) cosine and sine of the angles by which a place turns pairs of channels."""
        angle = self._linear(places, "posenc.Wr")
        return angle.cos(), angle.sin()

    def _layer(
        self,
        a: "torch.Tensor",
        b: "torch.Tensor",
        turns: list[tuple["torch.Tensor", "torch.Tensor"]],
        name: str,
    ) -> tuple["torch.Tensor", "torch.Tensor"]:
        """Each picture looks at itself, then at the other one."""
        a, b = (
            self._look_at_itself(x, turn, f"{name}self_attn.") for x, turn in zip((a, b), turns, strict=True)
        )
        cross = f"{name}cross_attn."
        keys = [_split_heads(self._linear(x, f"{cross}to_qk")) for x in (a, b)]
        values = [_split_heads(self._linear(x, f"{cross}to_v")) for x in (a, b)]
        from_b = self._linear(_attend(keys[0], keys[1], values[1]), f"{cross}to_out")
        from_a = self._linear(_attend(keys[1], keys[0], values[0]), f"{cross}to_out")
        return self._add(a, from_b, cross), self._add(b, from_a, cross)

    def _look_at_itself(
        self, x: "torch.Tensor", turn: tuple["torch.Tensor", "torch.Tensor"], name: str
    ) -> "torch.Tensor":
        mixed = self._linear(x, f"{name}Wqkv")
        query, key, value = mixed.reshape(len(x), NUM_HEADS, -1, 3).permute(3, 1, 0, 2)
        message = _attend(_rotate(query, turn), _rotate(key, turn), value)
        return self._add(x, self._linear(message, f"{name}out_proj"), name)

    def _add(self, x: "torch.Tensor", message: "torch.Tensor", name: str) -> "torch.Tensor":
        """What a keypoint knew, and what the message changes in it."""
        import torch
        import torch.nn.functional as F

        y = self._linear(torch.cat([x, message], dim=-1), f"{name}ffn.0")
        gain, shift = self._weights[f"{name}ffn.1.weight"], self._weights[f"{name}ffn.1.bias"]
        return x + self._linear(F.gelu(F.layer_norm(y, gain.shape, gain, shift)), f"{name}ffn.3")

    def _is_confident(self, x: "torch.Tensor", layer: int) -> bool:
        """Whether further layers would hardly change anything."""
        threshold = 0.8 + 0.1 * math.exp(-4 * layer / NUM_LAYERS)
        confidence = self._linear(x, f"token_confidence.{layer}.token.0").sigmoid()
        return bool((confidence >= threshold).float().mean() > _CONFIDENT_SHARE)

    def _log_probability(self, a: "torch.Tensor", b: "torch.Tensor", name: str) -> "torch.Tensor":
        """(N, P) that two keypoints match each other, and that both can be matched at all."""
        import torch.nn.functional as F

        projected = [self._linear(x, f"{name}final_proj") for x in (a, b)]
        similarity = projected[0] @ projected[1].T / math.sqrt(a.shape[1])
        seen = [F.logsigmoid(self._linear(x, f"{name}matchability")) for x in (a, b)]
        return similarity.log_softmax(dim=0) + similarity.log_softmax(dim=1) + seen[0] + seen[1].T


def normalise_places(pixels: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """(N, 2) places from the picture's middle, in halves of its longer side. size: (width, height) px"""
    return (pixels - np.array(size) / 2) / (max(size) / 2)


def _split_heads(x: "torch.Tensor") -> "torch.Tensor":
    return x.reshape(len(x), NUM_HEADS, -1).transpose(0, 1)


def _attend(query: "torch.Tensor", key: "torch.Tensor", value: "torch.Tensor") -> "torch.Tensor":
    """(N, C) attention of all heads: query (heads, N, C / heads), key and value (heads, P, C / heads)."""
    import torch.nn.functional as F

    y = F.scaled_dot_product_attention(query[None], key[None], value[None])[0]
    return y.transpose(0, 1).flatten(1)


def _rotate(x: "torch.Tensor", turn: tuple["torch.Tensor", "torch.Tensor"]) -> "torch.Tensor":
    """Pairs of neighbouring channels of (heads, N, C) turned in their plane."""
    import torch

    cosine, sine = turn
    first, second = x[..., 0::2], x[..., 1::2]
    return torch.stack([first * cosine - second * sine, second * cosine + first * sine], dim=-1).flatten(-2)


def _mutual(log_probability: "torch.Tensor") -> "torch.Tensor":
    """(M, 2) rows and columns that are each other's best, and probable enough."""
    import torch

    best, column = log_probability.max(dim=1)
    rows = torch.arange(len(column))
    is_mutual = log_probability.argmax(dim=0)[column] == rows
    keep = is_mutual & (best > math.log(_MIN_PROBABILITY))
    return torch.stack([rows[keep], column[keep]], dim=1)
